"""Files that go out: points, picture and results, each whole under its name or not there at all.

Pictures are imported from their own files: the library that draws them takes 40 MB.
"""

from scanner_service.storage.exports.errors import ExportError, ExportNotConfirmed, ExportNotWritten
from scanner_service.storage.exports.points_ply import write_points_ply
from scanner_service.storage.exports.results_json import json_bytes, write_json
from scanner_service.storage.exports.whole_file import whole_file, write_whole

__all__ = [
    "ExportError",
    "ExportNotConfirmed",
    "ExportNotWritten",
    "json_bytes",
    "whole_file",
    "write_json",
    "write_points_ply",
    "write_whole",
]
