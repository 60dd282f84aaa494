"""What can go wrong when a result is written, as facts.

ExportError
├── ExportNotWritten     the file system refused; whatever had the name before is untouched
└── ExportNotConfirmed   the new file is in place, but the file system did not confirm that the name will last
"""


class ExportError(Exception):
    """Root of everything that goes wrong when a result is written."""


class ExportNotWritten(ExportError):
    """The file could not be written; what had its name before is untouched."""


class ExportNotConfirmed(ExportError):
    """The file is written and in place, and a power cut may still bring back what was there before."""
