"""Write a file so that its name never holds half of it; knows nothing of what is in it.

The bytes go to a file beside the target, are synced, and take over the name in one step; the folder is synced last,
so that the name survives a power cut too. Until then whatever had the name before is untouched.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import BinaryIO

from scanner_service.storage.exports.errors import ExportNotConfirmed, ExportNotWritten

_NUMBERS = count()


@contextmanager
def whole_file(path: Path) -> Iterator[BinaryIO]:
    """A file to write to, which becomes `path` when the block ends without an exception.

    Raises
    ------
    ExportNotWritten : the file system refused; nothing is left behind.
    ExportNotConfirmed : the new file is in place, but syncing its folder failed.
    """
    path = Path(path)
    beside: Path | None = None
    try:
        beside, descriptor = _open_beside(path)
        with os.fdopen(descriptor, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        beside.replace(path)
    except OSError as error:
        _remove(beside)
        raise ExportNotWritten(f"{path} cannot be written: {error.strerror or error}") from error
    except BaseException:
        _remove(beside)
        raise
    _sync_folder(path)


@contextmanager
def whole_path(path: Path) -> Iterator[Path]:
    """A path beside `path` for a library that wants to open the file itself; renamed as `whole_file` does.

    The block must leave a closed file there. What it leaves beside that one (`-wal`, `-journal`) is removed.

    Raises
    ------
    ExportNotWritten, ExportNotConfirmed : as `whole_file`.
    """
    path = Path(path)
    beside: Path | None = None
    try:
        beside, descriptor = _open_beside(path)
        os.close(descriptor)
        yield beside
        with beside.open("rb") as file:
            os.fsync(file.fileno())
        beside.replace(path)
    except OSError as error:
        _remove(beside)
        raise ExportNotWritten(f"{path} cannot be written: {error.strerror or error}") from error
    except BaseException:
        _remove(beside)
        raise
    finally:
        if beside is not None:
            for ending in ("-wal", "-shm", "-journal"):
                _remove(beside.with_name(beside.name + ending))
    _sync_folder(path)


def write_whole(path: Path, content: bytes) -> None:
    """Write `content` to `path`, whole or not at all.

    Raises
    ------
    ExportNotWritten, ExportNotConfirmed : as `whole_file`.
    """
    with whole_file(path) as file:
        file.write(content)


def _open_beside(path: Path) -> tuple[Path, int]:
    """A new file in the folder of `path`; not a temporary-file function, since those make files private."""
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0) | getattr(os, "O_NOFOLLOW", 0)
    while True:
        beside = path.with_name(f".{path.name[:48]}.{os.getpid()}-{next(_NUMBERS)}.part")
        with suppress(FileExistsError):  # left behind by a process of the same number that was killed
            return beside, os.open(beside, flags, 0o666)


def _remove(beside: Path | None) -> None:
    if beside is not None:
        with suppress(OSError):
            beside.unlink()


def _sync_folder(path: Path) -> None:
    if not hasattr(os, "O_DIRECTORY"):  # Windows: a folder cannot be synced, nor needs to be
        return
    try:
        folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    except OSError as error:
        raise ExportNotConfirmed(f"{path} is written, but its folder could not be synced: {error.strerror}") from error
