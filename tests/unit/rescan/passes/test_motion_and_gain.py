"""Sights, densities and stretches: against geometry, the simulator, and every other choice."""

import dataclasses
import math

import numpy as np
import pytest

from drivers.rig import Rig, Turntable
from drivers.scanline import Pose
from scanner_service.rescan.passes.errors import OpticsUnknown, PassOutOfReach, RigUnlimited
from scanner_service.rescan.passes.fan import measured_optics
from scanner_service.rescan.passes.gain import prospect_of
from scanner_service.rescan.passes.guidance import guide
from scanner_service.rescan.passes.known_surface import know_surface
from scanner_service.rescan.passes.motion import StraightMotion, TurningMotion
from scanner_service.rescan.passes.needs import Needs
from scanner_service.rescan.passes.optics import ScannerOptics
from scanner_service.rescan.passes.reach import Attitude, PartTurn, Reach
from scanner_service.rescan.passes.recommendation import RecommendedPass
from scanner_service.rescan.passes.stretch import best_stretch
from simulators.parts import plate, step
from tests.unit.rescan.passes.posed_scans import FROM_ABOVE, OPTICS, SCANNER, Bench, free_reach, linear_reach


def rotation(seed):
    q, _ = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))
    return q * np.sign(np.linalg.det(q))


@pytest.mark.parametrize("seed", range(4))
def test_a_place_lies_in_the_laser_plane_at_its_position(seed):
    rng = np.random.default_rng(seed)
    turn = rotation(seed)
    motion = StraightMotion(Pose(turn, rng.standard_normal(3) * 20), rotation(seed + 9)[:, 0].copy())
    places = rng.standard_normal((50, 3)) * 10
    sights = motion.sights(places, OPTICS)
    for place, at, local, laser in zip(places, sights.position_mm, sights.local_mm, sights.laser_mm, strict=True):
        pose = motion.part_from_sensor(at)
        assert pose.inverse().apply(place) == pytest.approx(local, abs=1e-6)
        assert abs(local[1]) < 1e-6
        assert pose.apply(OPTICS.geometry.laser_mm) == pytest.approx(laser, abs=1e-6)


def test_a_turning_part_is_seen_as_its_rig_places_it():
    table = Turntable(np.array([0.0, 0.0, 1.0]), 20.0)
    sensor = Pose(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), np.array([1.0, -6.0, 5.0]))
    rig = Rig(stage_from_sensor=sensor, turntable=table)
    motion = TurningMotion(rig.part_from_sensor(0.0), np.array([0.0, 0.0, 1.0]), 20.0)
    for at in (0.0, 7.0, 31.0):
        assert motion.part_from_sensor(at).rotation == pytest.approx(rig.part_from_sensor(at).rotation, abs=1e-12)
    places = np.random.default_rng(2).standard_normal((40, 3)) * 8
    sights = motion.sights(places, OPTICS)
    met = np.isfinite(sights.position_mm)
    assert met.sum() > 30
    for place, at, local in zip(places[met], sights.position_mm[met], sights.local_mm[met], strict=True):
        assert motion.part_from_sensor(at).inverse().apply(place) == pytest.approx(local, abs=1e-6)
        assert abs(local[1]) < 1e-6


@pytest.mark.parametrize("tilt_deg", [0.0, 30.0, 50.0])
def test_the_density_foretold_is_the_density_that_the_simulator_gives(tilt_deg):
    bench = Bench(plate().surface).scan(FROM_ABOVE, 0.0, 40.0, 0.4)
    snapshot, _ = bench.judged()
    none = np.zeros(len(snapshot), dtype=bool)
    surface = know_surface(snapshot, none, none.astype(np.int32))
    place = np.array([[0.0, 20.0, 0.0]])
    a = math.radians(tilt_deg)
    turn = np.array([[1, 0, 0], [0, math.cos(a), -math.sin(a)], [0, math.sin(a), math.cos(a)]])
    motion = StraightMotion(Pose(turn, place[0] - 0.0 * turn[:, 2]), turn[:, 1].copy())
    needs = Needs.plain(place, np.array([[0.0, 0.0, 1.0]]), np.ones(1))
    foretold = prospect_of(surface, needs, motion, OPTICS).per_line_mm[0] / 0.3
    fresh = Bench(plate().surface)
    lines = list(fresh.posed.scan(motion.part_from_sensor, -6.0, 6.0, 0.3))
    points = np.concatenate([line.points_mm[np.isfinite(line.points_mm[:, 0])] for line in lines])
    counted = (np.linalg.norm(points - place[0], axis=1) < 3.0).sum() / (math.pi * 9.0)
    assert counted == pytest.approx(foretold, rel=0.06)


