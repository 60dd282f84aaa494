"""The analyst's copy equals the map's own snapshot after every line, whatever happens to the map in between."""

from dataclasses import fields

import numpy as np

from scanner_service.analysis.live_map import LiveMap, MapSettings
from scanner_service.analysis.snapshot import LineTable, MapSnapshot
from scanner_service.rescan.regions import find_regions
from scanner_service.sessions.mirror import Mirror, difference_since
from tests.unit.analysis.scans import surface_scan


def _height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.where(y < 1.2, 0.0, (y - 1.2) * np.tan(np.radians(68.0)))


def _same(mine: MapSnapshot, truth: MapSnapshot) -> None:
    for item in fields(MapSnapshot):
        a, b = getattr(mine, item.name), getattr(truth, item.name)
        if isinstance(a, LineTable):
            for column in fields(LineTable):
                np.testing.assert_array_equal(getattr(a, column.name), getattr(b, column.name))
        else:
            np.testing.assert_array_equal(a, b, err_msg=item.name)


def test_the_mirror_and_the_verdict_on_it_are_those_of_the_whole_map_after_any_lines() -> None:
    rng = np.random.default_rng(4)
    live, mirror = LiveMap(MapSettings(noise_mm=0.002, max_points=20_000)), Mirror()
    first = surface_scan(_height, lines=14, points=40, rng=rng, noise_mm=0.002)
    second = surface_scan(_height, lines=14, points=40, rng=rng, noise_mm=0.002, pass_index=1)
    rows_read, version = 0, 0
    for number, line in enumerate([*first, *second]):
        if number == len(first):
            live.close_all_passes()
        live.add(line)
        if rng.random() < 0.4:
            change = difference_since(live, mirror.version)
            rows_read += 0 if change.is_whole else len(change.rows)
            mine, truth = mirror.apply(change), live.snapshot()
            _same(mine, truth)
            assert find_regions(mine).to_dict() == find_regions(truth).to_dict()
            assert mine.version > version
            version = mine.version
    live.withdraw_pass(("A", 1, 1))
    live.close_all_passes()
    _same(mirror.apply(difference_since(live, mirror.version)), live.snapshot())
    live.close()


def test_what_is_kept_and_put_in_place_later_makes_the_same_copy() -> None:
    rng = np.random.default_rng(7)
    live, mirror = LiveMap(MapSettings(noise_mm=0.002, max_points=20_000)), Mirror()
    given: list[tuple[MapSnapshot, np.ndarray]] = []
    for line in surface_scan(_height, lines=40, points=40, rng=rng, noise_mm=0.002):
        live.add(line)
        if rng.random() < 0.6:
            mirror.keep(difference_since(live, mirror.version))
            assert mirror.version == live.version
        if rng.random() < 0.2:
            mine = mirror.apply(difference_since(live, mirror.version))
            _same(mine, live.snapshot())
            given.append((mine, mine.neighbours.copy()))
    live.withdraw_pass(("A", 1, 0))
    mirror.keep(difference_since(live, mirror.version))
    _same(mirror.apply(difference_since(live, mirror.version)), live.snapshot())
    for snapshot, neighbours in given:  # what was given out is not written on
        np.testing.assert_array_equal(snapshot.neighbours, neighbours)
    live.close()


def test_what_is_described_for_a_verdict_does_not_grow_with_the_map() -> None:
    live, mirror = LiveMap(MapSettings(noise_mm=0.002, max_points=200_000)), Mirror()
    read = []
    for line in surface_scan(_height, lines=120, points=60):
        live.add(line)
        change = difference_since(live, mirror.version)
        mirror.apply(change)
        read.append(len(change.rows))
    assert max(read[60:]) <= max(read[20:40])
    live.close()
