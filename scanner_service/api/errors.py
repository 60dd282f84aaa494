"""What only the web interface refuses, as facts.

ApiError
├── ValueUnusable    a value of the request that the schema could not judge
├── NotConfirmed     a request that destroys something came without its confirmation
└── ExportUnknown    there is no export of that name
"""


class ApiError(Exception):
    """Root of what only the web interface refuses."""


class ValueUnusable(ApiError):
    """A value of the request that the schema could not judge."""


class NotConfirmed(ApiError):
    """A request that destroys something came without its confirmation."""


class ExportUnknown(ApiError):
    """There is no export of that name."""
