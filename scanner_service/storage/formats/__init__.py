"""Files that come in: scanlines and clouds of other programs, checked before they are believed.

The errors are one tree, drawn in `errors`; all of them are a `FormatError` with one plain sentence.
"""

from scanner_service.storage.formats.errors import (
    ContentDamaged,
    FileEmpty,
    FileNotReadable,
    FileTooLarge,
    FileTruncated,
    FormatError,
    FormatUnknown,
    HeaderDamaged,
    LaserUnknown,
    LibraryAbsent,
    NoScanlines,
    OptionRefused,
    SpacingUnknown,
)
from scanner_service.storage.formats.opening import kind_of_content, open_cloud, open_recording
from scanner_service.storage.formats.recording import Cloud, ReadOptions, Recording

__all__ = [
    "Cloud",
    "ContentDamaged",
    "FileEmpty",
    "FileNotReadable",
    "FileTooLarge",
    "FileTruncated",
    "FormatError",
    "FormatUnknown",
    "HeaderDamaged",
    "LaserUnknown",
    "LibraryAbsent",
    "NoScanlines",
    "OptionRefused",
    "ReadOptions",
    "Recording",
    "SpacingUnknown",
    "kind_of_content",
    "open_cloud",
    "open_recording",
]
