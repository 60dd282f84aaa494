"""Several passes over one place: withdrawal, thin walls seen from both sides, and how sure a normal is."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scanner_service.analysis.live_map import LiveMap
from scanner_service.analysis.map_settings import MapSettings
from scanner_service.analysis.passes import pass_key
from scanner_service.analysis.snapshot import Unreliable
from tests.oracle import Q_MM, Oracle
from tests.unit.analysis.scans import stored, surface_scan


def new_map(**changes):
    return LiveMap(MapSettings(**({"max_points": 60_000, "noise_mm": 0.01} | changes)))


def answers(snapshot, device):
    """Everything said of one device's points, in their own order."""
    own = np.flatnonzero(np.array(snapshot.lines.device_ids)[snapshot.lines.device[snapshot.line]] == device)
    order = own[np.lexsort((snapshot.index[own], snapshot.lines.line_index[snapshot.line[own]]))]
    columns = (
        snapshot.points_mm, snapshot.radius_mm, snapshot.radius_rule, snapshot.neighbours, snapshot.same_side,
        snapshot.density_per_mm2, snapshot.normals, snapshot.unreliable, snapshot.settled, snapshot.isolated,
        snapshot.offset, snapshot.residual_mm, snapshot.normal_error_rad,
    )  # fmt: skip
    return [np.ascontiguousarray(column[order]).tobytes() for column in columns]


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32), st.booleans(), st.booleans())
def test_a_withdrawn_pass_leaves_a_map_that_never_had_it_bit_for_bit(seed, read_before, add_after):
    rng = np.random.default_rng(seed)
    slope = rng.uniform(-1, 1)

    def surface(x, y):
        return slope * x + 0.3 * y

    size = {"rng": rng, "noise_mm": 0.01, "points": 25}
    stays = surface_scan(surface, lines=10, spacing=0.2, **size)
    goes = surface_scan(surface, lines=6, spacing=0.3, device_id="B", **size)
    later = surface_scan(surface, lines=4, spacing=0.25, device_id="C", **size) if add_after else []
    both, never = new_map(), new_map()
    order = rng.permutation(16)
    for i in order:
        both.add((stays + goes)[i])
        if read_before and rng.random() < 0.3:
            both.refresh()
    counted = sum(len(line.index) for line in goes)
    assert both.withdraw_pass(pass_key(goes[0])) == counted
    assert both.withdraw_pass(pass_key(goes[0])) == 0
    for i in order[order < 10]:
        never.add(stays[i])
    for line in later:
        both.add(line)
        never.add(line)
    both.close_all_passes()
    never.close_all_passes()
    a, b = both.snapshot(), never.snapshot()
    for device in {"A", *(["C"] if add_after else [])}:
        assert answers(a, device) == answers(b, device)
    gone = np.array(a.lines.device_ids)[a.lines.device[a.line]] == "B"
    assert (a.unreliable[gone] == Unreliable.NOT_COUNTED).all()
    assert gone.sum() == counted


def test_a_line_that_comes_after_its_pass_was_withdrawn_stays_out():
    live = new_map()
    lines = surface_scan(lambda x, y: 0 * x)
    for line in lines[:-1]:
        live.add(line)
    live.withdraw_pass(pass_key(lines[0]))
    assert live.add(lines[-1]).left_out == {"withdrawn": 30}
    assert (live.snapshot().neighbours == 0).all()


def test_withdrawing_what_was_never_there_changes_nothing():
    live = new_map()
    for line in surface_scan(lambda x, y: 0 * x):
        live.add(line)
    before = live.snapshot()
    assert live.withdraw_pass(("nobody", 0, 0)) == 0
    assert answers(live.snapshot(), "A") == answers(before, "A")


@pytest.mark.parametrize("thickness_mm", [0.2, 0.3, 0.5, 0.8])
@pytest.mark.parametrize("spacing_mm", [0.2, 0.5])
def test_a_thin_plate_scanned_from_both_sides_has_no_wrong_sign_and_no_doubled_density(thickness_mm, spacing_mm):
    size = {"lines": 40, "points": 120, "spacing": spacing_mm, "along": 0.1, "noise_mm": 0.005}
    rng = np.random.default_rng(11)
    both = new_map(noise_mm=0.005)
    for line in surface_scan(lambda x, y: 0 * x + thickness_mm, rng=rng, **size):
        both.add(line)
    for line in surface_scan(lambda x, y: 0 * x, rng=rng, device_id="B", laser_z=-150.0, **size):
        both.add(line)
    snapshot = both.snapshot()
    up = snapshot.lines.laser_mm[snapshot.line, 2] > 0
    assert ((snapshot.normals[:, 2] > 0) == up)[snapshot.reliable].all()
    assert snapshot.reliable.mean() > 0.9
    # One side alone, at the radius that each point used:
    alone = Oracle(
        np.rint(snapshot.points_mm / Q_MM), snapshot.radius_mm, snapshot.line, snapshot.points_mm, counted=up
    )
    rows = np.flatnonzero(snapshot.reliable & up)[::11]
    count = np.array([len(alone.neighbour_rows(row)) for row in rows])
    assert np.abs(snapshot.same_side[rows] / count - 1.0).max() < 0.05
    if snapshot.radius_mm.min() > 1.2 * thickness_mm:
        assert np.median(snapshot.neighbours[rows] / count) > 1.1  # Eq. 6.4 counts both sides


