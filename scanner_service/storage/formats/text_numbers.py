"""Lines of numbers, fast: the values of a text and how many stand on each line; knows no column's meaning."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from drivers.scanline import Float64Array
from scanner_service.storage.formats.errors import ContentDamaged

_BLOCK_BYTES = 1 << 23
Int64Array = npt.NDArray[np.int64]


CUT_NOTE = "the last line has no line break: if the file was cut within its last number, nothing tells"


@dataclass(frozen=True, slots=True)
class TextNumbers:
    """Numbers of a text; blank lines are left out.

    `values` (v,) are all numbers in order. Row i has `counts[i]` of them from `starts[i]` on, and stands on the
    text's line `lines[i]`, counted from 0; `first_line` is that line's number in the file.
    """

    values: Float64Array
    counts: Int64Array
    starts: Int64Array
    lines: Int64Array
    first_line: int

    def line_number(self, row: int) -> int:
        """The line of the file, counted from 1, on which the row stands."""
        return int(self.lines[row]) + self.first_line


def numbers_of_text(text: bytes, name: str, first_line: int = 1, separators: bytes = b" \t\r") -> TextNumbers:
    """Read numbers separated by any of `separators`, one row a line; in blocks, so that memory stays near the file.

    Raises
    ------
    ContentDamaged : something is not a number; the message names the line.
    """
    blank = np.zeros(256, dtype=np.bool_)
    blank[np.frombuffer(separators + b"\n\x0b\x0c", dtype=np.uint8)] = True
    to_space = bytes(32 if blank[code] and code != 10 else code for code in range(256))
    if b"\n" not in text and b"\r" in text:  # lines as old Macintosh programs end them
        text = text.replace(b"\r", b"\n")
    values: list[Float64Array] = []
    per_line: list[Int64Array] = []
    at = 0
    while at < len(text):
        cut = text.find(b"\n", min(at + _BLOCK_BYTES, len(text))) + 1 or len(text)
        block = text[at:cut]
        at = cut
        codes = np.frombuffer(block, dtype=np.uint8)
        is_blank = blank[codes]
        begins = ~is_blank
        begins[1:] &= is_blank[:-1]
        ends = np.flatnonzero(codes == 10)
        if not block.endswith(b"\n"):
            ends = np.append(ends, len(block))
        so_far = np.searchsorted(np.flatnonzero(begins), ends)
        per_line.append(np.diff(so_far, prepend=0))
        values.append(_floats(block.translate(to_space), name, first_line + sum(map(len, per_line[:-1]))))
    counts = np.concatenate(per_line) if per_line else np.empty(0, dtype=np.int64)
    lines = np.flatnonzero(counts)
    counts = counts[lines].astype(np.int64)
    all_values = np.concatenate(values) if values else np.empty(0)
    return TextNumbers(all_values, counts, np.cumsum(counts) - counts, lines, first_line)


def _floats(block: bytes, name: str, first_line: int) -> Float64Array:
    words = block.split()
    try:
        if b"_" in block:  # Python reads 1_000 as a number, nobody else does
            raise ValueError
        return np.fromiter(map(float, words), dtype=np.float64, count=len(words))
    except ValueError:
        for number, line in enumerate(block.split(b"\n"), start=first_line):
            for word in line.split():
                if not _is_number(word):
                    shown = word[:40].decode("latin-1")
                    raise ContentDamaged(f"{name}: line {number} holds {shown!r} where a number is needed") from None
        raise


def _is_number(word: bytes) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return b"_" not in word
