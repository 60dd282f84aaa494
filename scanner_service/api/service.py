"""What the routes share: the session book, who may use it, and where files lie; started once, closed once."""

import secrets
import threading
import time
from dataclasses import dataclass
from pathlib import Path

from prometheus_client import CollectorRegistry

from scanner_service.api.access import Access
from scanner_service.api.metrics import metrics_of
from scanner_service.sessions.book import SessionBook
from scanner_service.sessions.readiness import kernels_are_ready, warm_up
from scanner_service.storage.record import Record


@dataclass(frozen=True, slots=True)
class Service:
    """One running service."""

    book: SessionBook
    access: Access
    replay_dir: Path
    metrics: CollectorRegistry

    @property
    def kernels_ready(self) -> bool:
        """True once no scan would wait for a compiler."""
        return kernels_are_ready()

    @classmethod
    def open(cls, data_dir: Path) -> "Service":
        """Open the record and the keys in `data_dir`, and begin to compile the kernels.

        Raises RecordUnusable or KeyStoreError, with nothing left open.
        """
        data_dir.mkdir(parents=True, exist_ok=True, mode=0o700)
        replay_dir = data_dir / "replay"
        replay_dir.mkdir(exist_ok=True)
        record = Record.open(data_dir / "record.sqlite")
        try:
            book = SessionBook(record, replay_dir)
            access = Access.open(data_dir, time.monotonic, secrets.token_bytes)
        except BaseException:
            record.close()
            raise
        threading.Thread(target=warm_up, name="warm-up", daemon=True).start()
        return cls(book, access, replay_dir, metrics_of(book))

    def close(self) -> None:
        """Stop the sessions, write what waits, let go of the record."""
        try:
            self.book.close()
        finally:
            self.book.record.close()
