"""The record as an SQLite file: its lock, its making, its checks, its connections; knows no session and no line."""

import contextlib
import fcntl
import os
import sqlite3
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from sqlalchemy import Connection, Engine, create_engine, event, insert
from sqlalchemy.exc import DBAPIError
from sqlalchemy.pool import NullPool, QueuePool

from scanner_service.storage.errors import NotARecord, RecordInUse, RecordNotWritable, RecordTooNew, SqliteTooOld
from scanner_service.storage.migrations import migrate
from scanner_service.storage.place import StorageFault
from scanner_service.storage.tables import APPLICATION_ID, SCHEMA_VERSION, metadata, record

OLDEST_SQLITE = (3, 37, 0)
PAGE_BYTES = 8192
_MAGIC = b"SQLite format 3\0"
_USER_VERSION, _APPLICATION = slice(60, 64), slice(68, 72)  # places in the header of an SQLite file
MOST_VALUE_BYTES = 64 << 20
"""What one row or value of a record that others may have written takes at most; a line takes some hundred kilobytes."""

_ODD_PARTS = "SELECT count(*) FROM main.sqlite_master WHERE type NOT IN ('table', 'index') OR sql LIKE '%VIRTUAL%'"
# SQLite's own reading of the schema, in whatever words that is written: `hidden` is 0 for a column that is stored as is
_ODD_COLUMNS = """
SELECT count(*) FROM pragma_table_list AS part LEFT JOIN pragma_table_xinfo(part.name) AS piece
WHERE part.schema = 'main' AND (part.type <> 'table' OR piece.hidden <> 0)
"""
_WRITER_WAITS_S = 0.2
_READER_WAITS_S = 5.0


@dataclass(frozen=True, slots=True)
class SqliteLibrary:
    """The SQLite in use. `wal_reset_bug`: two connections that write or checkpoint at once may corrupt the file.

    3.7.0 to 3.51.2 have it, but for 3.44.6 and 3.50.7 and later of their lines. Such a library is accepted, because
    here one connection alone writes and checkpoints (`docs/record.md`).
    """

    version: tuple[int, int, int]

    @property
    def wal_reset_bug(self) -> bool:
        """True when the library has the defect."""
        mended = {44: 6, 50: 7}
        minor, patch = self.version[1:]
        return (3, 7, 0) <= self.version < (3, 51, 3) and not (minor in mended and patch >= mended[minor])


def sqlite_library() -> SqliteLibrary:
    """The SQLite library of this Python.

    Raises
    ------
    SqliteTooOld : when it is older than the record was ever tried with.
    """
    major, minor, patch = sqlite3.sqlite_version_info[:3]
    if (major, minor, patch) < OLDEST_SQLITE:
        oldest = ".".join(map(str, OLDEST_SQLITE))
        raise SqliteTooOld(f"this Python has SQLite {sqlite3.sqlite_version}; the record needs {oldest} or newer")
    return SqliteLibrary((major, minor, patch))


class RecordLock:
    """An exclusive flock on a file beside the record, held while the record is open, gone with the process."""

    def __init__(self, record_path: Path) -> None:
        self._path = record_path.with_name(record_path.name + ".lock")
        self._descriptor = self._acquire()

    def _acquire(self) -> int:
        while True:
            descriptor = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                same = os.path.samestat(os.fstat(descriptor), self._path.stat())
            except BlockingIOError as error:
                holder = os.read(descriptor, 32).decode("ascii", "replace").strip() or "unknown"
                os.close(descriptor)
                raise RecordInUse(
                    f"the record is in use by another service (process {holder}); stop it, or choose another record"
                ) from error
            except FileNotFoundError:
                same = False
            if same:
                os.truncate(descriptor, 0)
                os.write(descriptor, f"{os.getpid()}\n".encode())
                return descriptor
            os.close(descriptor)  # its last holder removed the file between our open and our lock: take the new one

    def release(self) -> None:
        """Remove the file while the lock is still held, so that nobody can lock a file that is on its way out."""
        with contextlib.suppress(OSError):
            self._path.unlink()
        os.close(self._descriptor)


@contextlib.contextmanager
def writable(path: Path) -> Iterator[None]:
    """Translate what the operating system says of a place that cannot be written to."""
    try:
        yield
    except OSError as error:
        raise RecordNotWritable(f"the record {path} cannot be written: {error.strerror}") from error


def check_place(path: Path) -> None:
    """Refuse, before anything is touched, a place that cannot hold the record.

    Raises
    ------
    RecordNotWritable : a folder, a missing folder, or a file that may not be written.
    """
    if path.is_dir():
        raise RecordNotWritable(f"{path} is a folder; the record must be a file in it")
    if not path.parent.is_dir():
        raise RecordNotWritable(f"there is no folder {path.parent} for the record; create it first")
    if path.exists() and not path.is_file():
        raise RecordNotWritable(f"{path} is no ordinary file; the record must be one")
    if path.exists() and not os.access(path, os.W_OK):
        raise RecordNotWritable(f"the record {path} may not be written; check its owner and whether the disk is")


