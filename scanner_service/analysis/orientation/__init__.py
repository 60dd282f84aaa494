"""One side for the normals of a cloud without scanlines; refuses to know where it was seen from."""

from scanner_service.analysis.orientation.orienting import orient_normals
from scanner_service.analysis.orientation.result import ComponentTable, Doubt, Orientation

__all__ = ["ComponentTable", "Doubt", "Orientation", "orient_normals"]
