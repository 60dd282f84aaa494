"""The folder of recorded scans and nominal parts of a service: what lies there, and what people bring; plays none.

A file that arrives is written beside, counted and looked at, and appears under its name only when it is whole.
"""

import hashlib
import os
import re
import secrets
import shutil
import stat
import threading
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

from scanner_service.rescan.reference import ReferenceSurface
from scanner_service.sessions.errors import BudgetSpent, FileUnknown, NameTaken, SessionBusy, SourceUnusable
from scanner_service.storage.errors import RecordError
from scanner_service.storage.formats import FormatError, kind_of_content
from scanner_service.storage.formats.reference_mesh import read_mesh
from scanner_service.storage.reader import RecordReader

MAX_FILE_BYTES = 2 << 30
RESERVE_BYTES = 1 << 30
"""So much of the disk stays free for the record, whatever arrives."""

MOST_ARRIVING = 2
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9 ._()+-]{0,119}")
_TEXTS_AND_CLOUDS = (".asc", ".csv", ".e57", ".las", ".laz", ".pcd", ".ply", ".pts", ".tsv", ".txt", ".xyz")
_MESHES = (".obj", ".stl")
_ENDINGS = (*_TEXTS_AND_CLOUDS, ".raw", ".gz", ".db", ".sqlite", ".sqlite3", *_MESHES)
_BESIDE = ("-wal", "-shm", "-journal")  # what SQLite leaves beside a record, and believes when it finds it there
_MESH = "mesh"
_HEAD_BYTES = 1 << 16
_LOOK_EVERY_BYTES = 16 << 20


@dataclass(frozen=True, slots=True)
class ShelfFile:
    """One file: its bare name, its size, and what it is by its first bytes (None: nothing that is read here)."""

    name: str
    size_bytes: int
    kind: str | None


class FileShelf:
    """The files of one folder; `arriving` is a folder on the same disk that belongs to the shelf alone."""

    def __init__(
        self,
        folder: Path,
        arriving: Path,
        free_bytes: Callable[[Path], int] = lambda place: shutil.disk_usage(place).free,
    ) -> None:
        self.folder = folder
        self._arriving = arriving
        self._free_bytes = free_bytes
        self._door = threading.Lock()
        shutil.rmtree(arriving, ignore_errors=True)  # what an earlier process did not finish
        arriving.mkdir(mode=0o700)

    def files(self) -> list[ShelfFile]:
        """What lies there, by name."""
        shown = (
            item
            for item in sorted(self.folder.iterdir())
            if not item.name.startswith(".") and not item.name.endswith(_BESIDE)
        )
        return [file for file in map(_look_at, shown) if file is not None]

    def receive(self, name: str, declared_bytes: int | None) -> "Arrival":
        """Begin to take in a file, of which `declared_bytes` are said to come.

        Raises
        ------
        SourceUnusable : the name is no bare file name of a kind that is read here, or the file is too large.
        SessionBusy : too many files arrive at once.
        BudgetSpent : the disk is too full.
        """
        if _NAME.fullmatch(name) is None:
            raise SourceUnusable(
                "a file is named by at most 120 letters, digits, spaces and . _ ( ) + -, a letter first"
            )
        if not name.lower().endswith(_ENDINGS):
            endings = f"{', '.join(_ENDINGS[:-1])} or {_ENDINGS[-1]}"
            raise SourceUnusable(f"nothing that is read here is named like {name}: let the name end in {endings}")
        if declared_bytes is not None and declared_bytes > MAX_FILE_BYTES:
            raise _too_large(name)
        with self._door:  # counted and opened in one go
            here = [item for item in self._arriving.iterdir() if not item.name.endswith(_BESIDE)]
            if len(here) >= MOST_ARRIVING:
                raise SessionBusy(f"{MOST_ARRIVING} files arrive already; send this one when they are here")
            self.check_room(declared_bytes or 0)
            return Arrival(self, name, self._arriving / (secrets.token_hex(8) + Path(name).suffix.lower()))

    def check_room(self, more_bytes: int) -> None:
        """Raise BudgetSpent when so much more would take what is kept free."""
        if self._free_bytes(self._arriving) - more_bytes < RESERVE_BYTES:
            raise BudgetSpent(f"the disk of the service is too full for it: {RESERVE_BYTES >> 20} MiB stay free")

    def remove(self, name: str) -> None:
        """Remove a file; sessions that were made from it stay. Raises FileUnknown when it is not there."""
        if name not in {one.name for one in self.files()}:
            raise FileUnknown(f"there is no file {name} in the service's replay folder")
        for beside in ("", *_BESIDE):
            (self.folder / (name + beside)).unlink(missing_ok=True)


