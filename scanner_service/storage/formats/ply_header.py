"""The header of a PLY file (Turk 1994): what it declares; reads no vertex and believes no count.

A header is text, so that a hostile one can declare anything. `check_size` compares what it declares with the bytes
that are really there, before a single array is made.
"""

import re
from dataclasses import dataclass

from scanner_service.storage.formats.errors import FileTruncated, HeaderDamaged

MAX_HEADER_BYTES = 1 << 18
_MAX_PROPERTIES = 512
_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_BYTE_ORDERS = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass(frozen=True, slots=True)
class Property:
    """One property: `value_type` and, for a list, `count_type` are numpy codes without byte order ("f4")."""

    name: str
    value_type: str
    count_type: str | None = None

    @property
    def least_bytes(self) -> int:
        """Bytes that one value takes in a binary file at the least; a list may be empty."""
        return int((self.count_type or self.value_type)[1:])


@dataclass(frozen=True, slots=True)
class Element:
    """One kind of row: how many the header declares, and what each holds."""

    name: str
    count: int
    properties: tuple[Property, ...]

    @property
    def has_list(self) -> bool:
        """True when rows may differ in length."""
        return any(item.count_type for item in self.properties)


@dataclass(frozen=True, slots=True)
class PlyHeader:
    """A parsed header; `byte_order` is None for ASCII, `body_at` the offset of the first byte after it."""

    byte_order: str | None
    elements: tuple[Element, ...]
    comments: tuple[str, ...]
    obj_info: dict[str, str]
    body_at: int

    def element(self, name: str) -> Element | None:
        """The element of that name, or None."""
        return next((item for item in self.elements if item.name == name), None)


def is_ply(data: bytes) -> bool:
    """True when the content begins like a PLY file."""
    return re.match(rb"ply[ \t]*[\r\n]", data) is not None


def parse_header(data: bytes, name: str) -> PlyHeader:
    """Parse the header at the start of `data`; `name` is the file's, for messages.

    Raises
    ------
    HeaderDamaged : it breaks the rules of the format, or has no end.
    """
    head = data[:MAX_HEADER_BYTES]
    end = re.search(rb"(?:^|[\r\n])[ \t]*end_header[ \t]*(\r\n|\n|\r)", head)
    if not is_ply(head) or end is None:
        raise HeaderDamaged(
            f"{name} has no complete PLY header (no end_header line): it is cut short or not a PLY file"
        )
    lines = head[: end.start()].decode("latin-1").splitlines()
    byte_order: str | None = None
    has_format = False
    elements: list[tuple[str, int, list[Property]]] = []
    comments: list[str] = []
    obj_info: dict[str, str] = {}
    for number, line in enumerate(lines[1:], start=2):
        words = line.split()
        match words:
            case []:
                continue
            case ["comment", *_]:
                comments.append(line.strip()[len("comment") :].strip())
            case ["obj_info", key, *values]:
                obj_info[key] = " ".join(values)
            case ["obj_info"]:
                continue
            case ["format", kind, "1.0"] if kind in _BYTE_ORDERS and not has_format:
                byte_order, has_format = _BYTE_ORDERS[kind], True
            case ["element", element, count] if count.isascii() and count.isdigit() and len(count) <= 18:
                if any(element == other for other, _, _ in elements):
                    raise HeaderDamaged(f"{name}: line {number} of the PLY header declares element {element} again")
                elements.append((element, int(count), []))
            case ["property", *declared] if elements:
                known = elements[-1][2]
                item = _property(declared, name, number)
                if any(item.name == other.name for other in known):
                    raise HeaderDamaged(f"{name}: line {number} of the PLY header declares property {item.name} again")
                known.append(item)
            case _:
                raise HeaderDamaged(f"{name}: line {number} of the PLY header cannot be understood: {line[:60]!r}")
    if not has_format:
        raise HeaderDamaged(f"{name}: the PLY header has no format line")
    if sum(len(known) for _, _, known in elements) > _MAX_PROPERTIES:
        raise HeaderDamaged(f"{name}: the PLY header declares more than {_MAX_PROPERTIES} properties")
    for element, declared_count, known in elements:
        if declared_count and not known:
            raise HeaderDamaged(f"{name}: the PLY header declares {declared_count} {element} rows without a property")
    kinds = tuple(Element(element, count, tuple(known)) for element, count, known in elements)
    body_at = end.end()
    if head[3:].lstrip(b" \t")[:2].startswith(b"\r") and not head[3:].lstrip(b" \t").startswith(b"\r\n"):
        body_at = end.start(1) + 1  # lines end with a bare CR: a LF after it is already data
    return PlyHeader(byte_order, kinds, tuple(comments), obj_info, body_at)


def check_size(header: PlyHeader, body_bytes: int, name: str) -> None:
    """Refuse a header that declares more than `body_bytes` can hold.

    Raises
    ------
    FileTruncated : even with every list empty the rows need more bytes than there are.
    """
    needed = 0
    for item in header.elements:
        if header.byte_order is None:  # at least one digit and one separator a value; the last line may end bare
            row_bytes = 2 * len(item.properties)
        else:
            row_bytes = sum(kind.least_bytes for kind in item.properties)
        needed += item.count * row_bytes
        if needed - (header.byte_order is None) > body_bytes:
            raise FileTruncated(
                f"{name} is cut short or its header is wrong: {item.count} {item.name} rows are declared and need at "
                f"least {needed} bytes, and {body_bytes} are there"
            )


def _property(declared: list[str], name: str, number: int) -> Property:
    match declared:
        case [kind, label] if kind in _TYPES:
            return Property(label, _TYPES[kind])
        case ["list", count_kind, kind, label] if _TYPES.get(count_kind, "f")[0] in "iu" and kind in _TYPES:
            return Property(label, _TYPES[kind], _TYPES[count_kind])
    raise HeaderDamaged(f"{name}: line {number} of the PLY header is no property: {' '.join(declared)[:60]!r}")
