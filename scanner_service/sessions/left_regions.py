"""The regions as a scan left them in its record, with the verdict that they belong to; follows none.

Which regions are listed at the end of a scan depends on what was found during it: one that was not seen to be mended
stays, whether the last report has it or not. So the list is kept with the hash of its verdict, and whoever reaches the
same verdict from the same lines tells of the same list.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from scanner_service.rescan.followed import RegionBook
from scanner_service.rescan.judgement import Reason
from scanner_service.rescan.region import Limit, RescanRegion
from scanner_service.sessions.fingerprint import verdict_sha256
from scanner_service.sessions.results import Results
from scanner_service.storage.rows import EventRow

REGIONS_CHANGED = "regions_changed"
REGIONS_FOLLOWED = "regions_followed"
"""Events: what became of regions at one verdict; and, when a scan is over, what a later opening goes on with."""


@dataclass(frozen=True, slots=True)
class LeftRegions:
    """What the record holds: the book of regions as JSON, and the list that was shown, if it was kept."""

    kept: Mapping[str, Any]

    def book(self) -> RegionBook:
        """A book that goes on with these regions; raises as `RegionBook.from_dict` does."""
        return RegionBook.from_dict(self.kept)

    def told_of(self, found: Results) -> Results | None:
        """The results with the regions that were listed of the same verdict; None when it is another verdict.

        Raises
        ------
        KeyError, TypeError, ValueError, IndexError : the list was not kept by `to_leave`.
        """
        if self.kept.get("verdict_sha256") is None or self.kept["verdict_sha256"] != verdict_sha256(found):
            return None
        book = self.book()
        reported = _reported(found)
        listed = [
            reported[int(entry["of_report"])] if entry["region"] is None else _read(entry["region"])
            for entry in self.kept["listed"]
        ]
        ids = [int(entry["id"]) for entry in self.kept["listed"]]
        numbered = [
            replace(region, number=region_id, region_id=region_id)
            for region, region_id in zip(listed, ids, strict=True)
        ]
        resolved = [_read(entry) for entry in self.kept["mended"]]
        return replace(found, regions=as_in(book, numbered), resolved=as_in(book, resolved))


def as_in(book: RegionBook, regions: Sequence[RescanRegion]) -> tuple[RescanRegion, ...]:
    """The regions, with the status and the history that they have in the book."""
    known = {region.region_id: region for region in (*book.current, *book.resolved)}
    return tuple(
        replace(region, status=known[region.region_id].status, history=known[region.region_id].history)
        for region in regions
    )


def to_leave(book: RegionBook, results: Results | None) -> dict[str, Any]:
    """What the record keeps when a scan is over, as JSON: the book, and the list as it is in the results."""
    if results is None:
        return book.to_dict()
    places = {_mark(region): at for at, region in enumerate(_reported(results))}
    listed = []
    for region in results.regions:
        at = places.get(_mark(region))
        listed.append({"id": region.region_id, "of_report": at, "region": _kept(region) if at is None else None})
    mended = [_kept(region) for region in results.resolved]
    return book.to_dict() | {"verdict_sha256": verdict_sha256(results), "listed": listed, "mended": mended}


def last_left(events: Iterable[EventRow]) -> LeftRegions | None:
    """What the last scan left, with what was said of its regions since; None when none was left."""
    kept: dict[str, Any] | None = None
    for event in events:
        if event.damaged:
            continue
        if event.kind == REGIONS_FOLLOWED:
            regions = [{**entry, "history": list(entry["history"])} for entry in event.details["regions"]]
            kept = {**event.details, "regions": regions}
        elif event.kind == REGIONS_CHANGED and kept is not None:
            histories = {entry["id"]: entry["history"] for entry in kept["regions"]}
            for change in event.details["changes"]:
                moment = {name: change[name] for name in ("version", "status", "area_mm2", "priority", "why")}
                histories.get(change["region"], []).append(moment)
                kept["next"] = max(kept["next"], change["region"] + 1)
    return None if kept is None else LeftRegions(kept)


def _reported(results: Results) -> tuple[RescanRegion, ...]:
    return results.report.regions + (results.reference.untouched if results.reference is not None else ())


def _mark(region: RescanRegion) -> tuple[object, ...]:
    """What tells a region of a report from all others, and from an older one of the same surface."""
    outline = b"".join(loop.tobytes() for loop in region.outline_mm)
    return region.reason, region.point_count, region.area_mm2, region.centroid_mm.tobytes(), outline


def _kept(region: RescanRegion) -> dict[str, object]:
    return {name: value for name, value in region.to_dict().items() if name not in ("status", "history")}


def _read(kept: Mapping[str, Any]) -> RescanRegion:
    """A region as `_kept` wrote it; which points it had is not kept."""

    def number(name: str) -> float:
        return float("nan") if kept[name] is None else float(kept[name])

    return RescanRegion(
        number=int(kept["id"]),
        reason=Reason[str(kept["reason"]).upper()],
        outline_mm=tuple(np.array(loop, dtype=np.float64).reshape(-1, 3) for loop in kept["outline_mm"]),
        area_mm2=float(kept["area_mm2"]),
        centroid_mm=np.array(kept["centroid_mm"], dtype=np.float64),
        normal=np.full(3, np.nan) if kept["normal"] is None else np.array(kept["normal"], dtype=np.float64),
        measured_per_mm2=number("measured_per_mm2"),
        required_per_mm2=number("required_per_mm2"),
        counting_error_per_mm2=number("counting_error_per_mm2"),
        priority=float(kept["priority"]),
        point_count=int(kept["point_count"]),
        remedy=str(kept["remedy"]),
        point_rows=np.zeros(0, dtype=np.int64),
        confidence=float(kept["confidence"]),
        line_spacing_mm=number("line_spacing_mm"),
        region_id=int(kept["id"]),
        limit=Limit.from_dict(kept.get("limit")),
    )
