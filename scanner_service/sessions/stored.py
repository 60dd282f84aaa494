"""A session as its record tells it: rebuilt, judged and hashed without a service; changes nothing in the record."""

from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from scanner_service.analysis.intake import StoredLine
from scanner_service.analysis.live_map import LiveMap
from scanner_service.analysis.passes import PassKey, pass_key
from scanner_service.analysis.snapshot import MapSnapshot, Unreliable
from scanner_service.rescan.followed import RegionBook
from scanner_service.sessions.calibration import calibration_after, geometry_from, towards_sensor_from
from scanner_service.sessions.fingerprint import RawHash
from scanner_service.sessions.ledger import Ledger
from scanner_service.sessions.left_regions import last_left
from scanner_service.sessions.named import named_session
from scanner_service.sessions.references import nominal_of
from scanner_service.sessions.results import Results, judge
from scanner_service.sessions.settings import SessionSettings
from scanner_service.sessions.withdrawals import end_of_scan_utc, ends_of_passes, withdrawn_passes
from scanner_service.storage.exports.about import About
from scanner_service.storage.reader import RecordReader
from scanner_service.storage.rows import EventRow, SessionRow

OnShare = Callable[[float], object]
MOST_STAGES = 12


@dataclass(frozen=True, slots=True)
class Stage:
    """What was known when passes were over: figures of everything up to then. `coverage` is NaN when unknown."""

    passes: tuple[PassKey, ...]
    lines: int
    points: int
    coverage: float
    touched_mm2: float
    gap_mm2: float
    regions: int
    region_mm2: float


@dataclass(frozen=True, slots=True)
class StoredSession:
    """A session rebuilt: the verdict on all of it, and figures of what there was after each pass.

    `stages` are in the order of time, the last one that of `results`; of more than MOST_STAGES the first, the last and
    those evenly between are kept, and `pass_ends` says how many there were. `first` is the verdict after the first pass
    where there was more than one. `damaged` tells of lines that are left out because they cannot be read as they were.
    `losses` is the ledger that the scan left in the record, or one made from the lines alone; `ended_utc` says when it
    ended, None where the record does not.
    """

    row: SessionRow
    settings: SessionSettings
    results: Results
    first: Results | None
    stages: tuple[Stage, ...]
    pass_ends: int
    raw_sha256: str
    lines: int
    damaged: tuple[str, ...]
    losses: dict[str, Any]
    ended_utc: str | None

    @property
    def about(self) -> About:
        """What files say of where they come from."""
        return about_of(self.row, self.raw_sha256)


def about_of(row: SessionRow, raw_sha256: str) -> About:
    """What files of this session say of where they come from."""
    return About(row.session_id, row.name, row.created_utc, row.settings, raw_sha256)


def find_session(reader: RecordReader, wanted: str) -> SessionRow:
    """The session of that id, the only one whose id begins so, or the newest for `latest`.

    Raises
    ------
    SourceUnusable : there is none, or several begin so; the sentence says which there are.
    """

    def rows() -> Iterator[SessionRow]:
        after = None
        while page := reader.list_sessions(100, after):
            yield from page
            after = page[-1].session_id

    return reader.get_session(named_session((row.session_id for row in rows()), wanted))


def lines_of(
    reader: RecordReader, row: SessionRow, damaged: list[str], on_share: OnShare
) -> Iterator[tuple[int, StoredLine]]:
    """The sound lines of a session with their numbers; the others go to `damaged`, the share read to `on_share`."""
    total = max(reader.count(row.session_id).lines, 1)
    for number, line in reader.lines(
        row.session_id, on_damage=lambda found: damaged.append(f"line {found.line_number}: {found.reason}")
    ):
        yield number, line
        on_share((number + 1) / total)


