"""What the routes share: the session book, who may use it, and where files lie; started once, closed once."""

import logging
import secrets
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

from prometheus_client import CollectorRegistry

from scanner_service.api.access import Access
from scanner_service.api.metrics import metrics_of
from scanner_service.sessions.analyses import AnalysisBook
from scanner_service.sessions.book import SessionBook
from scanner_service.sessions.errors import SessionError
from scanner_service.sessions.export_desk import ExportDesk
from scanner_service.sessions.file_shelf import FileShelf
from scanner_service.sessions.kernel_caches import mark_used
from scanner_service.sessions.readiness import Preparing, kernels_are_ready, preparing, refuse_until_ready, warm_up
from scanner_service.sessions.retention import Retention
from scanner_service.storage.errors import RecordError, RecordUnusable
from scanner_service.storage.reader import RecordReader
from scanner_service.storage.record import Record
from scanner_service.storage.rows import Limits

_LOG = logging.getLogger(__name__)
RETENTION_PERIOD_S = 3600.0


@dataclass(frozen=True, slots=True)
class Service:
    """One running service."""

    book: SessionBook
    access: Access
    replay_dir: Path
    metrics: CollectorRegistry
    exports: ExportDesk
    shelf: FileShelf
    closing: threading.Event
    analyses: AnalysisBook = field(default_factory=AnalysisBook)

    @property
    def kernels_ready(self) -> bool:
        """True once no scan would wait for a compiler."""
        return kernels_are_ready()

    @property
    def preparing(self) -> Preparing | None:
        """What is being compiled just now."""
        return preparing()

    @classmethod
    def open(
        cls,
        data_dir: Path,
        record_at: str | None = None,
        retention: Retention | None = None,
        limits: Limits | None = None,
    ) -> "Service":
        """Open the record and the keys in `data_dir`, and begin to compile the kernels.

        `record_at` is the address of a database, or a file, for the record to be elsewhere.

        Raises RecordUnusable or KeyStoreError, with nothing left open.
        """
        replay_dir = data_dir / "replay"
        try:
            data_dir.mkdir(parents=True, exist_ok=True, mode=0o700)
            replay_dir.mkdir(exist_ok=True)
        except OSError as error:
            raise RecordUnusable(f"{data_dir} cannot be the folder of the data: {error.strerror}") from error
        record = Record.open(record_at or data_dir / "record.sqlite", limits=limits)
        try:
            book = SessionBook(
                record, retention, meshes=replay_dir, rigs=data_dir / "rigs", check_ready=refuse_until_ready
            )
            access = Access.open(data_dir, time.monotonic, secrets.token_bytes)
            exports = ExportDesk(
                data_dir / "exports",
                lambda: RecordReader.open(record_at or data_dir / "record.sqlite"),
                meshes=replay_dir,
            )
            shelf = FileShelf(replay_dir, data_dir / "arriving")
        except BaseException:
            record.close()
            raise
        threading.Thread(target=warm_up, name="warm-up", daemon=True).start()
        service = cls(book, access, replay_dir, metrics_of(book), exports, shelf, threading.Event())
        threading.Thread(target=service._keep_to_the_retention, name="retention", daemon=True).start()
        return service

    def _keep_to_the_retention(self) -> None:
        """The retention's thread: at the start, and every hour."""
        while True:
            mark_used()  # of the kernels, which other programs may tidy up meanwhile
            try:
                self.book.make_room_on_disk()
            except (SessionError, RecordError, TimeoutError) as error:
                _LOG.warning("%s", error)
            if self.closing.wait(RETENTION_PERIOD_S):
                return

    def close(self) -> None:
        """Stop the sessions, write what waits, let go of the record."""
        self.closing.set()
        self.analyses.close()
        try:
            self.exports.close()
            self.book.close()
        finally:
            self.book.record.close()