class Arrival:
    """A file on its way in; a context that leaves nothing behind unless `keep` was called."""

    def __init__(self, shelf: FileShelf, name: str, beside: Path) -> None:
        self._shelf = shelf
        self._name = name
        self._beside = beside
        self._size_bytes = 0
        self._looked_bytes = 0
        self._digest = hashlib.sha256()
        self._file: BinaryIO = beside.open("xb")

    def write(self, piece: bytes) -> None:
        """Take the next bytes.

        Raises
        ------
        SourceUnusable : it is larger than any file may be.
        BudgetSpent : the disk is getting too full.
        """
        self._size_bytes += len(piece)
        if self._size_bytes > MAX_FILE_BYTES:
            raise _too_large(self._name)
        if self._size_bytes - self._looked_bytes >= _LOOK_EVERY_BYTES:
            self._looked_bytes = self._size_bytes
            self._shelf.check_room(0)
        self._digest.update(piece)
        self._file.write(piece)

    def keep(self) -> ShelfFile:
        """Look at what came, and put it under its name.

        Raises
        ------
        NameTaken : another file of that name is there.
        SourceUnusable : it is a record that cannot be read.
        FormatError : it is nothing that is read here.
        ReferenceUnusable : it is a mesh that no scan can be measured against.
        """
        self._file.flush()
        os.fsync(self._file.fileno())
        if self._name.lower().endswith(_MESHES):
            kind = _MESH
            _check_mesh(self._beside, self._name)
        else:
            with self._beside.open("rb") as file:
                kind = kind_of_content(file.read(_HEAD_BYTES), self._name)
            if kind == "record":
                _check_record(self._beside, self._name)
        place = self._shelf.folder / self._name
        try:
            os.link(self._beside, place)  # unlike a rename it replaces nothing
        except FileExistsError:
            if not self._is_same(place):
                raise NameTaken(
                    f"another file {self._name} is there already: send this one under another name"
                ) from None
        return ShelfFile(self._name, self._size_bytes, kind)

    def _is_same(self, place: Path) -> bool:
        if not place.is_file() or place.stat().st_size != self._size_bytes:
            return False
        with place.open("rb") as file:
            return hashlib.file_digest(file, "sha256").digest() == self._digest.digest()

    def __enter__(self) -> "Arrival":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()
        self._beside.unlink(missing_ok=True)


def _look_at(path: Path) -> ShelfFile | None:
    """What lies there; None for what is no file, or was removed meanwhile."""
    try:
        seen = path.stat()
    except OSError:
        return None
    return ShelfFile(path.name, seen.st_size, _kind(path)) if stat.S_ISREG(seen.st_mode) else None


def _kind(path: Path) -> str | None:
    if path.name.lower().endswith(_MESHES):
        return _MESH
    try:
        with path.open("rb") as file:
            return kind_of_content(file.read(_HEAD_BYTES), path.name)
    except (FormatError, OSError):
        return None


def _check_mesh(path: Path, name: str) -> None:
    try:
        ReferenceSurface.of(read_mesh(path).corners_mm)
    except FormatError as error:
        raise type(error)(str(error).replace(path.name, name)) from error


def _check_record(path: Path, name: str) -> None:
    try:
        with closing(RecordReader.open(path)) as reader:
            sessions = reader.list_sessions(1)
    except RecordError as error:
        raise SourceUnusable(str(error).replace(str(path.resolve()), name)) from error
    finally:
        for beside in _BESIDE:
            path.with_name(path.name + beside).unlink(missing_ok=True)
    if not sessions:
        raise SourceUnusable(f"the record {name} holds no session")


def _too_large(name: str) -> SourceUnusable:
    return SourceUnusable(f"{name} is too large: at most {MAX_FILE_BYTES >> 20} MiB are taken in")
