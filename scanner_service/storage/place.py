"""What the writer needs of the place that holds a record, whichever database it is; knows neither of them."""

from typing import Protocol

from sqlalchemy import Connection, Engine


class StorageFault(Exception):
    """The disk or the database would not do its work; nothing is wrong with what was to be written."""


class Place(Protocol):
    """An opened record: locked by this service, of this version's schema. `name` is fit to be shown."""

    name: str

    def writer_engine(self) -> Engine:
        """An engine for the one connection that writes; what it commits is durable when COMMIT returns."""

    def reader_engine(self) -> Engine:
        """An engine whose connections cannot write."""

    def check(self) -> None:
        """Raise StorageFault when what was committed may not have gone where the record is."""

    def copy_log(self, connection: Connection, *, everything: bool, longest_bytes: int) -> str:
        """Copy a write-ahead log into the record, where the database leaves that to us; what went wrong, or empty."""

    def release(self) -> None:
        """Let another service have the record; the writer's connection is closed."""
