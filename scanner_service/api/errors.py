"""What only the web interface refuses, as facts.

ApiError
├── ValueUnusable    a value of the request that the schema could not judge
└── ExportUnknown    there is no export of that name
"""


class ApiError(Exception):
    """Root of what only the web interface refuses."""


class ValueUnusable(ApiError):
    """A value of the request that the schema could not judge."""


class ExportUnknown(ApiError):
    """There is no export of that name."""
