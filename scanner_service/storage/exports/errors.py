"""What can go wrong when a result is written, as facts.

ExportError
├── ExportNotWritten     the file system refused; whatever had the name before is untouched
├── ExportNotConfirmed   the new file is in place, but the file system did not confirm that the name will last
├── ExtraMissing         the format needs a library that is not installed
├── FormatNotWritten     there is no such format
├── NotExportable        the data do not fit the format
└── ManifestUnreadable   a folder of exports without a manifest that can be read
"""


class ExportError(Exception):
    """Root of everything that goes wrong when a result is written."""


class ExportNotWritten(ExportError):
    """The file could not be written; what had its name before is untouched."""


class ExportNotConfirmed(ExportError):
    """The file is written and in place, and a power cut may still bring back what was there before."""


class ExtraMissing(ExportError):
    """The format needs a library that is not installed; the message says how to install it."""


class FormatNotWritten(ExportError):
    """There is no such format to write."""


class NotExportable(ExportError):
    """The data do not fit the format; the message says which does."""


class ManifestUnreadable(ExportError):
    """There is no manifest that could be checked."""
