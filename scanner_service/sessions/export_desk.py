"""Exports that take their time: one thread writes them one after another, and tells how far it is; knows no HTTP."""

import contextlib
import logging
import queue
import secrets
import shutil
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from scanner_service.sessions.errors import SessionBusy, SourceUnusable
from scanner_service.sessions.exporting import check_formats, export_session
from scanner_service.storage.exports.manifest import MANIFEST
from scanner_service.storage.reader import RecordReader

_LOG = logging.getLogger(__name__)
MOST_WAITING = 8
MOST_KEPT = 16


@dataclass(frozen=True, slots=True)
class ExportJob:
    """One export: `state` is waiting, writing, done or failed; `share` of what is being done (`doing`) is done.

    `manifest` is there when it is done, `failure` says why it failed.
    """

    job_id: str
    session_id: str
    formats: tuple[str, ...]
    state: str = "waiting"
    doing: str = ""
    share: float = 0.0
    failure: str | None = None
    manifest: dict[str, Any] | None = None

    @property
    def files(self) -> tuple[str, ...]:
        """Names of the files that are there, the manifest last."""
        return () if self.manifest is None else (*self.manifest["files"], MANIFEST)


class ExportDesk:
    """Takes orders for exports and keeps the newest of them; all methods may be called from any thread.

    The folder belongs to the desk: what an earlier process left in it is removed. `open_reader` opens the record for
    one export, so that a long one holds nobody up.
    """

    def __init__(
        self,
        folder: Path,
        open_reader: Callable[[], RecordReader],
        clock: Callable[[], datetime] = lambda: datetime.now(UTC),
        meshes: Path | None = None,
    ) -> None:
        self._folder = folder
        self._open_reader = open_reader
        self._clock = clock
        self._meshes = meshes  # the folder in which reference meshes lie
        self._jobs: dict[str, ExportJob] = {}
        self._lock = threading.Lock()
        self._waiting: queue.Queue[str | None] = queue.Queue()
        self._stopping = threading.Event()
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        self._thread = threading.Thread(target=self._run, name="exports", daemon=True)
        self._thread.start()

    def order(self, session_id: str, formats: Sequence[str]) -> ExportJob:
        """Have a session exported.

        Raises
        ------
        FormatNotWritten, ExtraMissing : at once; nothing was ordered.
        SessionUnknown : there is no such session.
        SessionBusy : too many exports wait already.
        """
        check_formats(formats)
        with contextlib.closing(self._open_reader()) as reader:
            reader.get_session(session_id)
        job = ExportJob(secrets.token_hex(8), session_id, tuple(dict.fromkeys(formats)))
        with self._lock:
            if sum(one.state in ("waiting", "writing") for one in self._jobs.values()) >= MOST_WAITING:
                raise SessionBusy(f"{MOST_WAITING} exports wait already: take one of them back, or wait")
            self._jobs[job.job_id] = job
            over = [one.job_id for one in self._jobs.values() if one.state in ("done", "failed")]
            for old in over[: max(0, len(self._jobs) - MOST_KEPT)]:
                self._forget(old)
        self._waiting.put(job.job_id)
        return job

    def jobs(self, session_id: str) -> list[ExportJob]:
        """The exports of a session that are kept, the newest first."""
        with self._lock:
            return [job for job in reversed(self._jobs.values()) if job.session_id == session_id]

    def job(self, session_id: str, job_id: str) -> ExportJob:
        """One export of a session; raises SourceUnusable when there is none, or no longer."""
        job = self._jobs.get(job_id)
        if job is None or job.session_id != session_id:
            raise SourceUnusable(f"there is no export {job_id} of this session; it may have made room for newer ones")
        return job

    def file(self, session_id: str, job_id: str, name: str) -> Path:
        """The path of one file of an export; raises SourceUnusable when it holds none of that name."""
        job = self.job(session_id, job_id)
        if name not in job.files:
            raise SourceUnusable(f"export {job_id} holds no file {name}; it holds {', '.join(job.files) or 'none yet'}")
        return self._folder / job_id / name

    def take_back(self, session_id: str, job_id: str) -> None:
        """Forget an export and remove its files; one that is being written ends at its next step."""
        self.job(session_id, job_id)
        with self._lock:
            self._forget(job_id)

    def close(self) -> None:
        """End the thread, and what it is writing; idempotent."""
        self._stopping.set()
        self._waiting.put(None)
        self._thread.join()

    # -- inside ----------------------------------------------------------------------------------------------------

    def _forget(self, job_id: str) -> None:
        self._jobs.pop(job_id, None)
        shutil.rmtree(self._folder / job_id, ignore_errors=True)

    def _run(self) -> None:
        while (job_id := self._waiting.get()) is not None and not self._stopping.is_set():
            try:
                self._write(job_id)
            except _TakenBack:
                shutil.rmtree(self._folder / job_id, ignore_errors=True)
            except Exception as error:  # noqa: BLE001 - the thread's loop: whoever ordered it is told
                _LOG.warning("export %s failed: %s", job_id, error)
                with contextlib.suppress(_TakenBack):
                    self._tell(job_id, state="failed", failure=str(error) or type(error).__name__)
                shutil.rmtree(self._folder / job_id, ignore_errors=True)

    def _write(self, job_id: str) -> None:
        job = self._tell(job_id, state="writing")
        with contextlib.closing(self._open_reader()) as reader:
            row = reader.get_session(job.session_id)
            manifest = export_session(
                reader,
                row,
                job.formats,
                self._folder / job_id,
                self._clock(),
                lambda doing, share: self._tell(job_id, doing=doing, share=share),
                meshes=self._meshes,
            )
        self._tell(job_id, state="done", doing="", share=1.0, manifest=manifest)

    def _tell(self, job_id: str, **changes: Any) -> ExportJob:
        """Change what is said of a job; raises _TakenBack when nobody wants it any more."""
        with self._lock:
            if job_id not in self._jobs or self._stopping.is_set():
                raise _TakenBack
            job = replace(self._jobs[job_id], **changes)
            self._jobs[job_id] = job
            return job


class _TakenBack(Exception):
    """The export that is being written is wanted no more."""
