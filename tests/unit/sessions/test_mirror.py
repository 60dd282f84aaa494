"""The analyst's copy equals the map's own snapshot after every line, whatever happens to the map in between."""

from dataclasses import fields
from itertools import islice

import numpy as np
import pytest

from scanner_service.analysis.live_map import LiveMap
from scanner_service.analysis.map_settings import MapSettings
from scanner_service.analysis.snapshot import LineTable, MapSnapshot
from scanner_service.rescan.regions import find_regions
from scanner_service.sessions import mirror as module
from scanner_service.sessions.mirror import Mirror
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


def read(mirror: Mirror, live: LiveMap) -> MapSnapshot:
    """The copy, caught up with the map."""
    mirror.catch_up(lambda question: question(live), lambda question: question(live))
    return mirror.changes()[0]


def test_the_mirror_and_the_verdict_on_it_are_those_of_the_whole_map_after_any_lines() -> None:
    rng = np.random.default_rng(4)
    live, mirror = LiveMap(MapSettings(noise_mm=0.002, max_points=20_000)), Mirror()
    first = surface_scan(_height, lines=14, points=40, rng=rng, noise_mm=0.002)
    second = surface_scan(_height, lines=14, points=40, rng=rng, noise_mm=0.002, pass_index=1)
    version = 0
    for number, line in enumerate([*first, *second]):
        if number == len(first):
            live.close_all_passes()
        live.add(line)
        if rng.random() < 0.4:
            mine, truth = read(mirror, live), live.snapshot()
            _same(mine, truth)
            assert find_regions(mine).to_dict() == find_regions(truth).to_dict()
            assert mine.version > version
            version = mine.version
    live.withdraw_pass(("A", 1, 1))
    live.close_all_passes()
    _same(read(mirror, live), live.snapshot())
    live.close()


def test_what_is_kept_and_put_in_place_later_makes_the_same_copy() -> None:
    rng = np.random.default_rng(7)
    live, mirror = LiveMap(MapSettings(noise_mm=0.002, max_points=20_000)), Mirror()
    given: list[tuple[MapSnapshot, np.ndarray]] = []
    for line in surface_scan(_height, lines=40, points=40, rng=rng, noise_mm=0.002):
        live.add(line)
        if rng.random() < 0.6:
            mirror.catch_up(lambda question: question(live), lambda question: question(live))
            assert mirror.version == live.version
        if rng.random() < 0.2:
            mine = read(mirror, live)
            _same(mine, live.snapshot())
            given.append((mine, mine.neighbours.copy()))
    live.withdraw_pass(("A", 1, 0))
    mirror.catch_up(lambda question: question(live), lambda question: question(live))
    _same(read(mirror, live), live.snapshot())
    for snapshot, neighbours in given:  # what was given out is not written on
        np.testing.assert_array_equal(snapshot.neighbours, neighbours)
    live.close()


def test_what_is_described_for_a_verdict_does_not_grow_with_the_map() -> None:
    live, mirror = LiveMap(MapSettings(noise_mm=0.002, max_points=200_000)), Mirror()
    copied = []
    for line in surface_scan(_height, lines=120, points=60):
        live.add(line)
        copied.append(mirror.catch_up(lambda question: question(live), lambda question: question(live)))
    assert max(copied[60:]) <= max(copied[20:40])
    live.close()


def test_pages_that_are_copied_while_lines_come_in_make_a_copy_of_one_version(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "PAGE_ROWS", 100)
    live, mirror = LiveMap(MapSettings(noise_mm=0.002, max_points=20_000)), Mirror()
    lines = surface_scan(_height, lines=60, points=40)
    for line in lines[:30]:
        live.add(line)
    coming = iter(lines[30:])

    def ask_between(question):
        answer = question(live)
        for line in islice(coming, 2):  # between two pages the engine takes lines, which change rows already copied
            live.add(line)
        return answer

    mirror.catch_up(lambda question: question(live), ask_between)
    assert len(live) > 30 * 40
    _same(mirror.changes()[0], live.snapshot())
    live.close()