def read_session(
    reader: RecordReader,
    row: SessionRow,
    on_share: OnShare = lambda share: None,
    with_stages: bool = False,
    meshes: Path | None = None,
) -> StoredSession:
    """Rebuild a session from its lines as a service does that opens it again, and judge it.

    `meshes` is the folder with the reference mesh that the session may name.

    Raises
    ------
    RecordError : the record cannot be read.
    AnalysisError : the lines do not fit the map that the settings describe.
    """
    settings = SessionSettings.from_dict(row.settings)
    nominal = nominal_of(settings.reference, meshes)
    events = list(reader.events(row.session_id))
    withdrawn, scan_ends = withdrawn_passes(events), ends_of_passes(events)
    live_map = LiveMap(settings.map_settings(), np.array(row.origin_mm))
    damaged: list[str] = []
    ledger, raw = Ledger(), RawHash()
    stages: list[Stage] = []
    first: Results | None = None
    ends = pass_ends(reader, row, withdrawn) if with_stages else []
    kept = set(_evenly(ends[:-1], MOST_STAGES - 1))
    open_passes: dict[str, PassKey] = {}

    def judged(snapshot: MapSnapshot, lines: int | None = None) -> Results:
        """The verdict on a snapshot, by what was known of the scanner after so many lines."""
        kept = calibration_after(row.calibration, events, lines)
        geometry, towards_sensor = geometry_from(kept), towards_sensor_from(kept)
        return judge(snapshot, settings.requirement(), geometry, towards_sensor, nominal.surface, nominal.refused)

    try:
        for number, line in lines_of(reader, row, damaged, on_share):
            while scan_ends and scan_ends[0] <= number:
                scan_ends.pop(0)
                live_map.close_all_passes()
            over = open_passes.get(line.device_id)
            if over is not None and over != pass_key(line):
                live_map.close_pass(over)
                if over in withdrawn:  # at once, so that no stage tells of it
                    ledger.withdrawn(live_map.withdraw_pass(over))
                if raw.lines in kept:
                    found = judged(live_map.snapshot(), number)
                    stages.append(_stage((over,), raw.lines, found))
                    first = first or found
            open_passes[line.device_id] = pass_key(line)
            ledger.mapped(line, live_map.add(line))
            raw.add(line)
        live_map.close_all_passes()
        for key in withdrawn:
            if points := live_map.withdraw_pass(key):
                ledger.withdrawn(points)
        ledger.received = ledger.stored = raw.lines
        snapshot = live_map.snapshot()
    finally:
        live_map.close()
        del live_map  # judging needs as much memory as the map, and the map no more
    results = _followed(judged(snapshot), events)
    last = tuple(key for key in open_passes.values() if key not in withdrawn)
    return StoredSession(
        row=row,
        settings=settings,
        results=results,
        first=first,
        stages=(*stages, _stage(last, raw.lines, results)),
        pass_ends=len(ends),
        raw_sha256=raw.hexdigest(),
        lines=raw.lines,
        damaged=tuple(damaged),
        losses=_recorded_losses(reader, row) or ledger.to_dict(None),
        ended_utc=end_of_scan_utc(events),
    )


def _followed(results: Results, events: Iterable[EventRow]) -> Results:
    """The results with the regions that the scan left in the record; of another verdict, followed from them."""
    left = last_left(events)
    told = None if left is None else left.told_of(results)
    if told is not None:
        return told
    book = RegionBook() if left is None else left.book()
    book.follow(results.snapshot, results.regions)
    return replace(results, regions=book.current, resolved=book.resolved)


def pass_ends(reader: RecordReader, row: SessionRow, withdrawn: Collection[PassKey]) -> list[int]:
    """How many lines there were at the end of each pass that stands; the last is how many there are."""
    ends, total = [], 0
    open_passes: dict[str, PassKey] = {}
    for _, line in lines_of(reader, row, [], lambda share: None):
        over = open_passes.get(line.device_id)
        if over is not None and over != pass_key(line) and over not in withdrawn:
            ends.append(total)
        open_passes[line.device_id] = pass_key(line)
        total += 1
    return [*ends, total] if total else []


def _evenly(values: list[int], most: int) -> list[int]:
    """At most so many of the values, the first and the last among them."""
    if len(values) <= most:
        return values
    return [values[round(at)] for at in np.linspace(0, len(values) - 1, most)]


def _stage(passes: tuple[PassKey, ...], lines: int, found: Results) -> Stage:
    regions = found.regions
    return Stage(
        passes=passes,
        lines=lines,
        points=int((found.snapshot.unreliable != Unreliable.NOT_COUNTED).sum()),
        coverage=found.coverage.share,
        touched_mm2=float(found.coverage.area_mm2.sum()),
        gap_mm2=found.coverage.gap_mm2,
        regions=len(regions),
        region_mm2=float(sum(region.area_mm2 for region in regions)),
    )


def _recorded_losses(reader: RecordReader, row: SessionRow) -> dict[str, Any] | None:
    """The ledger, as the scan wrote it down when it ended; None after a scan that was interrupted."""
    told = [event.details for event in reader.events(row.session_id) if event.kind == "losses" and not event.damaged]
    return dict(told[-1]) if told else None
