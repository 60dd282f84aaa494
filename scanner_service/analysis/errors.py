"""What the analysis refuses, as facts.

AnalysisError
├── MapFull          the configured ceiling of the live map is reached
├── TooManyPasses    more passes are open at once than the map can tell apart
└── UnknownPass      a line names a pass that was never opened, or is closed
"""


class AnalysisError(Exception):
    """Root of everything the analysis refuses."""


class MapFull(AnalysisError):  # noqa: N818 - a fact, as everywhere in this tree
    """The live map holds as many points or cells as it was configured for."""


class TooManyPasses(AnalysisError):  # noqa: N818
    """More passes are open at once than the map can tell apart."""


class UnknownPass(AnalysisError):  # noqa: N818
    """A line names a pass that was never opened, or that is closed."""
