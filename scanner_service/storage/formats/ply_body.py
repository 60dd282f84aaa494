"""The rows of a PLY file, ASCII or binary: columns of numbers and of ragged lists; knows no meaning of a column.

ASCII rows are lines, as the format says; every line is checked for its number of values. A number is taken as it
is written, not rounded to the declared type.
"""

from array import array
from dataclasses import dataclass
from struct import Struct

import numpy as np
import numpy.typing as npt

from drivers.scanline import Float64Array
from scanner_service.storage.formats.errors import ContentDamaged, FileTruncated
from scanner_service.storage.formats.ply_header import Element, PlyHeader
from scanner_service.storage.formats.text_numbers import TextNumbers, numbers_of_text

Int64Array = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Ragged:
    """Lists of different lengths: `counts` (n,) and all `values` one behind the other."""

    counts: Int64Array
    values: Float64Array


@dataclass(frozen=True, slots=True)
class Rows:
    """The rows of one element: `scalars` (n,) and `lists` by property name."""

    scalars: dict[str, Float64Array]
    lists: dict[str, Ragged]


def read_rows(header: PlyHeader, data: bytes, name: str) -> dict[str, Rows]:
    """All rows of the file by element; `data` is the whole file, whose size was checked against the header.

    Raises
    ------
    FileTruncated : the rows end early.
    ContentDamaged : a value is no number, a line has too many or too few, a list has a negative length, or bytes are
        left over after the last row (the header declares too little).
    """
    if header.byte_order is None:
        return _read_ascii(header, data, name)
    return _read_binary(header, data, name)


def _read_ascii(header: PlyHeader, data: bytes, name: str) -> dict[str, Rows]:
    text = numbers_of_text(data[header.body_at :], name, first_line=data.count(b"\n", 0, header.body_at) + 1)
    rows: dict[str, Rows] = {}
    done = 0
    for element in header.elements:
        if len(text.counts) - done < element.count:
            raise FileTruncated(
                f"{name} is cut short or its header is wrong: {element.count} {element.name} rows are declared and "
                f"{len(text.counts) - done} are there"
            )
        rows[element.name] = _ascii_element(element, text, done, name)
        done += element.count
    if done < len(text.counts):
        raise ContentDamaged(
            f"{name} holds {len(text.counts) - done} lines more than its header declares, "
            f"from line {text.line_number(done)}: the header is wrong"
        )
    return rows


def _ascii_element(element: Element, text: TextNumbers, first: int, name: str) -> Rows:
    """The rows of one element; all rows step from property to property together."""
    at = text.starts[first : first + element.count].copy()
    end = at + text.counts[first : first + element.count]
    rows = Rows({}, {})
    # Where a line is too short, the value read belongs to the next line; it is refused below before anyone sees it.
    last = max(len(text.values) - 1, 0)
    for item in element.properties:
        head = text.values[np.minimum(at, last)]
        _refuse(at >= end, "has too few values", element, text, first, name)
        if item.count_type is None:
            rows.scalars[item.name] = head
            at += 1
            continue
        _refuse(~((head >= 0) & (head == np.floor(head))), "has a list of no whole length", element, text, first, name)
        _refuse(head > end - at - 1, "has too few values", element, text, first, name)
        counts = head.astype(np.int64)
        rows.lists[item.name] = Ragged(counts, text.values[_ranges(at + 1, counts)])
        at += 1 + counts
    _refuse(at < end, "has too many values", element, text, first, name)
    return rows


def _refuse(bad: npt.NDArray[np.bool_], what: str, element: Element, text: TextNumbers, first: int, name: str) -> None:
    if bad.any():
        row = int(np.argmax(bad))
        line = text.line_number(first + row)
        if first + row == len(text.counts) - 1 and what == "has too few values":
            raise FileTruncated(f"{name} is cut short: it ends within {element.name} row {row} (line {line})")
        raise ContentDamaged(f"{name}: line {line} ({element.name} row {row}) {what}")


def _ranges(starts: Int64Array, counts: Int64Array) -> Int64Array:
    """starts[0], starts[0]+1, ... counts[0] of them, then those of the next, as one array."""
    total = int(counts.sum())
    before = np.cumsum(counts) - counts
    return np.asarray(np.arange(total, dtype=np.int64) + np.repeat(starts - before, counts))


def _read_binary(header: PlyHeader, data: bytes, name: str) -> dict[str, Rows]:
    rows: dict[str, Rows] = {}
    at = header.body_at
    for element in header.elements:
        if element.has_list:
            rows[element.name], at = _binary_ragged(element, header.byte_order or "<", data, at, name)
        else:
            kinds = np.dtype([(item.name, f"{header.byte_order}{item.value_type}") for item in element.properties])
            if len(data) - at < element.count * kinds.itemsize:
                raise _ends_within(name, element, (len(data) - at) // max(kinds.itemsize, 1))
            table = np.frombuffer(data, dtype=kinds, count=element.count, offset=at) if element.count else None
            with np.errstate(invalid="ignore"):  # a signalling NaN is a NaN
                scalars = {
                    item.name: np.empty(0) if table is None else table[item.name].astype(np.float64)
                    for item in element.properties
                }
            rows[element.name] = Rows(scalars, {})
            at += element.count * kinds.itemsize
    if data[at:].strip():
        raise ContentDamaged(f"{name} holds {len(data) - at} bytes more than its header declares: the header is wrong")
    return rows


def _binary_ragged(element: Element, order: str, data: bytes, at: int, name: str) -> tuple[Rows, int]:
    """Rows with lists: only walking from one to the next tells where each begins."""
    steps = [
        (Struct(order + _STRUCT[item.count_type]) if item.count_type else None, int(item.value_type[1:]))
        for item in element.properties
    ]
    places = [array("q") for _ in steps]
    counts = [array("q") for _ in steps]
    size = len(data)
    for row in range(element.count):
        for column, (count_of, value_bytes) in enumerate(steps):
            count = 1
            if count_of is not None:
                if at + count_of.size > size:
                    raise _ends_within(name, element, row)
                (count,) = count_of.unpack_from(data, at)
                if count < 0:
                    raise ContentDamaged(f"{name}: {element.name} row {row} has a list of length {count}")
                at += count_of.size
                counts[column].append(count)
            places[column].append(at)
            at += count * value_bytes
            if at > size:
                raise _ends_within(name, element, row)
    raw = np.frombuffer(data, dtype=np.uint8)
    rows = Rows({}, {})
    for column, item in enumerate(element.properties):
        starts = np.array(places[column], dtype=np.int64)
        length = np.array(counts[column], dtype=np.int64) if item.count_type else np.ones(len(starts), dtype=np.int64)
        width = int(item.value_type[1:])
        picked = raw[_ranges(starts, length * width)]
        with np.errstate(invalid="ignore"):
            values = picked.view(f"{order}{item.value_type}").astype(np.float64)
        if item.count_type:
            rows.lists[item.name] = Ragged(length, values)
        else:
            rows.scalars[item.name] = values
    return rows, at


_STRUCT = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I"}


def _ends_within(name: str, element: Element, row: int) -> FileTruncated:
    return FileTruncated(
        f"{name} is cut short or its header is wrong: it ends within row {row} of {element.count} {element.name} rows"
    )