def test_what_is_foretold_to_be_seen_is_seen_and_the_shadow_is_not():
    bench = Bench(step().surface).scan(FROM_ABOVE, -1.0, 41.0, 0.3)
    snapshot, _ = bench.judged()
    none = np.zeros(len(snapshot), dtype=bool)
    surface = know_surface(snapshot, none, none.astype(np.int32))
    y = np.arange(4.0, 19.5, 0.5)
    places = np.column_stack([np.zeros_like(y), y, np.zeros_like(y)])
    up = np.tile([0.0, 0.0, 1.0], (len(y), 1))
    needs = Needs.plain(places, up, np.ones(len(y)))
    prospect = prospect_of(surface, needs, FROM_ABOVE, OPTICS)
    shadow = y > 20.0 - 5.0 * math.tan(math.radians(27.0))  # the camera stands at +y, the step is 5 mm high
    clear = np.abs(y - (20.0 - 5.0 * math.tan(math.radians(27.0)))) > 2.0 * surface.cell_mm
    assert (prospect.coarsest_mm > 0)[~shadow & clear].all()
    assert prospect.camera_blocked[shadow & clear & (y < 20.0 - 2.0 * surface.cell_mm)].all()


def test_the_stretch_chosen_is_no_worse_than_any_other():
    rng = np.random.default_rng(5)
    position, limit, gain = rng.uniform(0, 50, 300), rng.uniform(0.1, 0.5, 300), rng.uniform(0, 2, 300)
    gain[(position > 20) & (position < 30)] = 0.0
    seconds = lambda length, spacing: (np.floor(length / spacing) + 1) / 200.0  # noqa: E731
    best = best_stretch(position, limit, gain, (0.05, 1.0), (-10.0, 60.0), seconds, 0.5)
    served = best.serves(position, limit)
    assert best.gain_mm2 == pytest.approx(gain[served].sum(), rel=0.05)
    for _ in range(300):
        a, b = np.sort(rng.uniform(0, 50, 2))
        spacing = rng.uniform(0.1, 0.5)
        worth = gain[(position >= a) & (position <= b) & (limit >= spacing)].sum()
        assert worth / (0.5 + float(seconds(np.array(b - a), spacing))) <= 1.1 * best.gain_per_s


def test_without_any_gain_there_is_no_stretch():
    nothing = best_stretch(
        np.zeros(3), np.zeros(3), np.ones(3), (0.05, 1.0), (-1.0, 1.0), lambda length, spacing: length, 1.0
    )
    assert nothing is None


def test_a_pass_beyond_the_limits_is_refused_with_the_reason():
    linear = linear_reach()
    with pytest.raises(PassOutOfReach, match="outside the stage's travel"):
        linear.check(FROM_ABOVE, 0.0, 80.0, 0.3)
    with pytest.raises(PassOutOfReach, match="line spacing"):
        linear.check(FROM_ABOVE, 0.0, 40.0, 3.0)
    free = free_reach(max_tilt_deg=30.0, box_mm=50.0)
    with pytest.raises(PassOutOfReach, match="outside the box"):
        free.check(FROM_ABOVE, 0.0, 80.0, 0.3)
    a = math.radians(40.0)
    tilted = np.array([[1, 0, 0], [0, math.cos(a), -math.sin(a)], [0, math.sin(a), math.cos(a)]])
    with pytest.raises(PassOutOfReach, match="tilt"):
        free.check(StraightMotion(Pose(tilted, np.zeros(3)), tilted[:, 1].copy()), 0.0, 1.0, 0.3)


