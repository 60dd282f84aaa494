"""A disk between SQLite and the operating system, in this process: it keeps a log of all that is written and synced,
and fails where it is told to. Knows SQLite's file interface, nothing of the record.

It wraps the file layer (VFS) of the very library that Python's own `sqlite3` uses, and becomes its default: the record
runs over it unchanged. Where that library cannot be reached (linked into Python), `available` says why not.
"""

import ctypes
import os
import sqlite3
import threading
from collections import Counter
from collections.abc import Callable
from contextlib import contextmanager
from ctypes import CFUNCTYPE, POINTER, c_char_p, c_int, c_int64, c_void_p
from dataclasses import dataclass, field
from pathlib import Path

SQLITE_OK = 0
ERRORS = {
    "full": 13,
    "read_only": 8,
    "cannot_open": 14,
    "io_read": 10 | 1 << 8,
    "io_write": 10 | 3 << 8,
    "io_sync": 10 | 4 << 8,
    "io_truncate": 10 | 6 << 8,
    "io_size": 10 | 7 << 8,
    "io_lock": 10 | 15 << 8,
    "io_delete": 10 | 10 << 8,
    "io_access": 10 | 13 << 8,
    "io_shm_map": 10 | 21 << 8,
}
_MAIN_DB, _JOURNAL, _WAL = 0x100, 0x800, 0x80000


class _Vfs(ctypes.Structure):
    _fields_ = [
        ("iVersion", c_int),
        ("szOsFile", c_int),
        ("mxPathname", c_int),
        ("pNext", c_void_p),
        ("zName", c_char_p),
        ("pAppData", c_void_p),
        *((name, c_void_p) for name in ("xOpen", "xDelete", "xAccess", "xFullPathname", "xDlOpen", "xDlError")),
        *((name, c_void_p) for name in ("xDlSym", "xDlClose", "xRandomness", "xSleep", "xCurrentTime")),
        *((name, c_void_p) for name in ("xGetLastError", "xCurrentTimeInt64", "xSetSystemCall", "xGetSystemCall")),
        ("xNextSystemCall", c_void_p),
    ]


class _Methods(ctypes.Structure):
    _fields_ = [
        ("iVersion", c_int),
        *((name, c_void_p) for name in ("xClose", "xRead", "xWrite", "xTruncate", "xSync", "xFileSize", "xLock")),
        *((name, c_void_p) for name in ("xUnlock", "xCheckReservedLock", "xFileControl", "xSectorSize")),
        *((name, c_void_p) for name in ("xDeviceCharacteristics", "xShmMap", "xShmLock", "xShmBarrier")),
        *((name, c_void_p) for name in ("xShmUnmap", "xFetch", "xUnfetch")),
    ]


_OPEN = CFUNCTYPE(c_int, c_void_p, c_void_p, c_void_p, c_int, c_void_p)
_DELETE = CFUNCTYPE(c_int, c_void_p, c_char_p, c_int)
_ACCESS = CFUNCTYPE(c_int, c_void_p, c_char_p, c_int, c_void_p)
_OF_FILE = {
    "xClose": CFUNCTYPE(c_int, c_void_p),
    "xRead": CFUNCTYPE(c_int, c_void_p, c_void_p, c_int, c_int64),
    "xWrite": CFUNCTYPE(c_int, c_void_p, c_void_p, c_int, c_int64),
    "xTruncate": CFUNCTYPE(c_int, c_void_p, c_int64),
    "xSync": CFUNCTYPE(c_int, c_void_p, c_int),
    "xFileSize": CFUNCTYPE(c_int, c_void_p, c_void_p),
    "xLock": CFUNCTYPE(c_int, c_void_p, c_int),
    "xShmMap": CFUNCTYPE(c_int, c_void_p, c_int, c_int, c_int, c_void_p),
}
FAULTS_OF = {
    "xOpen": ("cannot_open", "full"),
    "xDelete": ("io_delete",),
    "xAccess": ("io_access",),
    "xRead": ("io_read",),
    "xWrite": ("full", "io_write", "read_only"),
    "xTruncate": ("io_truncate",),
    "xSync": ("io_sync", "full"),
    "xFileSize": ("io_size",),
    "xLock": ("io_lock",),
    "xShmMap": ("io_shm_map", "full"),
}
"""Every call that is made to fail, and how."""


@dataclass(frozen=True, slots=True)
class Entry:
    """One line of the log: `create`, `write`, `truncate`, `sync`, `sync_failed`, `delete` of a file, or a `mark`."""

    kind: str
    path: str = ""
    offset: int = 0
    data: bytes = b""
    mark: object = None


@dataclass
class Disk:
    """The disk in use. `fails(call, path)` names an error for a call, or None; `log` is kept when `is_logging`."""

    fails: Callable[[str, str], str | None] = lambda call, path: None
    is_logging: bool = False
    log: list[Entry] = field(default_factory=list)
    calls: "Counter[str]" = field(default_factory=Counter)
    lock: threading.RLock = field(default_factory=threading.RLock)

    def mark(self, what: object) -> None:
        """Put something of one's own into the log, after all that happened before."""
        with self.lock:
            self.log.append(Entry("mark", mark=what))

    def note(self, kind: str, path: str, offset: int = 0, data: bytes = b"") -> None:
        """Put what was done to a file into the log."""
        if self.is_logging:
            self.log.append(Entry(kind, path, offset, data))


