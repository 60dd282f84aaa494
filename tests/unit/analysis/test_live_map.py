"""The law of the live map: after any prefix, in any order, the answer equals the batch answer."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scanner_service.analysis.errors import MapFull, TooManyPasses
from scanner_service.analysis.live_map import LiveMap
from scanner_service.analysis.map_settings import MapSettings
from scanner_service.analysis.passes import pass_key
from scanner_service.analysis.radius import RadiusSettings
from scanner_service.analysis.snapshot import RadiusRule, Unreliable
from tests.oracle import Q_MM, Oracle
from tests.unit.analysis.scans import UNKNOWN, scanline, stored, surface_scan

NOISE_MM = 0.01
SHAPES = {
    "plane": lambda x, y: 0.3 * x + 0.2 * y,
    "flank": lambda x, y: 1.6 * y,
    "sphere": lambda x, y: np.sqrt(np.maximum(25.0 - x * x - (y - 1) ** 2, 0.0)),
    "step": lambda x, y: np.where(x > 0.1, 2.0, 0.0),
}


def new_map(**changes):
    return LiveMap(MapSettings(**({"max_points": 20_000, "noise_mm": NOISE_MM} | changes)))


def is_reliable(live, truth):
    """Section by section: enough points, enough lines, a small predicted error; None when that is on the edge."""
    two_lines = len(truth.line_counts) == 2 and min(truth.line_counts) >= 2
    if truth.neighbours < 6 or not (two_lines or len(truth.line_counts) >= 3 or not live.settings.needs_lines):
        return False
    limit = live.settings.max_normal_error_rad
    if not truth.is_comparable or abs(truth.predicted_error_rad - limit) < 1e-9:
        return None
    return bool(truth.predicted_error_rad <= limit)


def assert_grown_where_needed_only(live, snapshot, oracle, row):
    """The recorded radius is the first of the ladder that makes the point reliable, else the rule's own."""
    line = snapshot.lines
    at = snapshot.line[row]
    spacing = np.fmax(line.line_spacing_mm[at], line.point_spacing_mm[at])
    base = math.sqrt(2) * float(spacing) + live.settings.radius.uncertainty_mm
    limit = live.settings.max_radius_mm or 20 * live.settings.radius.uncertainty_mm
    limit = max(base, min(limit, 4 * base))
    ladder = [base]
    while ladder[-1] < limit:
        ladder.append(min(base * 1.25 ** len(ladder), limit))
    used = snapshot.radius_mm[row]
    assert used in ladder
    tried = ladder if not snapshot.reliable[row] else ladder[: ladder.index(used)]
    if not snapshot.reliable[row]:
        assert used == base
    kept = oracle.radius_mm[row]
    for radius in tried:
        oracle.radius_mm[row] = radius
        assert is_reliable(live, oracle.at(row)) in (False, None)
    oracle.radius_mm[row] = kept
    assert (snapshot.radius_rule[row] == RadiusRule.GROWN) == (used > base)


def assert_equals_oracle(live, rows=None):
    """Everything the law promises, for the given rows."""
    snapshot = live.snapshot()
    counted = snapshot.unreliable != Unreliable.NOT_COUNTED
    laser = snapshot.lines.laser_mm[snapshot.line] - live.origin_mm
    xyz_q = np.rint((snapshot.points_mm - live.origin_mm) / Q_MM)
    oracle = Oracle(xyz_q, snapshot.radius_mm, snapshot.line, laser, live.settings.noise_mm, counted)
    for row in range(len(snapshot)) if rows is None else rows:
        if not counted[row]:
            assert snapshot.neighbours[row] == 0
            continue
        truth = oracle.at(row)
        assert snapshot.neighbours[row] == truth.neighbours
        assert_grown_where_needed_only(live, snapshot, oracle, row)
        assert snapshot.density_per_mm2[row] == pytest.approx(
            truth.neighbours / (math.pi * snapshot.radius_mm[row] ** 2)
        )
        if truth.neighbours < 6:
            assert snapshot.unreliable[row] == Unreliable.TOO_FEW
        elif (expected := is_reliable(live, truth)) is not None:
            assert snapshot.reliable[row] == expected
        if snapshot.reliable[row]:
            assert truth.is_comparable
            assert np.linalg.norm(snapshot.normals[row]) == pytest.approx(1.0)
            assert np.linalg.norm(np.cross(snapshot.normals[row], truth.normal)) < 1e-6
            to_laser = laser[row] - xyz_q[row] * Q_MM
            if abs(truth.normal @ to_laser) > 1e-3:
                assert snapshot.normals[row] @ truth.normal > 0
        else:
            assert np.isnan(snapshot.normals[row]).all()
        assert snapshot.isolated[row] == (snapshot.settled[row] and truth.neighbours <= 3)


