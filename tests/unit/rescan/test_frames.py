"""How a pass looks at the part, line by line, is what the rig says, whether it goes straight or round."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from drivers.rig import Rig, Turntable
from drivers.scanline import Float64Array, Pose, Profile
from scanner_service.analysis.intake import quantise
from scanner_service.analysis.live_map import LiveMap
from scanner_service.analysis.snapshot import MapSnapshot
from scanner_service.rescan.frames import angle_and_depth, frames_of
from scanner_service.rescan.stations import stations_of

LASER_MM = np.array([0.0, 0.0, 150.0])
RADIUS_MM = 30.0


def rotation(about: Float64Array, angle_rad: float) -> Float64Array:
    x, y, z = about
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle_rad) * cross + (1.0 - math.cos(angle_rad)) * (cross @ cross)


def sensor_beside(turn_deg: float, lean_deg: float) -> Pose:
    """Beside the axis z, looking at it; its line is turned about the way it looks, and that leans out of level."""
    level = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # x to the stage's y, z to its x
    lean = rotation(np.array([0.0, 1.0, 0.0]), math.radians(lean_deg))
    return Pose(lean @ level @ rotation(np.array([0.0, 0.0, 1.0]), math.radians(turn_deg)), np.zeros(3))


def scanned(rig: Rig, positions_mm: Float64Array) -> MapSnapshot:
    """Lines over surface that fills one side of the fan more than the other, uneven in depth."""
    live_map = LiveMap()
    x = np.linspace(-4.0, 12.0, 17)
    for number, at in enumerate(positions_mm.tolist()):
        z = 10.0 + np.sin(x) + 0.1 * math.sin(number)
        profile = Profile("S", 1, 0, number, 0.1 * number, 0.0, x, z, np.zeros(17, bool), LASER_MM, at, 1.0, math.nan)
        live_map.add(quantise(rig.place(profile), live_map.origin_mm))
    return live_map.snapshot()


@given(
    turn_deg=st.floats(-180, 180), lean_deg=st.floats(-60, 60), begin_deg=st.floats(0, 360),
    step_deg=st.floats(1.2, 5.0), backward=st.booleans(), count=st.sampled_from([4, 20, 80]),
)  # fmt: skip
def test_each_line_of_a_turning_part_is_seen_along_the_sensors_own_axes(
    turn_deg: float, lean_deg: float, begin_deg: float, step_deg: float, backward: bool, count: int
) -> None:
    rig = Rig(
        stage_from_sensor=sensor_beside(turn_deg, lean_deg), turntable=Turntable(np.array([0.0, 0.0, 1.0]), RADIUS_MM)
    )
    first = rig.place(
        Profile("S", 1, 0, 0, 0.0, 0.0, *np.zeros((2, 1)), np.zeros(1, bool), LASER_MM, 0.0, 1.0, math.nan)
    )
    z = np.array([0.0, 0.0, 1.0])
    assume(
        np.linalg.norm(np.cross(first.plane_normal, z)) > 0.35
    )  # a level plane tells not how far round the sensor is
    assume(first.plane_normal @ first.travel > 0.1)  # nor does one that is pulled along its own line scan anything
    turned = np.radians(begin_deg + step_deg * np.arange(count) * (-1 if backward else 1))
    snapshot = scanned(rig, RADIUS_MM * turned)
    stations = stations_of(snapshot.lines)
    frames = frames_of(snapshot, stations, rig.part_from_sensor(0.0).rotate(z))
    along, axis = frames.of_lines(snapshot.lines, np.arange(count), stations.group)
    poses = [rig.part_from_sensor(float(line)) for line in snapshot.lines.position_mm]
    np.testing.assert_allclose(axis, [-pose.rotate(z) for pose in poses], atol=1e-4)
    line = snapshot.line
    _, depth = angle_and_depth(snapshot.points_mm - snapshot.lines.laser_mm[line], along[line], axis[line])
    inside = [poses[at].inverse().apply(snapshot.points_mm[[row]])[0, 2] for row, at in enumerate(line)]
    np.testing.assert_allclose(depth, LASER_MM[2] - np.array(inside), atol=0.01)


@pytest.mark.parametrize("towards_known", [True, False])
def test_the_frame_of_a_straight_pass_is_one_for_all_lines(towards_known: bool) -> None:
    snapshot = scanned(Rig(), np.arange(30.0))
    stations = stations_of(snapshot.lines)
    frames = frames_of(snapshot, stations, np.array([0.0, 0.0, 1.0]) if towards_known else None)
    assert np.isnan(frames.turn).all()
    along, axis = frames.of_lines(snapshot.lines, np.arange(30), stations.group)
    assert (along == frames.along).all() and (axis == frames.axis).all()
    assert abs(along[0, 0]) == pytest.approx(1.0, abs=0.01)
    assert axis[0, 2] == (-1.0 if towards_known else pytest.approx(-1.0, abs=0.05))


def test_planes_that_wander_as_those_of_a_hand_do_are_no_turn() -> None:
    rng = np.random.default_rng(4)
    live_map, x = LiveMap(), np.linspace(-4.0, 12.0, 17)
    for number in range(30):
        z = np.full(17, 10.0)
        profile = Profile("S", 1, 0, number, 0.0, 0.0, x, z, np.zeros(17, bool), LASER_MM, float(number), 1.0, math.nan)
        about = rng.normal(size=3)
        hand = rotation(about / np.linalg.norm(about), rng.normal(0.0, 0.05))
        line = Rig(stage_from_sensor=Pose(hand, np.zeros(3))).place(profile)
        live_map.add(quantise(line, live_map.origin_mm))
    snapshot = live_map.snapshot()
    assert np.isnan(frames_of(snapshot, stations_of(snapshot.lines)).turn).all()
