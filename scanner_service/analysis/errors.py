"""What the analysis refuses, as facts.

AnalysisError
├── MapFull          the configured ceiling of the live map is reached
├── TooManyPasses    more passes are open at once than the map can tell apart
├── MethodUnknown    there is no method of that name
└── MethodRefused    a method cannot do what is asked with these points or options
"""


class AnalysisError(Exception):
    """Root of everything the analysis refuses."""


class MapFull(AnalysisError):
    """The live map holds as many points or cells as it was configured for."""


class TooManyPasses(AnalysisError):
    """More passes are open at once than the map can tell apart."""


class MethodUnknown(AnalysisError):
    """There is no method of that name."""


class MethodRefused(AnalysisError):
    """A method cannot do what is asked with these points or options."""
