"""From one version of the schema to the next, one step each; knows no file, no server and no lock."""

from collections.abc import Callable, Mapping

from sqlalchemy import Connection, select, update

from scanner_service.storage.tables import SCHEMA_VERSION, creations, ledgers, notes, record


def _to_2(connection: Connection) -> None:
    """Notes and calibration, ledgers, and requests that created: tables beside those of schema 1, which stay."""
    for table in (notes, ledgers, creations):
        table.create(connection)


def _to_3(connection: Connection) -> None:
    """Lines may be packed from here on: no table changes, and versions that cannot read them are kept away."""


STEPS: Mapping[int, Callable[[Connection], None]] = {2: _to_2, 3: _to_3}
"""Step n leads from schema n - 1 to schema n; all of them run in the transaction of the caller."""


def schema_of(connection: Connection) -> int:
    """The version of the schema that the record says it has."""
    return int(connection.execute(select(record.c.schema_version)).scalar_one())


def migrate(connection: Connection) -> bool:
    """Bring a record up to this version's schema; True when there was anything to do."""
    found = schema_of(connection)
    if found >= SCHEMA_VERSION:
        return False
    for version in range(found + 1, SCHEMA_VERSION + 1):
        STEPS[version](connection)
    connection.execute(update(record).values(schema_version=SCHEMA_VERSION))
    return True
