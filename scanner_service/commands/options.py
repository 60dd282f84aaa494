"""Options that several commands read in the same way; raises ValueError with one plain sentence."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, cast, get_args

import typer

from scanner_service.rescan.requirement import Interest
from scanner_service.storage.formats.recording import Units
from scanner_service.storage.reader import RecordReader

Data = Annotated[
    Path, typer.Option("--data", envvar="SCANNER_DATA", help="Folder of the service whose record is read.")
]
RecordFile = Annotated[
    str | None, typer.Option("--record", envvar="SCANNER_RECORD", help="Another record: a file, or postgresql://….")
]


@contextmanager
def open_reader(data: Path, record: str | None) -> Iterator[RecordReader]:
    """The record of a service's folder, or the record file named; a running service is not disturbed.

    Raises RecordUnusable.
    """
    reader = RecordReader.open(record or data / "record.sqlite")
    try:
        yield reader
    finally:
        reader.close()


def meshes_in(data: Path) -> Path:
    """Where the reference meshes of a service lie whose folder is `data`."""
    return data / "replay"


def parse_units(text: str | None) -> Units | None:
    """A length unit: mm, m, inch or auto; None stays None."""
    if text is None or text in get_args(Units):
        return cast(Units | None, text)
    raise ValueError(f"units must be mm, m, inch or auto, not {text}")


def parse_position(text: str | None) -> tuple[float, float, float] | None:
    """A position `x,y,z` in mm, in which `-` stands for a coordinate left open (NaN); None stays None."""
    if text is None:
        return None
    try:
        x, y, z = (float("nan") if part.strip() == "-" else float(part) for part in text.split(","))
    except ValueError:
        raise ValueError(f"a position is three numbers x,y,z in mm, not {text}") from None
    return (x, y, z)


def parse_interest(text: str | None) -> Interest | None:
    """A region of interest: low and high corner as `x,y,z,x,y,z` in mm; None stays None."""
    if text is None:
        return None
    try:
        x, y, z, right, far, top = (float(part) for part in text.split(","))
    except ValueError:
        raise ValueError(f"a region of interest is six numbers x,y,z,x,y,z in mm, not {text}") from None
    return Interest((x, y, z), (right, far, top))
