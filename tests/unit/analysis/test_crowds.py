"""Many points in one place: the same ones share an entry, and every answer is still the batch answer."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from scanner_service.analysis.live_map import LiveMap
from scanner_service.analysis.map_settings import MapSettings
from scanner_service.analysis.passes import pass_key
from scanner_service.analysis.radius import RadiusSettings
from scanner_service.analysis.snapshot import Unreliable
from tests.oracle import Oracle
from tests.unit.analysis.scans import stored


def crowd(rng, line, places, copies, device="A"):
    """A scanline with each of its places `copies` times over, in any order."""
    x = rng.integers(0, places, places * copies) * 0.1
    points = np.column_stack([x, np.full(len(x), 0.2 * line), np.zeros(len(x))])
    return stored(points, line, device_id=device, travel=np.full(3, np.nan))


def agree(snapshot, rows, live):
    counted = snapshot.unreliable != Unreliable.NOT_COUNTED
    xyz_q = np.rint((snapshot.points_mm - snapshot.origin_mm) * 8192).astype(np.int64)
    oracle = Oracle(
        xyz_q,
        snapshot.radius_mm,
        snapshot.line,
        snapshot.lines.laser_mm[snapshot.line],
        live.settings.noise_mm,
        counted,
    )
    for row in rows:
        answer = oracle.at(row)
        assert snapshot.neighbours[row] == answer.neighbours
        if snapshot.reliable[row] and answer.is_comparable:
            assert np.arccos(np.clip(snapshot.normals[row] @ answer.normal, -1, 1)) < 1e-6


@settings(max_examples=5, deadline=None)
@given(st.integers(0, 2**32), st.booleans())
def test_points_in_the_same_place_count_one_by_one(seed, read_between):
    rng = np.random.default_rng(seed)
    live = LiveMap(MapSettings(max_points=60_000, noise_mm=0.01))
    lines = [crowd(rng, line, places=9, copies=60) for line in range(3)]
    for line in lines:
        live.add(line)
        if read_between:
            live.refresh()
    snapshot = live.snapshot()
    assert (snapshot.unreliable != Unreliable.NOT_COUNTED).all()
    agree(snapshot, rng.choice(len(snapshot), 25, replace=False), live)
    _, first, same = np.unique(
        np.column_stack([snapshot.points_mm, snapshot.line]), axis=0, return_index=True, return_inverse=True
    )
    assert (snapshot.neighbours == snapshot.neighbours[first][same.ravel()]).all()
    assert (snapshot.settled == snapshot.settled[first][same.ravel()]).all()


def test_a_million_points_in_one_place_are_a_million_points():
    live = LiveMap(MapSettings(max_points=1_100_000))
    for line in range(10):
        live.add(stored(np.zeros((100_000, 3)), line, travel=np.full(3, np.nan)))
        assert live.refresh().size
    snapshot = live.snapshot()
    assert (snapshot.neighbours == 1_000_000).all()
    assert (snapshot.unreliable == Unreliable.ILL_DETERMINED).all()


def test_a_crowd_that_is_withdrawn_leaves_nothing():
    rng = np.random.default_rng(3)
    live = LiveMap(MapSettings(max_points=60_000, noise_mm=0.01))
    stays = [crowd(rng, line, places=12, copies=20) for line in range(3)]
    goes = [crowd(rng, line, places=12, copies=60, device="B") for line in range(3)]
    for line in stays + goes:
        live.add(line)
    live.refresh()
    assert live.withdraw_pass(pass_key(goes[0])) == sum(len(line.index) for line in goes)
    never = LiveMap(MapSettings(max_points=60_000, noise_mm=0.01))
    for line in stays:
        never.add(line)
    kept = sum(len(line.index) for line in stays)
    both, alone = live.snapshot(), never.snapshot()
    assert (both.neighbours[:kept] == alone.neighbours).all()
    assert both.normals[:kept].tobytes() == alone.normals.tobytes()
    assert (both.neighbours[kept:] == 0).all()


def test_a_million_places_in_one_cell_are_bounded_and_counted():
    live = LiveMap(MapSettings(max_points=1_100_000, cell_limit=500))
    rng = np.random.default_rng(0)
    left_out = 0
    for line in range(10):
        points = rng.uniform(0.01, 0.2, (100_000, 3))
        left_out += live.add(stored(points, line, travel=np.full(3, np.nan))).left_out.get("over_dense", 0)
    snapshot = live.snapshot()
    counted = snapshot.unreliable != Unreliable.NOT_COUNTED
    assert left_out == 1_000_000 - counted.sum()
    assert (snapshot.neighbours[counted] == counted.sum()).all()


def test_flexible_radii_hold_where_a_wall_is_seen_from_both_sides():
    rng = np.random.default_rng(5)
    live = LiveMap(MapSettings(radius=RadiusSettings(rule="flexible"), max_points=20_000, noise_mm=0.01))
    x = np.arange(60) * 0.15
    for side, z in (("above", 0.4), ("below", 0.0)):
        for line in range(30):
            points = np.column_stack([x, np.full(60, 0.2 * line), np.full(60, z)]) + rng.normal(0, 0.01, (60, 3))
            laser = np.array([4.0, 0.2 * line, 100.0 if side == "above" else -100.0])
            live.add(stored(points, line, device_id=side, laser_mm=laser))
            live.refresh()
    live.close_all_passes()
    snapshot = live.snapshot()
    agree(snapshot, rng.choice(len(snapshot), 60, replace=False), live)
    up = snapshot.points_mm[:, 2] > 0.2
    assert (snapshot.normals[up & snapshot.reliable, 2] > 0).all()
    assert (snapshot.normals[~up & snapshot.reliable, 2] < 0).all()


def test_what_larger_cells_leave_out_is_told():
    rng = np.random.default_rng(2)
    live = LiveMap(MapSettings(max_points=60_000, cell_limit=300))
    counted, left_out = 0, 0
    for line in range(20):
        points = np.column_stack([np.sort(rng.uniform(0, 8, 1000)), np.full(1000, 0.05 * line), np.zeros(1000)])
        wide = {"line_spacing_mm": 2.0} if line == 19 else {"line_spacing_mm": 0.05}
        accepted = live.add(stored(points, line, travel=np.full(3, np.nan), **wide))
        counted += accepted.counted
        left_out += accepted.left_out.get("over_dense", 0)
    snapshot = live.snapshot()
    assert counted == (snapshot.unreliable != Unreliable.NOT_COUNTED).sum()
    assert counted + left_out == 20_000
    assert accepted.counted < 0, "the last line's cells are larger, and hold fewer points than were counted"
