"""What can be wrong with a file that is read, as facts; every message is one sentence that also says what to do.

FormatError
├── FileNotReadable     absent, a folder, not permitted
├── FileTooLarge        larger than the configured ceiling, or made to need far more memory than its size
├── FormatUnknown       the content is of no kind that is read here
├── HeaderDamaged       a header that breaks the rules of its format
├── FileTruncated       the file ends before what its header declares (or the header is wrong)
├── ContentDamaged      a row or value that cannot be what the header says; the message names the row
├── FileEmpty           not a single point
├── NoScanlines         a plain cloud where scanlines are needed
├── LaserUnknown        nothing tells where the laser stood
├── SpacingUnknown      nothing tells how far apart the scanlines are
├── LibraryAbsent       the format needs a library that is not installed
└── OptionRefused       an option that cannot be meant
"""


class FormatError(Exception):
    """Root of everything that reading a file refuses."""


class FileNotReadable(FormatError):
    """The file is absent, is a folder, or may not be read."""


class FileTooLarge(FormatError):
    """Reading the file would need more memory than is allowed."""


class FormatUnknown(FormatError):
    """The content is of no kind that is read here."""


class HeaderDamaged(FormatError):
    """The header breaks the rules of its format."""


class FileTruncated(FormatError):
    """The file ends before what its header declares."""


class ContentDamaged(FormatError):
    """A row or a value cannot be what the header says."""


class FileEmpty(FormatError):
    """The file holds not a single point."""


class NoScanlines(FormatError):
    """The file is a plain cloud, and scanlines are needed."""


class LaserUnknown(FormatError):
    """Nothing tells where the laser stood."""


class SpacingUnknown(FormatError):
    """Nothing tells how far apart the scanlines are."""


class LibraryAbsent(FormatError):
    """The format needs a library that is not installed; the message says how to install it."""


class OptionRefused(FormatError):
    """An option that cannot be meant."""