def test_a_box_seen_from_six_sides_has_no_wrong_sign():
    rng = np.random.default_rng(2)
    live = new_map(max_points=200_000)
    half, k = 3.0, np.arange(-14, 15) * 0.2
    wrong_way = {}
    for axis in range(3):
        for side in (-1, 1):
            device = f"{axis}{side:+d}"
            other = [i for i in range(3) if i != axis]
            for number, y in enumerate(k):
                p = np.zeros((len(k), 3))
                p[:, axis], p[:, other[0]], p[:, other[1]] = side * half, k, y
                p += rng.normal(0, 0.005, p.shape)
                laser, travel = np.zeros(3), np.zeros(3)
                laser[axis], laser[other[1]], travel[other[1]] = side * 100.0, y, 1.0
                live.add(stored(p, number, device_id=device, laser_mm=laser, plane_normal=travel, travel=travel))
            live.close_all_passes()
            wrong_way[device] = (axis, side)
    snapshot = live.snapshot()
    assert snapshot.reliable.mean() > 0.95
    names = np.array(snapshot.lines.device_ids)[snapshot.lines.device[snapshot.line]]
    for device, (axis, side) in wrong_way.items():
        own = snapshot.normals[(names == device) & snapshot.reliable]
        assert (own[:, axis] * side > 0).all()


SURFACES = {
    "plane": (lambda x, y: 0.4 * x, lambda x, y: np.column_stack([-0.4 + 0 * x, 0 * x, 1 + 0 * x])),
    "cylinder": (
        lambda x, y: np.sqrt(400.0 - x * x),
        lambda x, y: np.column_stack([x, 0 * x, np.sqrt(400.0 - x * x)]),
    ),
}


@pytest.mark.parametrize("shape", sorted(SURFACES))
@pytest.mark.parametrize("noise_mm", [0.01, 0.03])
def test_the_predicted_normal_error_covers_the_real_one(shape, noise_mm):
    """Two sigma of the worse of two axes: at least 1 - exp(-2) = 86 % lie within twice the prediction."""
    height, normal = SURFACES[shape]
    live = new_map(noise_mm=noise_mm, max_points=200_000)
    size = {"lines": 80, "points": 200, "along": 0.12}
    for line in surface_scan(height, rng=np.random.default_rng(5), noise_mm=noise_mm, **size):
        live.add(line)
    snapshot = live.snapshot()
    truth = normal(snapshot.points_mm[:, 0], snapshot.points_mm[:, 1])
    truth /= np.linalg.norm(truth, axis=1, keepdims=True)
    inside = snapshot.reliable & (snapshot.offset < 0.15)
    cosine = np.einsum("ij,ij->i", snapshot.normals[inside], truth[inside])
    error = np.arccos(np.clip(cosine, -1, 1))
    share = (error <= 2.0 * snapshot.normal_error_rad[inside]).mean()
    assert share >= 1 - math.exp(-2)
    assert np.sqrt((error**2).mean()) > 0.2 * np.sqrt((snapshot.normal_error_rad[inside] ** 2).mean())  # not vacuous


def test_across_an_edge_no_normal_is_believed_that_is_far_off():
    live = new_map(noise_mm=0.005, max_points=100_000)
    for line in surface_scan(
        lambda x, y: np.abs(x), lines=40, points=120, along=0.1, rng=np.random.default_rng(6), noise_mm=0.005
    ):
        live.add(line)
    snapshot = live.snapshot()
    x = snapshot.points_mm[:, 0]
    truth = np.column_stack([-np.sign(x), 0 * x, 1 + 0 * x]) / math.sqrt(2)
    away = np.abs(x) > snapshot.radius_mm
    error = np.arccos(np.clip(np.einsum("ij,ij->i", snapshot.normals, truth), -1, 1))
    assert np.nanmax(error[away]) < math.radians(5)
    assert snapshot.reliable[away].mean() > 0.95


def test_side_aware_counts_agree_with_the_definition():
    rng = np.random.default_rng(8)
    live = new_map()
    size = {"lines": 14, "points": 30, "rng": rng, "noise_mm": 0.01}
    for line in surface_scan(lambda x, y: 0.3 + 0 * x, **size):
        live.add(line)
    for line in surface_scan(lambda x, y: 0 * x, device_id="B", laser_z=-90.0, **size):
        live.add(line)
    s = live.snapshot()
    laser = s.lines.laser_mm[s.line]
    oracle = Oracle(np.rint(s.points_mm / Q_MM), s.radius_mm, s.line, laser)
    for row in range(0, len(s), 5):
        near = oracle.neighbour_rows(row)
        if not s.reliable[row]:
            assert s.same_side[row] == s.neighbours[row]
            continue
        height = np.einsum("j,ij->i", s.normals[row], laser[near] - s.points_mm[near])
        assert s.same_side[row] == (height >= 0).sum()
