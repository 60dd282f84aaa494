"""Regions keep their ids while a scan grows, and go through their states; what happened is kept."""

import json
from dataclasses import replace

import numpy as np
import pytest

from scanner_service.rescan.followed import RegionBook
from scanner_service.rescan.judgement import Reason
from scanner_service.rescan.region import RegionStatus
from scanner_service.rescan.regions import find_regions
from tests.unit.rescan.synthetic_scan import Scan, snapshot_of, straight_down, triangulated

X, Y = np.arange(-4, 4, 0.2), np.arange(0, 14, 0.3)


def _ramps(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Two flanks of 70 degrees, 2 mm wide, at y = 3 and y = 9."""
    rise = np.tan(np.radians(70.0))
    return rise * (np.clip(y - 3.0, 0.0, 2.0) + np.clip(y - 9.0, 0.0, 2.0))


def _first(scan: Scan, lines: int) -> Scan:
    parts = {name: getattr(scan, name)[:lines] for name in scan.__dataclass_fields__ if name != "places"}
    return Scan(**parts, places=scan.places)


def _followed(book: RegionBook, scan: Scan, version: int, unsettled_beyond: float | None = None) -> list:
    waits = None if unsettled_beyond is None else (lambda points: points[:, 1] > unsettled_beyond)
    snapshot = replace(snapshot_of(scan, unsettled=waits), version=version)
    return book.follow(snapshot, find_regions(snapshot).regions)


def test_ids_stay_while_the_scan_grows() -> None:
    book, scan = RegionBook(), straight_down(_ramps, X, Y, 0.3)
    seen: dict[int, list[float]] = {}
    for version, lines in enumerate(range(8, len(Y) + 1, 3), start=1):
        _followed(book, _first(scan, lines), version, unsettled_beyond=float(Y[lines - 1]) - 1.0)
        for region in book.current:
            seen.setdefault(region.region_id, []).append(float(region.centroid_mm[1]))
    assert sorted(seen) == [1, 2]
    assert all(3.0 < y < 5.0 for y in seen[1]) and all(9.0 < y < 11.0 for y in seen[2])
    assert [region.status for region in book.current] == [RegionStatus.OPEN] * 2


def test_a_pass_over_a_region_makes_it_rescanned_when_it_fails_still_and_resolved_when_it_does_not() -> None:
    book, scan = RegionBook(), straight_down(_ramps, X, Y, 0.3)
    _followed(book, scan, 1)
    ids = {region.region_id for region in book.current}
    # the same again half way in between mends nothing on the first flank (too few lines), a fine pass mends the second
    coarse = straight_down(_ramps, X, np.arange(2.15, 6.0, 1.2), 1.2, pass_number=2)
    fine = straight_down(_ramps, X, np.arange(8.0, 12.0, 0.05), 0.05, pass_number=3)
    changes = _followed(book, scan.joined(coarse).joined(fine), 2)
    by_id = {region.region_id: region for region in (*book.current, *book.resolved)}
    first, second = (by_id[key] for key in sorted(ids))
    assert first.status is RegionStatus.RESCANNED
    assert second.status is RegionStatus.RESOLVED
    assert [moment.status for moment in second.history] == [RegionStatus.OPEN, RegionStatus.RESOLVED]
    assert {change.region_id for change in changes} >= ids
    # withdrawn again: it fails again, under the id that it had
    _followed(book, scan.joined(coarse), 3)
    assert {region.region_id for region in book.current} >= ids
    assert json.dumps([change.to_dict() for change in changes], allow_nan=False)


def test_a_region_goes_with_the_pass_that_found_it_and_is_open_again_without_the_one_that_was_over_it() -> None:
    """A cliff, and a pass that believes itself 40 mm aside: what it shows there is not there."""
    cliff, elsewhere = triangulated(_raised_cliff, X, Y, 0.3), triangulated(_raised_cliff, X, Y, 0.3, pass_number=2)
    for name in ("points", "laser"):
        setattr(elsewhere, name, [values + np.array([40.0, 0.0, 0.0]) for values in getattr(elsewhere, name)])
    floor = straight_down(_raised_cliff, X, np.arange(3.6, 6.9, 0.3), 0.3, pass_number=3)
    others = straight_down(_raised_cliff, X + 40.0, Y[:20], 0.3)  # points there of the pass that stays, without a jump
    book = RegionBook()
    _followed(book, cliff.joined(elsewhere), 1)
    true, false = sorted(book.current, key=lambda region: float(region.centroid_mm[0]))
    assert true.reason is false.reason is Reason.SHADOW
    _followed(book, cliff.joined(elsewhere).joined(floor), 2)
    assert {region.region_id: region.status for region in book.current}[true.region_id] is RegionStatus.RESCANNED
    book = RegionBook.from_dict(json.loads(json.dumps(book.to_dict())))
    _followed(book, cliff.joined(others), 3)
    (left,), (gone,) = book.current, book.resolved
    assert (left.region_id, left.status) == (true.region_id, RegionStatus.OPEN)
    assert (gone.region_id, gone.history[-1].why) == (false.region_id, "the pass that found it was withdrawn")
    assert left.history[-1].why == "the pass that was over it was withdrawn"


def test_passes_that_were_withdrawn_one_after_another_leave_no_region_behind() -> None:
    """Two passes that believe themselves 40 mm aside, and one 2 mm, each withdrawn before the next."""
    cliff, book, version = triangulated(_raised_cliff, X, Y, 0.3), RegionBook(), 1
    _followed(book, cliff, version)
    (true,) = book.current
    for number, aside_mm in ((2, 40.0), (3, 40.0), (4, 2.0)):
        elsewhere = triangulated(_raised_cliff, X, Y, 0.3, pass_number=number)
        for name in ("points", "laser"):
            moved = [values + np.array([aside_mm, 0.0, 0.0]) for values in getattr(elsewhere, name)]
            setattr(elsewhere, name, moved)
        _followed(book, cliff.joined(elsewhere), version + 1)
        assert len(book.current) > 1 or aside_mm < 10.0
        _followed(book, cliff, version + 2)
        assert [region.region_id for region in book.current] == [true.region_id], number
        assert book.current[0].area_mm2 == true.area_mm2
        version += 2


def test_a_region_whose_points_wait_is_not_called_resolved() -> None:
    book, scan = RegionBook(), straight_down(_ramps, X, Y, 0.3)
    _followed(book, scan, 1)
    _followed(book, scan, 2, unsettled_beyond=8.0)
    assert len(book.current) == 2 and not book.resolved


def _cliff(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.where(y < 7.0, 0.0, 6.0)


def test_a_shadow_is_not_resolved_by_a_pass_that_brought_nothing_to_its_surface() -> None:
    book, scan = RegionBook(), straight_down(_cliff, X, Y, 0.3)
    _followed(book, scan, 1)
    shadows = [region.region_id for region in book.current if region.reason is Reason.SHADOW]
    assert shadows
    again = straight_down(_cliff, X, Y + 0.15, 0.3, pass_number=2)  # sees top and floor once more, and no wall
    _followed(book, scan.joined(again), 2)
    status = {region.region_id: region.status for region in book.current}
    assert [status.get(number) for number in shadows] == [RegionStatus.RESCANNED] * len(shadows)


def _wall_from_before(heights: np.ndarray) -> Scan:
    """The wall of the cliff as a second pass sees it that looks along +y: a line at each height."""
    scan = Scan(places=len(X))
    for number, height in enumerate(heights):
        scan.points.append(np.column_stack([X, np.full_like(X, 7.0), np.full_like(X, height)]))
        scan.index.append(np.arange(len(X)))
        scan.line_index.append(number)
        scan.pass_number.append(2)
        scan.position.append(float(height))
        scan.laser.append(np.array([0.0, -1e4, float(height)]))
        scan.spacing.append(0.3)
    return scan


def _raised_cliff(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return _cliff(x, y) + 0.4


@pytest.mark.parametrize("is_wall_seen", [False, True])
def test_a_shadow_is_resolved_once_what_it_hides_is_seen_and_not_by_the_floor_alone(is_wall_seen: bool) -> None:
    """The camera is hidden along 3.5 mm of floor: wall and floor lie up to 3 mm behind the straight way between."""
    scan = triangulated(_raised_cliff, X, Y, 0.3)
    book = RegionBook()
    _followed(book, scan, 1)
    (shadow,) = (region for region in book.current if region.reason is Reason.SHADOW)
    assert shadow.area_mm2 > 40.0
    seen = scan.joined(straight_down(_raised_cliff, X, np.arange(3.6, 6.9, 0.3), 0.3, pass_number=3))
    if is_wall_seen:
        seen = seen.joined(_wall_from_before(np.arange(0.6, 6.3, 0.3)))
    _followed(book, seen, 2)
    status = {region.region_id: region.status for region in (*book.current, *book.resolved)}[shadow.region_id]
    assert status is (RegionStatus.RESOLVED if is_wall_seen else RegionStatus.RESCANNED)


def test_unreachable_is_said_with_a_reason_and_an_old_report_changes_nothing() -> None:
    book, scan = RegionBook(), straight_down(_ramps, X, Y, 0.3)
    _followed(book, scan, 5)
    book.mark(1, RegionStatus.UNREACHABLE, "no pose within the limits sees it")
    _followed(book, scan, 4)
    _followed(book, scan, 6)
    region = next(region for region in book.current if region.region_id == 1)
    assert region.status is RegionStatus.UNREACHABLE
    assert region.history[-1].why == "no pose within the limits sees it"


def test_a_book_goes_on_where_another_was_kept() -> None:
    book, scan = RegionBook(), straight_down(_ramps, X, Y, 0.3)
    _followed(book, scan, 1)
    book.mark(2, RegionStatus.UNREACHABLE, "hidden")
    again = RegionBook.from_dict(json.loads(json.dumps(book.to_dict(), allow_nan=False)))
    _followed(again, scan, 1)
    mine, others = book.current, again.current
    assert [(r.region_id, r.status, r.history) for r in mine] == [(r.region_id, r.status, r.history) for r in others]
    assert all(region.reason is Reason.STEEP for region in others)


def test_a_book_of_another_time_still_opens() -> None:
    book, scan = RegionBook(), straight_down(_cliff, X, Y, 0.3)
    _followed(book, scan, 1)
    old = json.loads(json.dumps(book.to_dict()))
    for entry in old["regions"]:
        del entry["line_spacing_mm"]
        entry["places_mm"] = [[0.0, 0.0, 0.0, 1.0]]  # what was kept once, and is not asked for any more
    ids = [region.region_id for region in book.current]
    assert [region.region_id for region in RegionBook.from_dict(old).current] == ids
