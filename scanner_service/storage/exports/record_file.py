"""One session as a record of its own in one file: rows are copied as they are, checksums included; decodes no line.

Such a file is a record like any other, so that it opens, replays and verifies wherever the service does.
"""

import sqlite3
from collections.abc import Callable
from pathlib import Path

from sqlalchemy import NullPool, create_engine, event, insert
from sqlalchemy.exc import DBAPIError

from scanner_service.storage.database import create_file
from scanner_service.storage.exports.errors import ExportNotWritten
from scanner_service.storage.exports.whole_file import whole_path
from scanner_service.storage.reader import RecordReader
from scanner_service.storage.rows import SessionRow
from scanner_service.storage.tables import lines


def write_session_record(
    path: Path, reader: RecordReader, row: SessionRow, on_share: Callable[[float], object] = lambda share: None
) -> None:
    """Copy a session into a new record at `path`, whole or not at all; the session keeps its id.

    A damaged row is copied as it is: it is found damaged in the copy too.

    Raises
    ------
    RecordUnreadable : the record cannot be read.
    ExportNotWritten, ExportNotConfirmed, RecordNotWritable : the file system refused.
    """
    total = max(reader.count(row.session_id).lines, 1)
    with whole_path(path) as beside:
        beside.unlink()
        create_file(beside, row.created_utc)
        engine = create_engine("sqlite://", creator=lambda: _connect(beside), poolclass=NullPool)
        event.listen(engine, "begin", lambda connection: connection.exec_driver_sql("BEGIN"))
        try:
            with engine.connect() as into:
                for table, rows in reader.stored_rows(row.session_id):
                    into.execute(insert(table), rows)
                    if table is lines:
                        on_share(min(1.0, (rows[-1]["line_number"] + 1) / total))
                into.commit()
        except DBAPIError as error:
            raise ExportNotWritten(f"{path} cannot be written: {error.orig}") from error
        except UnicodeEncodeError as error:
            raise ExportNotWritten(
                f"session {row.session_id} holds damaged text that cannot be copied; copy the whole record file instead"
            ) from error
        finally:
            engine.dispose()


def _connect(path: Path) -> sqlite3.Connection:
    connection = sqlite3.connect(path, isolation_level=None)
    connection.execute("PRAGMA synchronous=OFF")  # the file is synced as a whole before it is renamed
    return connection
