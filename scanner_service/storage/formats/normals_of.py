"""Whose normals a file holds, as its own header says: those of this program are estimates, no truth; reads no file."""

from collections.abc import Iterable
from typing import Literal

NormalsOf = Literal["file", "live map", "scanner analyse"]
"""`file`: nothing is said of them, so they are the file's own."""

BY_LIVE_MAP, BY_ANALYSIS = "normals of the live map", "normals of scanner analyse"
"""Lines of a header (a comment) with which this program says whose the normals are that it writes."""


def normals_of(comments: Iterable[str]) -> NormalsOf:
    """Whose they are by the comments of a header, the first that says so.

    Files that this program wrote before it said so are known by the session that they tell about.
    """
    for text in comments:
        if text == BY_LIVE_MAP or (text.startswith("about {") and '"software": "scanner-service' in text):
            return "live map"
        if text == BY_ANALYSIS:
            return "scanner analyse"
    return "file"
