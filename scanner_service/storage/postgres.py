"""The record as tables of a PostgreSQL database: its lock, its making, its checks, its connections; knows no session.

The lock is an advisory lock of the writer's own connection, so that whoever holds the lock writes, and nobody else. A
server that may forget what it has confirmed (`fsync` or `full_page_writes` off) is refused.
"""

from collections.abc import Callable
from typing import Any

from sqlalchemy import Connection, Engine, create_engine, event, insert, inspect, text, update
from sqlalchemy.engine import URL, make_url
from sqlalchemy.exc import ArgumentError, DBAPIError, NoSuchModuleError
from sqlalchemy.pool import NullPool, QueuePool

from scanner_service.storage.errors import NotARecord, RecordInUse, RecordNotDurable, RecordTooNew
from scanner_service.storage.migrations import migrate, schema_of
from scanner_service.storage.tables import APPLICATION_ID, SCHEMA_VERSION, metadata, record

OLDEST_SERVER = 12
_NUMBERS_A_SERVICE = 1 << 32
_MARK = "record of scanner-service"
_CONNECT: dict[str, Any] = {  # a server that is gone is noticed after seconds, not after hours
    "connect_timeout": 5,
    "tcp_user_timeout": 10_000,
    "keepalives_idle": 5,
    "keepalives_interval": 5,
    "keepalives_count": 2,
}


def is_url(place: object) -> bool:
    """True for an address of a database rather than a path."""
    return isinstance(place, str) and "://" in place


class PostgresSchema:
    """A record in the first schema of the search path of a PostgreSQL database."""

    def __init__(self, url: URL) -> None:
        self._url = url
        self.name = url.set(drivername="postgresql").render_as_string(hide_password=True)

    @classmethod
    def open(cls, address: str, created_utc: Callable[[], str]) -> "PostgresSchema":
        """Open the record at an address, make it in an empty schema, and bring an older one up to date.

        Raises
        ------
        RecordUnusable : nothing was changed.
        """
        opened = cls(_url(address))
        try:
            with opened.writer_engine().begin() as connection:
                opened._check_server(connection)
                if not inspect(connection).has_table(record.name):
                    _make(connection, created_utc())
                _check_identity(connection, opened.name)
                migrate(connection)
                # A service that lost its connection to this one must not take our batches for its own.
                connection.execute(update(record).values(batch_number=record.c.batch_number + _NUMBERS_A_SERVICE))
        except DBAPIError as error:
            raise RecordNotDurable(f"the record {opened.name} cannot be opened: {first_line(error)}") from error
        return opened

    @classmethod
    def of_reader(cls, address: str) -> "PostgresSchema":
        """A record to be read beside a service that may be writing it; raises NotARecord, RecordTooNew."""
        opened = cls(_url(address))
        engine = opened.reader_engine()
        try:
            with engine.connect() as connection:
                if not inspect(connection).has_table(record.name):
                    raise NotARecord(f"there is no record at {opened.name}")
                _check_identity(connection, opened.name)
        except DBAPIError as error:
            raise NotARecord(f"the record {opened.name} cannot be read: {first_line(error)}") from error
        finally:
            engine.dispose()
        return opened

    def writer_engine(self) -> Engine:
        """See `Place`; a connection that does not get the lock is none."""
        engine = create_engine(self._url, poolclass=NullPool, connect_args=_CONNECT, isolation_level="READ COMMITTED")
        event.listen(engine, "connect", self._lock)
        return engine

    def reader_engine(self) -> Engine:
        """See `Place`."""
        return create_engine(
            self._url,
            poolclass=QueuePool,
            pool_size=4,
            max_overflow=28,
            pool_pre_ping=True,
            connect_args={**_CONNECT, "options": "-c default_transaction_read_only=on"},
        )

    def check(self) -> None:
        """What the server has committed is where the record is."""

    def copy_log(self, connection: Connection, *, everything: bool, longest_bytes: int) -> str:
        """The server looks after its own log."""
        return ""

    def release(self) -> None:
        """The lock went with the writer's connection."""

    def _lock(self, raw: Any, _: object) -> None:
        """Take the record for this connection, and make its commits wait for the disk whatever the server's default."""
        raw.autocommit = True
        found = raw.execute("SELECT pg_try_advisory_lock(%s, hashtext(current_schema()))", (APPLICATION_ID,)).fetchone()
        if not found[0]:
            holder = raw.execute(
                "SELECT min(pid) FROM pg_locks WHERE locktype = 'advisory' AND classid = %s AND granted",
                (APPLICATION_ID,),
            ).fetchone()[0]
            raw.close()
            raise RecordInUse(
                f"the record {self.name} is in use by another service (server process {holder}); "
                "stop it, or choose another record"
            )
        raw.execute("SET synchronous_commit = on")
        raw.execute("SET idle_in_transaction_session_timeout = 60000")
        raw.autocommit = False

    def _check_server(self, connection: Connection) -> None:
        said = {
            name: connection.execute(text("SELECT current_setting(:name)"), {"name": name}).scalar_one()
            for name in ("server_version_num", "fsync", "full_page_writes", "server_encoding")
        }
        if int(said["server_version_num"]) < OLDEST_SERVER * 10_000:
            raise RecordNotDurable(f"the server of {self.name} is older than PostgreSQL {OLDEST_SERVER}; update it")
        for name in ("fsync", "full_page_writes"):
            if said[name] != "on":
                raise RecordNotDurable(
                    f"the server of {self.name} runs with {name} = {said[name]} and may lose what it confirms; "
                    f"set {name} = on"
                )
        if said["server_encoding"] != "UTF8":
            raise RecordNotDurable(f"the database of {self.name} must be in UTF8, not {said['server_encoding']}")


def first_line(error: DBAPIError) -> str:
    """What the server said, as one line."""
    return str(error.orig).strip().splitlines()[0] if str(error.orig).strip() else type(error.orig).__name__


def _url(address: str) -> URL:
    """The address for the driver in use; what belongs to another database, or is none, is refused."""
    try:
        url = make_url(address)
        if url.drivername not in ("postgresql", "postgres", "postgresql+psycopg"):
            raise NotARecord(f"a record lies in a file or at postgresql://…, not at {url.drivername}://…")
        url = url.set(drivername="postgresql+psycopg")
        url.get_dialect().import_dbapi()
    except (ArgumentError, NoSuchModuleError) as error:
        raise NotARecord("the address of the record is no postgresql://user@host/database") from error
    except ImportError as error:
        raise NotARecord("a record in PostgreSQL needs a driver: .venv/bin/pip install -e '.[postgres]'") from error
    return url


def _make(connection: Connection, created_utc: str) -> None:
    taken = set(inspect(connection).get_table_names()) & set(metadata.tables)
    if taken:
        raise NotARecord(f"the database has tables of another program ({', '.join(sorted(taken))}); choose another")
    metadata.create_all(connection)
    row = {"id": 1, "schema_version": SCHEMA_VERSION, "created_utc": created_utc, "batch_number": 0}
    connection.execute(insert(record).values(row))
    connection.exec_driver_sql(f"COMMENT ON TABLE record IS '{_MARK}'")


def _check_identity(connection: Connection, name: str) -> None:
    mark = connection.execute(text("SELECT obj_description('record'::regclass, 'pg_class')")).scalar()
    if mark != _MARK:
        raise NotARecord(f"{name} holds a table `record` of another program; choose another database")
    version = schema_of(connection)
    if version > SCHEMA_VERSION:
        raise RecordTooNew(
            f"{name} was written by a newer version (schema {version}, this one knows {SCHEMA_VERSION}); update first"
        )