def test_a_rig_without_limits_is_refused():
    limits = linear_reach().limits
    with pytest.raises(RigUnlimited, match="travel_mm"):
        Reach(type(limits)(limits.axis, (-math.inf, math.inf), (0, 1), (0, 1), None, (-1, 1)))
    with pytest.raises(RigUnlimited, match="line_rate_hz"):
        Reach(type(limits)(limits.axis, (0.0, 1.0), (0, 1), (0, math.inf), None, (-1, 1)))


def test_every_attitude_of_a_free_rig_is_allowed_and_right_handed():
    reach = free_reach(max_tilt_deg=50.0)
    attitudes = reach.attitudes(np.zeros(3))
    assert len(attitudes) > 50
    for attitude in (*attitudes, *reach.near(Attitude(np.eye(3), None))):
        assert reach.tilt_rad(attitude.rotation) <= reach.max_tilt_rad + 1e-9
        assert np.linalg.det(attitude.rotation) == pytest.approx(1.0)


def test_turning_the_part_is_the_sensor_going_round_it():
    turn = PartTurn(math.radians(90.0), math.radians(30.0), (0.0, 20.0, 0.0))
    middle = np.array([0.0, 20.0, 0.0])
    attitudes = linear_reach(part_may_turn=True).attitudes(middle)
    attitude = next(one for one in attitudes if one.turn == turn)
    place = np.array([3.0, 22.0, 1.0])
    moved = turn.rotation @ (place - middle) + middle  # where it lies, seen from the rig, once the part is turned
    pose = attitude.motion.part_from_sensor(17.0)
    assert pose.inverse().apply(place) == pytest.approx(moved - np.array([0.0, 17.0, 0.0]), abs=1e-9)
    assert "turn the part by 90°" in str(turn) and str(turn).endswith("the point 0, 20, 0 mm stays in its place")
    assert "the point 0, 20, 0 mm" in str(dataclasses.replace(turn, about_mm=(-0.2, 20.0, -0.0)))  # no -0


def test_the_field_of_view_is_measured_from_the_points():
    snapshot, _ = Bench(plate().surface).scan(FROM_ABOVE, 0.0, 20.0, 0.4).judged()
    found = measured_optics(snapshot, SCANNER.geometry(), FROM_ABOVE, SCANNER.points_per_line)
    assert found.field_of_view_mm == pytest.approx(SCANNER.field_of_view_mm, rel=0.002)
    assert abs(found.middle_mm) < 0.05


def test_optics_that_cannot_be_meant_are_refused():
    with pytest.raises(OpticsUnknown, match="field of view"):
        ScannerOptics(SCANNER.geometry(), 0.0, 400)
    with pytest.raises(OpticsUnknown, match="field of view"):
        ScannerOptics(SCANNER.geometry(), 50.0, 1)


def wanted_pass():
    nothing, none = np.zeros((0, 3)), (np.zeros(0) for _ in range(4))
    return RecommendedPass(
        1, FROM_ABOVE, 0.0, 40.0, 0.2, 50.0, 4.0, 0.0, (), nothing, *none, nothing.copy(), np.zeros(0, bool)
    )


@pytest.mark.parametrize(
    ("laser", "speed", "say"),
    [
        ((0.0, 10.0, 150.0), 8.0, "good; 30 mm to go"),
        ((0.0, 10.0, 150.0), 30.0, "slower"),
        ((9.0, 10.0, 150.0), 8.0, "towards -x"),
        ((0.0, -20.0, 150.0), 8.0, "20 mm to the start"),
        ((0.0, 50.0, 150.0), 8.0, "done"),
    ],
)
def test_a_hand_is_told_where_and_how_fast(laser, speed, say):
    found = guide(wanted_pass(), OPTICS.geometry.laser_mm, np.array(laser), np.array([0.0, 1.0, 0.0]), speed)
    assert say in found.say


def test_a_hand_that_holds_the_scanner_askew_is_told_to_turn_it():
    normal = np.array([math.sin(0.5), math.cos(0.5), 0.0])
    found = guide(wanted_pass(), OPTICS.geometry.laser_mm, np.array([0.0, 10.0, 150.0]), normal, 8.0)
    assert "turn the scanner by 29°" in found.say
