"""What the planner of passes refuses, as facts.

PlanningError
├── OpticsUnknown       the scanner's optics are not known, or cannot be meant
├── RigUnlimited        the rig does not say what it can reach
└── PassOutOfReach      a pass that would leave the limits of the rig
"""


class PlanningError(ValueError):
    """Root of everything the planner refuses."""


class OpticsUnknown(PlanningError):
    """The scanner's optics are not known, or cannot be meant."""


class RigUnlimited(PlanningError):
    """The rig does not say what it can reach."""


class PassOutOfReach(PlanningError):
    """A pass that would leave the limits of the rig."""