class _Shim:
    """The VFS in front of the library's own; made once a process and never taken away."""

    def __init__(self, library: ctypes.CDLL) -> None:
        self.disk = Disk()
        library.sqlite3_vfs_find.restype = POINTER(_Vfs)
        library.sqlite3_vfs_find.argtypes = [c_char_p]
        library.sqlite3_vfs_register.argtypes = [POINTER(_Vfs), c_int]
        self.library = library
        self.original = library.sqlite3_vfs_find(None)
        self.vfs = _Vfs.from_buffer_copy(self.original.contents)
        self.vfs.zName = b"disk"
        self.vfs.pNext = None
        found = self.original.contents
        self._open, self._delete, self._access = (
            _OPEN(found.xOpen), _DELETE(found.xDelete), _ACCESS(found.xAccess),
        )  # fmt: skip
        self._kept = [_OPEN(self.open), _DELETE(self.delete), _ACCESS(self.access)]
        for name, function in zip(("xOpen", "xDelete", "xAccess"), self._kept, strict=True):
            setattr(self.vfs, name, ctypes.cast(function, c_void_p).value)
        self.files: dict[int, str] = {}
        self._tables: dict[int, _Methods] = {}

    def register(self, as_default: bool) -> None:
        """Become the default, or stand back behind the library's own."""
        if as_default:
            self.library.sqlite3_vfs_register(ctypes.byref(self.vfs), 1)
        else:
            self.library.sqlite3_vfs_register(self.original, 1)

    def fault(self, call: str, path: str) -> int:
        """The error that this call is to meet, 0 for none."""
        self.disk.calls[call] += 1
        name = self.disk.fails(call, path)
        return SQLITE_OK if name is None else ERRORS[name]

    def open(self, _vfs: int, name: int, file: int, flags: int, out_flags: int) -> int:
        path = os.fsdecode(ctypes.string_at(name)) if name else ""
        with self.disk.lock:
            error = self.fault("xOpen", path)
            if error:
                c_void_p.from_address(file).value = None  # no methods: SQLite then does not close it
                return error
            is_new = not Path(path).exists() if path else False
            result = self._open(ctypes.addressof(self.original.contents), name, file, flags, out_flags)
            if result == SQLITE_OK and flags & (_MAIN_DB | _JOURNAL | _WAL):
                self.files[file] = path
                slot = c_void_p.from_address(file)
                slot.value = self.methods(slot.value)
                if is_new:
                    self.disk.note("create", path)
            return int(result)

    def delete(self, _vfs: int, name: bytes, sync_folder: int) -> int:
        path = os.fsdecode(name)
        with self.disk.lock:
            error = self.fault("xDelete", path)
            if error:
                return error
            result = self._delete(ctypes.addressof(self.original.contents), name, sync_folder)
            if result == SQLITE_OK:
                self.disk.note("delete", path, sync_folder)
            return int(result)

    def access(self, _vfs: int, name: bytes, flags: int, out: int) -> int:
        error = self.fault("xAccess", os.fsdecode(name))
        return error or int(self._access(ctypes.addressof(self.original.contents), name, flags, out))

    def methods(self, original: int | None) -> int:
        """The address of a table like the one at `original`, with our calls in it."""
        assert original is not None
        if original not in self._tables:
            table = _Methods.from_buffer_copy(_Methods.from_address(original))
            for name, kind in _OF_FILE.items():
                if getattr(table, name) is None:  # a log has no shared memory
                    continue
                real = kind(getattr(table, name))
                ours = kind(self.calling(name, real))
                self._kept.append(ours)
                setattr(table, name, ctypes.cast(ours, c_void_p).value)
            self._tables[original] = table
        return ctypes.addressof(self._tables[original])

    def calling(self, name: str, real: Callable[..., int]) -> Callable[..., int]:
        """One call of a file: fail, or do it and keep it in the log."""

        def call(file: int, *arguments: int) -> int:
            if name == "xClose":
                self.files.pop(file, None)
                return int(real(file))
            with self.disk.lock:
                path = self.files.get(file, "")
                error = self.fault(name, path)
                if error:
                    if name == "xSync":
                        self.disk.note("sync_failed", path)
                    return error
                result = int(real(file, *arguments))
                if result == SQLITE_OK and self.disk.is_logging:
                    match name:
                        case "xWrite":
                            address, size, offset = arguments
                            self.disk.note("write", path, offset, ctypes.string_at(address, size))
                        case "xTruncate":
                            self.disk.note("truncate", path, arguments[0])
                        case "xSync":
                            self.disk.note("sync", path)
                return result

        return call


def available() -> str:
    """Empty when the disk can be put under Python's SQLite, else why not."""
    try:
        return "" if _library() is not None else "the SQLite library of this Python is part of it"
    except OSError as error:
        return f"the SQLite library of this Python cannot be reached: {error}"


def _library() -> ctypes.CDLL | None:
    library = ctypes.CDLL("libsqlite3.so.0")  # the library already in use, if Python's own module is linked to it
    library.sqlite3_libversion.restype = c_char_p
    maps = Path("/proc/self/maps").read_text() if Path("/proc/self/maps").exists() else ""
    import _sqlite3

    linked = b"libsqlite3.so" in Path(_sqlite3.__file__).read_bytes() and "libsqlite3.so" in maps
    return library if linked and library.sqlite3_libversion().decode() == sqlite3.sqlite_version else None


_SHIM: list[_Shim] = []


@contextmanager
def disk_under_sqlite(disk: Disk):
    """Put `disk` under every database that this process opens within the block."""
    if not _SHIM:
        library = _library()
        assert library is not None, available()
        _SHIM.append(_Shim(library))
    shim = _SHIM[0]
    shim.disk = disk
    shim.register(True)
    try:
        yield disk
    finally:
        shim.register(False)
        shim.disk = Disk()