def check_identity(connection: sqlite3.Connection, path: Path) -> int:
    """The schema of a record; refuses a database that is none, or not one this version knows.

    Raises
    ------
    NotARecord, RecordTooNew
    """
    try:
        application = connection.execute("PRAGMA application_id").fetchone()[0]
        version = connection.execute("PRAGMA user_version").fetchone()[0]
        connection.execute("PRAGMA trusted_schema=0")
        odd = any(connection.execute(query).fetchone()[0] for query in (_ODD_PARTS, _ODD_COLUMNS))
    except sqlite3.DatabaseError as error:
        raise NotARecord(f"{path} cannot be opened as a record: {error}; choose another file") from error
    except UnicodeDecodeError as error:  # SQLite quotes damaged text in its message
        raise NotARecord(f"{path} cannot be opened as a record: its schema is damaged; choose another file") from error
    _check_marks(application, version, path)
    if odd:  # a view or a computed column in the place of a table runs whatever its author wanted
        raise NotARecord(f"{path} has views, triggers or computed columns, as no record has; choose another file")
    return int(version)


def is_sqlite(path: Path) -> bool:
    """True for a file that begins as SQLite's do; whether it is a record is told by whoever opens it."""
    try:
        with path.open("rb") as file:
            return file.read(len(_MAGIC)) == _MAGIC
    except OSError:
        return False


def check_file(path: Path) -> None:
    """Check the identity of a file without touching it or anything beside it; the caller holds the record's lock.

    The marks are read from the header itself. SQLite could not do it: what a killed service left in the middle of
    copying its log is malformed to a reader that may not look at the log.
    """
    with path.open("rb") as file:
        header = file.read(100)
    ours = header.startswith(_MAGIC) and header[_APPLICATION] == struct.pack(">I", APPLICATION_ID)
    log = path.with_name(path.name + "-wal")
    if not ours and log.is_file() and log.stat().st_size > 0:
        return  # a first page torn by a power cut is mended from the log: whoever connects checks again
    if not ours:
        raise NotARecord(f"{path} is not a record of this service; choose another file")
    _check_marks(APPLICATION_ID, struct.unpack(">i", header[_USER_VERSION])[0], path)


def _check_marks(application: int, version: int, path: Path) -> None:
    if application != APPLICATION_ID:
        raise NotARecord(f"{path} is not a record of this service; choose another file")
    if version > SCHEMA_VERSION:
        raise RecordTooNew(
            f"{path} was written by a newer version (schema {version}, this one knows {SCHEMA_VERSION}); update first"
        )


def create_file(path: Path, created_utc: str) -> None:
    """Make an empty record beside `path` and rename it when it is whole and synced."""
    unfinished = path.with_name(path.name + ".new")
    for leftover in (unfinished, unfinished.with_name(unfinished.name + "-journal")):
        leftover.unlink(missing_ok=True)
    engine = create_engine("sqlite://", creator=lambda: sqlite3.connect(unfinished), poolclass=NullPool)
    try:
        with engine.begin() as connection:
            for pragma in (f"page_size={PAGE_BYTES}", "synchronous=EXTRA"):
                connection.exec_driver_sql(f"PRAGMA {pragma}")
            metadata.create_all(connection)
            row = {"id": 1, "schema_version": SCHEMA_VERSION, "created_utc": created_utc, "batch_number": 0}
            connection.execute(insert(record).values(row))
            for pragma in (f"application_id={APPLICATION_ID}", f"user_version={SCHEMA_VERSION}"):
                connection.exec_driver_sql(f"PRAGMA {pragma}")
    except DBAPIError as error:
        unfinished.unlink(missing_ok=True)
        raise RecordNotWritable(f"the record {path} cannot be made: {error.orig}") from error
    unfinished.rename(path)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


