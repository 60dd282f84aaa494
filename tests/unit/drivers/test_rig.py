"""Profiles are placed where the rig says: checked against the definition, term by term."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from drivers.errors import PositionUnknown
from drivers.rig import Rig, Turntable
from drivers.scanline import Pose, Profile

ANGLES = st.tuples(*[st.floats(-math.pi, math.pi)] * 3)
LENGTHS = st.tuples(*[st.floats(-500, 500)] * 3)


def profile(**changes: Any) -> Profile:
    fields: dict[str, Any] = {
        "device_id": "S",
        "boot_id": 1,
        "pass_index": 2,
        "line_index": 3,
        "device_time_s": 0.5,
        "arrival_s": 0.0,
        "x_mm": np.array([-1.0, 0.0, np.nan, 2.0]),
        "z_mm": np.array([5.0, 6.0, 7.0, np.nan]),
        "missing": np.array([False, False, False, True]),
        "laser_mm": np.array([0.0, 0.0, 100.0]),
        "position_mm": 12.5,
        "line_spacing_mm": 0.1,
        "step_mm": 0.09,
    }
    return Profile(**(fields | changes))


def pose(angles: tuple[float, ...], shift: tuple[float, ...]) -> Pose:
    return Pose(Rotation.from_euler("xyz", angles).as_matrix(), np.array(shift))


def test_the_default_rig_puts_points_at_x_position_z() -> None:
    line = Rig().place(profile())
    np.testing.assert_array_equal(line.points_mm[:2], [[-1.0, 12.5, 5.0], [0.0, 12.5, 6.0]])
    assert np.isnan(line.points_mm[2:]).all()
    np.testing.assert_array_equal(line.laser_mm, [0.0, 12.5, 100.0])
    np.testing.assert_array_equal(line.plane_normal, [0.0, 1.0, 0.0])
    np.testing.assert_array_equal(line.travel, [0.0, 1.0, 0.0])
    np.testing.assert_array_equal(line.missing, [False, False, False, True])
    assert (line.device_id, line.boot_id, line.pass_index, line.line_index) == ("S", 1, 2, 3)
    assert (line.position_mm, line.line_spacing_mm, line.step_mm, line.device_time_s) == (12.5, 0.1, 0.09, 0.5)


@given(ANGLES, LENGTHS, ANGLES, LENGTHS, ANGLES, st.floats(-300, 300))
def test_any_rig_follows_the_definition_and_its_normal_agrees_with_the_travel(
    a: tuple[float, ...],
    b: tuple[float, ...],
    c: tuple[float, ...],
    d: tuple[float, ...],
    e: tuple[float, ...],
    s: float,
) -> None:
    part_from_stage, stage_from_sensor = pose(a, b), pose(c, d)
    travel = Rotation.from_euler("xyz", e).apply([1.0, 0.0, 0.0])
    line = Rig(part_from_stage, stage_from_sensor, travel).place(profile(position_mm=s))
    for k, (x, z) in enumerate([(-1.0, 5.0), (0.0, 6.0)]):
        on_stage = stage_from_sensor.rotation @ [x, 0.0, z] + np.array(d) + s * travel
        np.testing.assert_allclose(line.points_mm[k], part_from_stage.rotation @ on_stage + np.array(b), atol=1e-9)
    assert float(line.plane_normal @ line.travel) >= 0
    # The plane holds the line's points and the laser.
    np.testing.assert_allclose((line.points_mm[:2] - line.laser_mm) @ line.plane_normal, 0, atol=1e-9)
    assert np.linalg.norm(line.travel) == pytest.approx(1)
    # Travel is where the points go as the stage moves on.
    on = Rig(part_from_stage, stage_from_sensor, travel).place(profile(position_mm=s + 1))
    np.testing.assert_allclose(on.points_mm[0] - line.points_mm[0], line.travel, atol=1e-9)


def test_a_line_without_a_position_is_placed_only_when_one_is_given() -> None:
    with pytest.raises(PositionUnknown, match="line 3 of S has no stage position"):
        Rig().place(profile(position_mm=math.nan))
    assert Rig().place(profile(position_mm=math.nan), position_mm=4.0).position_mm == 4.0


def test_a_travel_that_is_no_unit_vector_is_refused() -> None:
    for wrong in (np.array([0.0, 2.0, 0.0]), np.zeros(3), np.array([0.0, 1.0]), np.full(3, np.nan)):
        with pytest.raises(ValueError, match="unit vector"):
            Rig(travel_stage=wrong)


@given(ANGLES, LENGTHS, ANGLES, LENGTHS, st.floats(-4, 4), st.floats(1, 500))
def test_a_turntable_turns_the_sensor_about_its_axis(
    part_angles: tuple[float, ...],
    part_shift: tuple[float, ...],
    sensor_angles: tuple[float, ...],
    sensor_shift: tuple[float, ...],
    turns: float,
    radius_mm: float,
) -> None:
    part_from_stage, stage_from_sensor = pose(part_angles, part_shift), pose(sensor_angles, sensor_shift)
    axis = np.array([0.0, 0.6, 0.8])
    rig = Rig(part_from_stage, stage_from_sensor, turntable=Turntable(axis, radius_mm))
    position_mm = turns * 2 * math.pi * radius_mm
    line = rig.place(profile(position_mm=position_mm))
    turn = Rotation.from_rotvec(axis * turns * 2 * math.pi).as_matrix()
    sensor_mm = np.array([-1.0, 0.0, 5.0])
    in_stage = turn @ stage_from_sensor.apply(sensor_mm)
    np.testing.assert_allclose(line.points_mm[0], part_from_stage.apply(in_stage), atol=1e-8)
    laser_stage = turn @ stage_from_sensor.apply(np.array([0.0, 0.0, 100.0]))
    np.testing.assert_allclose(line.laser_mm, part_from_stage.apply(laser_stage), atol=1e-8)
    # The travel is where the laser goes: the derivative of its place.
    ahead = rig.place(profile(position_mm=position_mm + 1e-4 * radius_mm))
    gone = ahead.laser_mm - line.laser_mm
    if np.linalg.norm(np.cross(axis, laser_stage)) > 1.0:
        np.testing.assert_allclose(gone / np.linalg.norm(gone), line.travel, atol=2e-4)
    assert float(line.plane_normal @ line.travel) >= 0


def test_a_laser_on_the_axis_of_a_turntable_travels_along_its_plane_s_normal() -> None:
    rig = Rig(turntable=Turntable(np.array([0.0, 0.0, 1.0]), 40.0))
    np.testing.assert_allclose(rig.place(profile(position_mm=0.0)).travel, [0.0, 1.0, 0.0], atol=1e-12)
    for radius_mm in (0.0, -1.0, math.nan):
        with pytest.raises(ValueError, match="radius"):
            Turntable(np.array([0.0, 0.0, 1.0]), radius_mm)