@st.composite
def scans(draw):
    """Two passes with their own line spacings over a shape, interleaved in some order, with duplicates."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    shape = SHAPES[draw(st.sampled_from(sorted(SHAPES)))]
    size = {"lines": draw(st.integers(1, 9)), "points": draw(st.integers(1, 25)), "rng": rng, "noise_mm": NOISE_MM}
    first = surface_scan(shape, spacing=draw(st.sampled_from([0.2, 0.3])), **size)
    second = surface_scan(shape, spacing=draw(st.sampled_from([0.1, 0.5])), device_id="B", **size)
    lines = first + second[: draw(st.integers(0, len(second)))]
    if draw(st.booleans()):
        lines.append(stored(lines[0].xyz_q * Q_MM, 99, device_id="C", position_mm=0.0))
    return [lines[i] for i in rng.permutation(len(lines))]


@settings(max_examples=40, deadline=None)
@given(scans(), st.lists(st.integers(0, 30), max_size=3), st.integers(1, 2))
def test_after_any_prefix_in_any_order_the_map_equals_the_batch_oracle(lines, stops, threads):
    live = new_map(threads=threads)
    for number, line in enumerate(lines):
        live.add(line)
        if number in stops:
            assert_equals_oracle(live)
    assert_equals_oracle(live)
    live.close()


def test_where_the_rule_reaches_one_line_only_the_radius_grows_and_the_normal_is_right():
    tilt = math.radians(66.0)  # beyond 59 degrees r_min no longer reaches the next line at a spacing of 0.2 mm
    rng = np.random.default_rng(5)
    live = new_map()
    for line in surface_scan(lambda x, y: math.tan(tilt) * y, lines=25, rng=rng, noise_mm=0.005):
        live.add(line)
    live.close_all_passes()
    snapshot = live.snapshot()
    middle = (snapshot.line > 5) & (snapshot.line < 19) & (np.abs(snapshot.points_mm[:, 0]) < 1.0)
    assert (snapshot.radius_rule[middle] == RadiusRule.GROWN).all()
    assert snapshot.reliable[middle].all()
    truth = np.array([0.0, -math.sin(tilt), math.cos(tilt)])
    error = np.arccos(np.clip(snapshot.normals[middle] @ truth, -1, 1))
    assert np.sqrt((error**2).mean()) < math.radians(2.0)
    assert_equals_oracle(live, np.flatnonzero(middle)[::7])


@settings(max_examples=25, deadline=None)
@given(scans(), st.randoms(use_true_random=False))
def test_order_and_reading_leave_no_trace(lines, random):
    forward, shuffled = new_map(), new_map()
    other_order = list(lines)
    random.shuffle(other_order)
    for line in lines:
        forward.add(line)
    for line in other_order:
        shuffled.add(line)
        if random.random() < 0.5:
            shuffled.refresh()
    forward.close_all_passes()
    shuffled.close_all_passes()

    def answers(live):
        s = live.snapshot()
        keys = zip(
            s.lines.boot_id[s.line], s.lines.line_index[s.line], s.lines.line_spacing_mm[s.line], s.index, strict=True
        )
        values = zip(s.neighbours, map(bytes, s.normals), s.unreliable, s.settled, s.isolated, s.offset, strict=True)
        return dict(zip(keys, values, strict=True))

    if any(line.device_id == "C" for line in lines):
        return  # a doubled line has no key of its own here
    assert answers(forward) == answers(shuffled)


def test_moving_everything_by_quanta_changes_nothing():
    shift_mm = np.array([12345, -777777, 1 << 20]) * Q_MM
    rng = np.random.default_rng(1)
    lines = surface_scan(SHAPES["sphere"], rng=rng, noise_mm=NOISE_MM)
    here, there = new_map(), new_map()
    for line in lines:
        here.add(line)
        moved = line.xyz_q * Q_MM + shift_mm
        there.add(stored(moved, line.line_index, position_mm=line.position_mm, laser_mm=line.laser_mm + shift_mm))
    a, b = here.snapshot(), there.snapshot()
    assert (a.neighbours == b.neighbours).all()
    assert (a.unreliable == b.unreliable).all()
    np.testing.assert_array_equal(a.normals, b.normals)


def test_the_changed_rows_are_exactly_those_whose_answer_changed():
    live = new_map()
    before = live.snapshot()
    for line in surface_scan(SHAPES["plane"]):
        live.add(line)
        version = live.version
        live.refresh()
        after = live.snapshot()
        rows = live.changed_since(version)
        old = slice(0, len(before))
        differs = (before.neighbours != after.neighbours[old]) | (before.settled != after.settled[old])
        differs |= (before.normals != after.normals[old]).any(axis=1) & ~np.isnan(after.normals[old]).all(axis=1)
        changed = set(rows.tolist())
        assert set(np.flatnonzero(differs).tolist()) <= changed
        assert set(range(len(before), len(after))) <= changed
        reach = 0.4 + 1e-9
        assert all(
            r >= len(before) or abs(after.points_mm[r, 1] - line.position_mm) < reach or differs[r] for r in changed
        )
        before = after


def test_a_version_too_old_asks_for_everything():
    live = new_map()
    for line in surface_scan(SHAPES["plane"], lines=4):
        live.add(line)
        live.refresh()
    assert live.changed_since(live.version).size == 0
    live._changes.forget_oldest()
    assert live.changed_since(0) is None


@pytest.mark.parametrize("direction", [1, -1])
def test_a_steady_pass_settles_what_it_left_behind_and_closing_settles_the_rest(direction):
    live = new_map(max_radius_mm=1.0)
    lines = surface_scan(SHAPES["plane"], lines=20)[::direction]
    for line in lines:
        live.add(line)
    snapshot = live.snapshot()
    front_mm = lines[-1].laser_mm[1]
    np.testing.assert_array_equal(snapshot.settled, direction * (front_mm - snapshot.points_mm[:, 1]) > 1.0)
    assert 0.3 < snapshot.settled.mean() < 1.0
    live.close_pass(pass_key(lines[0]))
    assert live.snapshot().settled.all()


def test_a_stage_that_turns_back_settles_nothing_before_closing():
    live = new_map(max_radius_mm=1.0)
    lines = surface_scan(SHAPES["plane"], lines=20)
    for line in lines:
        live.add(line)
    assert live.snapshot().settled.any()
    live.add(stored(lines[3].xyz_q * Q_MM + [0, 0.1, 0], 20, position_mm=lines[3].position_mm + 0.1))
    assert not live.snapshot().settled.any()
    live.close_all_passes()
    assert live.snapshot().settled.all()


def test_a_hand_guided_pass_settles_at_closing():
    live = new_map()
    for line in surface_scan(SHAPES["plane"], plane_normal=UNKNOWN, travel=UNKNOWN):
        live.add(line)
    assert not live.snapshot().settled.any()
    live.close_all_passes()
    assert live.snapshot().settled.all()


def test_a_second_pass_unsettles_exactly_what_it_reaches():
    live = new_map()
    first = surface_scan(SHAPES["plane"], lines=20)
    for line in first:
        live.add(line)
    live.close_all_passes()
    again = surface_scan(SHAPES["plane"], lines=3, device_id="B")
    for line in again:
        live.add(line)
    snapshot = live.snapshot()
    first_pass = snapshot.lines.pass_number[snapshot.line] == 0
    oracle = Oracle(np.rint(snapshot.points_mm / Q_MM), snapshot.radius_mm, snapshot.line, snapshot.points_mm)
    is_second = ~first_pass
    for row in np.flatnonzero(first_pass):
        assert snapshot.settled[row] == (not is_second[oracle.neighbour_rows(row)].any())
    live.close_all_passes()
    assert live.snapshot().settled.all()


def test_a_stopped_stage_does_not_look_like_a_dense_scan():
    moving, stopped = new_map(), new_map()
    lines = surface_scan(SHAPES["plane"], lines=10)
    for line in lines:
        moving.add(line)
        stopped.add(line)
    for i in range(5):
        jitter = 0.03 * (-1) ** i
        accepted = stopped.add(
            stored(lines[4].xyz_q * Q_MM + [0, jitter, 0], 100 + i, position_mm=lines[4].position_mm + jitter)
        )
        assert accepted.left_out == {"stationary": 30}
    a, b = moving.snapshot(), stopped.snapshot()
    np.testing.assert_array_equal(a.neighbours, b.neighbours[: len(a)])
    assert b.lines.stationary.sum() == 5
    assert (b.unreliable[len(a) :] == Unreliable.NOT_COUNTED).all()
    assert_equals_oracle(stopped)


def test_where_points_are_sparser_than_lines_the_point_spacing_governs():
    sparse = surface_scan(SHAPES["plane"], along=0.5, spacing=0.2)
    live = new_map()
    for line in sparse:
        live.add(line)
    snapshot = live.snapshot()
    assert (snapshot.radius_rule == RadiusRule.POINT_SPACING).all()
    spacing = snapshot.lines.point_spacing_mm[snapshot.line]
    np.testing.assert_allclose(snapshot.radius_mm, math.sqrt(2) * spacing + 0.1)
    plain = new_map(radius=RadiusSettings(point_spacing_mm=0.0))
    accepted = plain.add(sparse[0])
    assert accepted.radius_mm == pytest.approx(math.sqrt(2) * 0.2 + 0.1)
    assert_equals_oracle(live)


def test_a_single_line_never_pretends_to_be_a_surface():
    live = new_map()
    live.add(surface_scan(SHAPES["plane"], lines=1, along=0.05)[0])
    snapshot = live.snapshot()
    assert not snapshot.reliable.any()
    assert (snapshot.unreliable[3:-3] == Unreliable.SINGLE_LINE).all()


@pytest.mark.parametrize("thickness_mm", [0.2, 0.3, 0.5, 0.8])
def test_both_sides_of_a_thin_plate_are_turned_to_their_own_laser(thickness_mm):
    rng = np.random.default_rng(7)
    live = new_map()
    top = surface_scan(lambda x, y: 0 * x + thickness_mm, rng=rng, noise_mm=0.005, along=0.1)
    below = {"device_id": "B", "laser_z": -150.0}
    for line in top + surface_scan(lambda x, y: 0 * x, rng=rng, noise_mm=0.005, along=0.1, **below):
        live.add(line)
    snapshot = live.snapshot()
    up = snapshot.lines.laser_mm[snapshot.line, 2] > 0
    upright = snapshot.reliable & (np.abs(snapshot.normals[:, 2]) > 0.5)
    assert ((snapshot.normals[:, 2] > 0) == up)[upright].all()
    assert upright.sum() > 0.5 * len(snapshot) or thickness_mm < 0.5


@pytest.mark.parametrize("height_mm", [0.0, 5.0])
def test_exactly_flat_and_axis_parallel_patches_have_exact_normals(height_mm):
    live = new_map(noise_mm=0.0)
    for line in surface_scan(lambda x, y: 0 * x + height_mm):
        live.add(line)
    snapshot = live.snapshot()
    assert snapshot.reliable.sum() > 0.9 * len(snapshot)
    np.testing.assert_array_equal(snapshot.normals[snapshot.reliable], [[0.0, 0.0, 1.0]] * snapshot.reliable.sum())


def test_empty_lines_single_points_and_wild_points_do_no_harm():
    live = new_map()
    live.add(stored(np.empty((0, 3)), 0, position_mm=0.0))
    live.add(stored([[0, 0, 0]], 1, position_mm=1.0))
    wild = stored([[1e9, 0, 0], [np.inf, 0, 0], [np.nan, 0, 1], [200e3, -200e3, 200e3]], 2, position_mm=2.0)
    assert wild.dropped == {"out_of_bounds": 1, "not_finite": 2}
    live.add(wild)
    snapshot = live.snapshot()
    assert snapshot.neighbours.tolist() == [1, 1]
    assert np.isfinite(snapshot.density_per_mm2).all()


def test_a_crowded_cell_is_bounded_and_said():
    live = new_map(cell_limit=50)
    crowd = stored(np.zeros((80, 3)), 0, position_mm=0.0)
    accepted = live.add(crowd)
    assert (accepted.counted, accepted.left_out) == (50, {"over_dense": 30})
    snapshot = live.snapshot()
    assert snapshot.neighbours.tolist() == [50] * 50 + [0] * 30


def test_a_full_map_refuses_the_whole_line_and_keeps_what_it_has():
    live = new_map(max_points=40)
    first, second = surface_scan(SHAPES["plane"], lines=2)
    live.add(first)
    with pytest.raises(MapFull, match="configured for 40 points and holds 30"):
        live.add(second)
    assert len(live.snapshot()) == 30


def test_more_open_passes_than_can_be_told_apart_are_refused():
    live = new_map()
    for i in range(7):
        live.add(stored([[0, 0, 0]], 0, pass_index=i))
    with pytest.raises(TooManyPasses, match="close one first"):
        live.add(stored([[0, 0, 0]], 0, pass_index=7))
    live.close_pass(("A", 1, 3))
    live.add(stored([[0, 0, 0]], 0, pass_index=7))


@pytest.mark.parametrize("spacing", [0.0, -1.0, math.nan, math.inf, 1e-320, 1e300])
def test_a_line_spacing_that_no_scan_has_is_refused(spacing):
    with pytest.raises(ValueError, match="line spacing must"):
        stored([[0, 0, 0]], line_spacing_mm=spacing)


def test_a_laser_that_is_nowhere_near_is_refused():
    with pytest.raises(ValueError, match="laser position"):
        stored([[0, 0, 0]], laser_mm=np.array([0.0, 1e308, 0.0]))


def test_points_scattered_too_widely_are_refused_before_anything_of_the_line_is_taken():
    live = new_map(max_points=20_000, radius=RadiusSettings(point_spacing_mm=0.0))
    rng = np.random.default_rng(0)
    taken = 0
    with pytest.raises(MapFull, match="scattered too widely"):
        for i in range(12):
            live.add(stored(rng.uniform(-1e5, 1e5, (1500, 3)), i, position_mm=float(i)))
            taken += 1500
    assert len(live.snapshot()) == taken
    assert live.line_count == taken // 1500


def test_a_small_map_takes_lines_up_to_its_ceiling():
    live = new_map(max_points=10_000)
    for i in range(7):
        live.add(stored(np.column_stack([np.arange(1280) * 0.15, np.full(1280, 0.2 * i), np.zeros(1280)]), i))
    assert len(live) == 7 * 1280


def test_quantising_accounts_for_every_place_of_the_line():
    points = np.array([[0, 0, 0], [np.nan] * 3, [1, 2, np.inf], [1, 1, 1], [3e5, 0, 0]], dtype=float)
    line = scanline(points, missing=np.array([False, False, False, True, False]), position_mm=0.0)
    from scanner_service.analysis.intake import quantise

    kept = quantise(line, np.zeros(3))
    assert kept.dropped == {"dropout": 1, "missing": 1, "not_finite": 1, "out_of_bounds": 1}
    assert kept.point_count == len(kept.index) + sum(kept.dropped.values()) == 5
