"""Which unit of length a file is in: as the user says, as its own words say, or by a rule that a note tells."""

from collections.abc import Iterable
from itertools import pairwise

from scanner_service.storage.formats.recording import Units

_UNIT_WORDS = {
    **dict.fromkeys(("mm", "millimetre", "millimeter", "millimetres", "millimeters"), "mm"),
    **dict.fromkeys(("m", "metre", "meter", "metres", "meters"), "m"),
    **dict.fromkeys(("inch", "inches", "in"), "inch"),
}
UnitAndWhy = tuple[str, str]
MILLIMETRES: UnitAndWhy = (
    "mm",
    "lengths are read as millimetres, since the file names no unit; give the units if they are not",
)


def given_or_named(given: Units | None, words_of_the_file: Iterable[str]) -> UnitAndWhy | None:
    """The unit that was given, or that a comment of the file names (`units mm`), and the sentence that says so."""
    if given is not None and given != "auto":
        return given, f"lengths are read as {given}, as given"
    for text in words_of_the_file:
        words = text.lower().replace(":", " ").replace("=", " ").replace(",", " ").split()
        for before, word in pairwise(words):
            if before in ("unit", "units") and word in _UNIT_WORDS:
                return _UNIT_WORDS[word], f"lengths are read as {_UNIT_WORDS[word]}: the header says so"
    return None