class SqliteFile:
    """A record in a file of its own, opened, locked and of this version's schema."""

    def __init__(self, path: Path, lock: RecordLock, factory: type[sqlite3.Connection]) -> None:
        self.path = path
        self.name = str(path)
        self.library = sqlite_library()
        self._lock = lock
        self._factory = factory
        self._identity = path.stat()

    @classmethod
    def open(cls, path: Path, created_utc: Callable[[], str], factory: type[sqlite3.Connection]) -> "SqliteFile":
        """Open the file, make it when it is not there, and bring an older one up to date.

        Raises
        ------
        RecordUnusable : nothing was changed.
        """
        sqlite_library()
        path = path.resolve()
        with contextlib.ExitStack() as undo:
            with writable(path):
                check_place(path)
                lock = RecordLock(path)  # before the file is looked at: see `docs/record.md`
                undo.callback(lock.release)
                if not path.exists():
                    create_file(path, created_utc())
                check_file(path)
            opened = cls(path, lock, factory)
            try:
                opened._bring_up_to_date()
            except (DBAPIError, sqlite3.Error) as error:
                said = error.orig if isinstance(error, DBAPIError) else error
                raise RecordNotWritable(f"the record {path} cannot be opened: {said}") from error
            undo.pop_all()
        return opened

    def writer_engine(self) -> Engine:
        """See `Place`."""
        return writer_engine(self.path, self._factory)

    def reader_engine(self) -> Engine:
        """See `Place`."""
        return reader_engine(self.path)

    def check(self) -> None:
        """SQLite goes on writing into a file that was removed; what is written there is lost at closing."""
        try:
            same = os.path.samestat(self.path.stat(), self._identity)
        except OSError:
            same = False
        if not same:
            raise StorageFault(f"the file {self.path.name} of the record was removed or replaced; put it back")

    def copy_log(self, connection: Connection, *, everything: bool, longest_bytes: int) -> str:
        """Copy the log into the file; when readers hold up its reuse for too long, wait a little for them."""
        raw = cast("sqlite3.Connection", connection.connection.dbapi_connection)
        try:
            frames, _ = checkpoint(raw, "TRUNCATE" if everything else "PASSIVE")
            if frames * PAGE_BYTES > longest_bytes:
                checkpoint(raw, "RESTART")
        except sqlite3.Error as error:  # what is acknowledged is safe in the log, which grows until this succeeds
            return str(error)
        return ""

    def release(self) -> None:
        """Let others have the file."""
        self._lock.release()

    def _bring_up_to_date(self) -> None:
        """Migrate an older record, in one transaction."""
        with contextlib.closing(writer_engine(self.path, sqlite3.Connection).raw_connection()) as raw:
            if raw.cursor().execute("PRAGMA user_version").fetchone()[0] == SCHEMA_VERSION:
                return
        with writer_engine(self.path, sqlite3.Connection).begin() as connection:
            if migrate(connection):
                connection.exec_driver_sql(f"PRAGMA user_version={SCHEMA_VERSION}")


def structure_problems(connection: Connection) -> Iterator[str]:
    """What SQLite itself finds wrong with the file; it sees no flipped bit of a value."""
    for (message,) in connection.exec_driver_sql("PRAGMA integrity_check"):
        if message != "ok":
            yield str(message)


def used_bytes(connection: Connection) -> int:
    """Bytes of the file that hold something."""
    pages, free = (
        int(connection.exec_driver_sql(f"PRAGMA {name}").scalar_one()) for name in ("page_count", "freelist_count")
    )
    return (pages - free) * PAGE_BYTES


def writer_engine(path: Path, factory: type[sqlite3.Connection]) -> Engine:
    """An engine for the one connection that writes: WAL, FULL, every transaction immediate, checkpoints by hand."""

    def connect() -> sqlite3.Connection:
        connection = _connect(path, "rw", _WRITER_WAITS_S, factory)
        try:
            check_identity(connection, path)
            for pragma in ("journal_mode=WAL", "synchronous=FULL", "fullfsync=1", "wal_autocheckpoint=0"):
                connection.execute(f"PRAGMA {pragma}")
            for pragma in ("checkpoint_fullfsync=1", "foreign_keys=1", "secure_delete=0", "mmap_size=0"):
                connection.execute(f"PRAGMA {pragma}")
            if connection.execute("PRAGMA journal_mode").fetchone()[0] != "wal":
                raise sqlite3.OperationalError("this disk does not support SQLite's write-ahead log")
        except BaseException:
            connection.close()
            raise
        return connection

    engine = create_engine("sqlite://", creator=connect, poolclass=NullPool)
    event.listen(engine, "begin", lambda connection: connection.exec_driver_sql("BEGIN IMMEDIATE"))
    return engine


def reader_engine(path: Path, most_value_bytes: int | None = None) -> Engine:
    """An engine whose connections can neither write nor checkpoint, nor read a longer row or value than is said."""

    def connect() -> sqlite3.Connection:
        connection = _connect(path, "ro", _READER_WAITS_S, sqlite3.Connection)
        if most_value_bytes is not None:
            connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, most_value_bytes)
        connection.execute("PRAGMA trusted_schema=0")
        connection.execute("PRAGMA query_only=1")
        connection.execute("PRAGMA mmap_size=0")
        return connection

    return create_engine("sqlite://", creator=connect, poolclass=QueuePool, pool_size=4, max_overflow=28)


def checkpoint(connection: sqlite3.Connection, mode: str) -> tuple[int, int]:
    """Copy the write-ahead log into the file; the frames in the log, and how many of them are copied."""
    _, frames, copied = connection.execute(f"PRAGMA wal_checkpoint({mode})").fetchone()
    return int(frames), int(copied)


def _connect(path: Path, mode: str, waits_s: float, factory: type[sqlite3.Connection]) -> sqlite3.Connection:
    connection = sqlite3.connect(
        f"{path.as_uri()}?mode={mode}",
        uri=True,
        timeout=waits_s,
        isolation_level=None,
        check_same_thread=False,
        factory=factory,
    )
    connection.text_factory = _text
    return connection


def _text(raw: bytes) -> Any:
    """Text whose bytes were flipped must reach the checksum, not stop the reader."""
    return raw.decode("utf-8", "surrogateescape")
