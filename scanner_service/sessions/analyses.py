"""Analyses that are asked for: one after the other on a thread of its own, bounded; knows no HTTP."""

import logging
import queue
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Literal

import numpy as np

from drivers.scanline import Float64Array, read_only
from scanner_service.analysis.errors import AnalysisError
from scanner_service.analysis.method_analysis import MethodAnswer, analyse_by_method
from scanner_service.analysis.normals.field import NormalOptions
from scanner_service.sessions.errors import AnalysesBusy, AnalysisNotDone, AnalysisUnknown, SessionError
from scanner_service.storage.errors import RecordError
from scanner_service.storage.formats.errors import FormatError

_LOG = logging.getLogger(__name__)
MAX_WAITING = 8
MAX_KEPT = 16
MAX_POINTS = 2_000_000
"""Points of one analysis, and twice that in all results that are kept."""

State = Literal["waiting", "running", "done", "failed"]


@dataclass(frozen=True, slots=True)
class AnalysisPoints:
    """Points (n, 3) in mm to work on, and where their normals are turned to: (3,), (n, 3), or None for unknown."""

    points_mm: Float64Array
    towards_mm: Float64Array | None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class AnalysisRequest:
    """A method with its options on something that is read when the analysis begins; `source` names it.

    With `orient` the normals are turned to one side of the surface, not towards a place.
    """

    method: str
    options: NormalOptions
    source: dict[str, str]
    read: Callable[[], AnalysisPoints]
    orient: bool = False


@dataclass(frozen=True, slots=True)
class AnalysisJob:
    """An analysis as it stands; `progress` runs from 0 to 1, `message` says why it failed."""

    job_id: str
    method: str
    source: dict[str, str]
    created_utc: str
    state: State
    progress: float = 0.0
    message: str | None = None
    points: int = 0
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class AnalysisResult:
    """Points (n, 3) in mm and what the method says of them."""

    points_mm: Float64Array
    answer: MethodAnswer


class _Cancelled(Exception):
    """Somebody does not want the answer any more."""


