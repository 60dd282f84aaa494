"""Plain text clouds: x y z with or without a normal; knows columns and delimiters, no scanline.

One point a line, separated by blanks, tabs, commas or semicolons. `#`, `//` and `;` begin a comment. The first
line may name the columns; without names the first three are x y z and, if there are six, the next three the normal.
"""

import re

import numpy as np

from scanner_service.storage.formats.errors import ContentDamaged, FileEmpty, HeaderDamaged
from scanner_service.storage.formats.recording import MM_PER_UNIT, Cloud, Units, finite_rows
from scanner_service.storage.formats.text_numbers import CUT_NOTE, numbers_of_text

_COMMENT = re.compile(rb"^[ \t]*(?:#|//|;)[^\n]*", re.MULTILINE)
_NORMAL = ("nx", "ny", "nz")


def names_of_line(line: str) -> list[str] | None:
    """The column names in a line of text, in small letters, or None when they are not those of a cloud."""
    words = [word for word in re.split(r"[\s,;]+", line.strip().lstrip("#/;").strip().lower()) if word]
    words = [word.removesuffix("_mm") if word.endswith("_mm") else word for word in words]
    return words if {"x", "y", "z"} <= set(words) else None


def read_xyz(data: bytes, name: str, units: Units | None) -> Cloud:
    """Read a text cloud; rows with NaN or infinite coordinates are counted as `not_finite`.

    Raises
    ------
    ContentDamaged : a row has another number of values than the first, or something is not a number.
    HeaderDamaged : the columns are named, and not as many as there are.
    FileEmpty : not one finite point.
    """
    unit = units if units not in (None, "auto") else "mm"
    why = "as given" if units not in (None, "auto") else "since the file names no unit; give the units if they are not"
    text = data.removeprefix(b"\xef\xbb\xbf")
    names, in_comment, at, end = _names(text)
    if names is not None:  # the line of names is blanked, not cut, so that line numbers in messages stay true
        text = text[:at] + text[end:]
    numbers = numbers_of_text(_COMMENT.sub(b"", text), name, separators=b" \t\r,;")
    if not len(numbers.counts):
        raise FileEmpty(f"{name} holds no point: there is nothing to read")
    width = int(numbers.counts[0])
    if width < 3:
        raise ContentDamaged(f"{name}: line {numbers.line_number(0)} has {width} values; a point needs x y z")
    odd = numbers.counts != width
    if odd.any():
        row = int(np.argmax(odd))
        raise ContentDamaged(
            f"{name}: line {numbers.line_number(row)} has {numbers.counts[row]} values, the first point has {width}; "
            "the file is cut short or damaged"
        )
    table = numbers.values.reshape(-1, width)
    if names is not None and in_comment and len(names) != width:
        names = None  # a remark that happens to speak of x, y and z
    columns = names or ["x", "y", "z", *(_NORMAL if width == 6 else ())]
    if names is not None and len(names) != width:
        raise HeaderDamaged(f"{name} names {len(names)} columns, and its points have {width} values")
    with np.errstate(over="ignore", invalid="ignore"):
        points = table[:, [columns.index(axis) for axis in "xyz"]] * MM_PER_UNIT[str(unit)]
    kept = finite_rows(points)
    if not kept.any():
        raise FileEmpty(f"{name} holds no point with finite coordinates: there is nothing to analyse")
    has_normals = set(_NORMAL) <= set(columns)
    notes = [f"lengths are read as {unit}, {why}"]
    if names is None and width not in (3, 6):
        notes.append(f"only the first 3 of {width} unnamed columns are read, as x y z")
    if not data.endswith((b"\n", b"\r")):
        notes.append(CUT_NOTE)
    lost = int((~kept).sum())
    return Cloud(
        source=name,
        format="xyz",
        points_mm=points[kept],
        normals=table[kept][:, [columns.index(axis) for axis in _NORMAL]] if has_normals else None,
        points_declared=len(kept),
        dropped={"not_finite": lost} if lost else {},
        notes=tuple(notes),
    )


def _names(text: bytes) -> tuple[list[str] | None, bool, int, int]:
    """The names of the columns, whether they stand in a comment, and where that line begins and ends."""
    at = 0
    for line in text[: 1 << 16].splitlines(keepends=True):
        content = line.rstrip(b"\r\n")
        names = names_of_line(content.decode("latin-1"))
        in_comment = re.match(rb"[ \t]*(?:#|//|;)", content) is not None
        if names is not None:
            return names, in_comment, at, at + len(content)
        if content.strip() and not in_comment:
            break
        at += len(line)
    return None, False, 0, 0