class AnalysisBook:
    """The analyses of one service. Its methods may be called from any thread."""

    def __init__(self, now: Callable[[], datetime] = lambda: datetime.now(UTC)) -> None:
        self._now = now
        self._lock = threading.Lock()
        self._jobs: dict[str, AnalysisJob] = {}
        self._results: dict[str, AnalysisResult] = {}
        self._waiting: queue.Queue[tuple[str, AnalysisRequest] | None] = queue.Queue()
        self._number = 0
        self._thread: threading.Thread | None = None
        self._closing = False

    def begin(self, request: AnalysisRequest) -> AnalysisJob:
        """Take an analysis in; it runs when those before it are done.

        Raises
        ------
        AnalysesBusy : MAX_WAITING are waiting already, or the service is ending.
        """
        with self._lock:
            waiting = sum(job.state == "waiting" for job in self._jobs.values())
            if waiting >= MAX_WAITING or self._closing:
                raise AnalysesBusy(f"{waiting} analyses are waiting already: ask again when one is done")
            self._number += 1
            job = AnalysisJob(
                job_id=f"a{self._number}",
                method=request.method,
                source=request.source,
                created_utc=self._now().isoformat(timespec="milliseconds"),
                state="waiting",
            )
            self._jobs[job.job_id] = job
            self._forget_old()
            self._waiting.put((job.job_id, request))
            if self._thread is None:
                self._thread = threading.Thread(target=self._work, name="analyses", daemon=True)
                self._thread.start()
            return job

    def jobs(self) -> list[AnalysisJob]:
        """All that are known, newest first; at most MAX_KEPT, and those that wait."""
        with self._lock:
            return list(reversed(self._jobs.values()))

    def get(self, job_id: str) -> AnalysisJob:
        """One analysis as it stands; raises AnalysisUnknown."""
        with self._lock:
            return self._known(job_id)

    def result(self, job_id: str) -> AnalysisResult:
        """Its points and answer; raises AnalysisUnknown, AnalysisNotDone."""
        with self._lock:
            job = self._known(job_id)
            if job_id not in self._results:
                raise AnalysisNotDone(
                    f"the analysis is {job.state}" + (f": {job.message}" if job.message else ", so it has no result")
                )
            return self._results[job_id]

    def forget(self, job_id: str) -> None:
        """Drop an analysis with its result; one that runs ends at its next step. Raises AnalysisUnknown."""
        with self._lock:
            self._known(job_id)
            del self._jobs[job_id]
            self._results.pop(job_id, None)

    def close(self) -> None:
        """Let nothing further begin, and let what runs end at its next step."""
        with self._lock:
            self._closing = True
            self._jobs.clear()
            self._results.clear()
        self._waiting.put(None)

    # -- the thread -------------------------------------------------------------------------------------------------

    def _work(self) -> None:
        while (item := self._waiting.get()) is not None:
            job_id, request = item
            try:
                self._run(job_id, request)
            except _Cancelled:
                _LOG.info("analysis %s is not wanted any more", job_id)
            except (AnalysisError, SessionError, RecordError, FormatError, ValueError) as error:
                self._change(job_id, state="failed", message=str(error))
            except MemoryError:
                self._change(job_id, state="failed", message="the memory does not suffice: analyse fewer points")
            except Exception as error:  # noqa: BLE001 - the thread's loop: the next analysis must still be served
                _LOG.exception("analysis %s failed", job_id)
                self._change(job_id, state="failed", message=f"an internal fault: {type(error).__name__}")

    def _run(self, job_id: str, request: AnalysisRequest) -> None:
        self._progress(job_id, 0.0)
        self._change(job_id, state="running")
        found = request.read()
        count = len(found.points_mm)
        if count > MAX_POINTS:
            raise ValueError(f"at most {MAX_POINTS:,} points are analysed, there are {count:,}: take a part of them")
        self._change(job_id, points=count, notes=found.notes)
        answer = analyse_by_method(
            found.points_mm,
            request.method,
            request.options,
            towards_mm=found.towards_mm,
            orient=request.orient,
            tell=lambda share: self._progress(job_id, share),
        )
        points = np.array(found.points_mm)
        read_only(points)
        with self._lock:
            if job_id in self._jobs:
                self._results[job_id] = AnalysisResult(points, answer)
                notes = (*found.notes, *answer.notes)
                self._jobs[job_id] = replace(self._jobs[job_id], state="done", progress=1.0, notes=notes)
                self._forget_old()

    def _progress(self, job_id: str, share: float) -> None:
        with self._lock:
            if job_id not in self._jobs:
                raise _Cancelled
            self._jobs[job_id] = replace(self._jobs[job_id], progress=min(max(share, 0.0), 1.0))

    def _change(
        self,
        job_id: str,
        *,
        state: State | None = None,
        message: str | None = None,
        points: int | None = None,
        notes: tuple[str, ...] | None = None,
    ) -> None:
        with self._lock:
            job = self._jobs.get(job_id)
            if job is not None:
                self._jobs[job_id] = replace(
                    job,
                    state=state or job.state,
                    message=message or job.message,
                    points=job.points if points is None else points,
                    notes=job.notes if notes is None else notes,
                )

    # -- under the lock ---------------------------------------------------------------------------------------------

    def _known(self, job_id: str) -> AnalysisJob:
        job = self._jobs.get(job_id)
        if job is None:
            raise AnalysisUnknown(f"there is no analysis {job_id[:40]}; newer ones may have needed its room")
        return job

    def _forget_old(self) -> None:
        """Drop the oldest that are over, until few enough are left and their points are bounded."""
        over = [job.job_id for job in self._jobs.values() if job.state not in ("waiting", "running")]
        held = sum(len(result.points_mm) for result in self._results.values())
        while over and (len(over) > MAX_KEPT or held > 2 * MAX_POINTS):
            gone = over.pop(0)
            held -= len(self._results[gone].points_mm) if gone in self._results else 0
            self._results.pop(gone, None)
            del self._jobs[gone]
