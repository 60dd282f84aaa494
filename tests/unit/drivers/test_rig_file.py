"""Rig files: what is written is what is meant, and every mistake is told with its place."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from drivers.errors import RigInvalid
from drivers.rig_description import PairBy
from drivers.rig_file import parse_rig, read_rig, rotation_about_axes
from drivers.rig_limits import AxisKind, PassOrder, RigLimits

LINEAR = """
name = "bench"
[scanner]
kind = "native"
port = "/dev/serial/by-id/usb-scanner"
laser_mm = [0, 0, 150]
camera_mm = [0, 60, 150]
range_mm = [-25, 25]
field_of_view_mm = [-20, 20]
noise_mm = 0.005
line_rate_hz = [1, 200]
[stage]
kind = "grbl"
port = "usb:1a86:7523"
baud_rate = 115200
travel_mm = [0, 300]
speed_mm_per_s = [0.5, 40]
options = { letter = "Y" }
[mounting]
travel = [0, -2, 0]
part_from_stage = { translation_mm = [1, 2, 3] }
stage_from_sensor = { rotation_deg = [0, 30, 0] }
[pairing]
by = "time"
latency_ms = 4
"""

TURNTABLE = """
[scanner]
kind = "rplidar"
port = "/dev/ttyUSB0"
[stage]
kind = "zaber"
port = "/dev/ttyUSB1"
axis = "turntable"
radius_mm = 50
turn_deg = [-180, 180]
speed_deg_per_s = [0, 90]
"""


def problems_of(text: str) -> tuple[str, ...]:
    with pytest.raises(RigInvalid) as caught:
        parse_rig(text, "bench.toml")
    assert str(caught.value).startswith("bench.toml: ")
    return caught.value.problems


def test_a_linear_rig_is_read_as_it_is_written() -> None:
    described = parse_rig(LINEAR)
    assert (described.name, described.scanner.kind, described.stage.options["letter"]) == ("bench", "native", "Y")
    limits = described.limits
    assert limits.axis is AxisKind.LINEAR
    assert (limits.travel_mm, limits.standoff_mm) == ((0.0, 300.0), (125.0, 175.0))
    assert limits.line_spacing_mm == (0.0025, 40.0)
    assert described.pairing.by is PairBy.TIME
    assert described.pairing.latency_s == pytest.approx(0.004)
    at = described.rig().part_from_sensor(10.0)
    np.testing.assert_allclose(at.translation_mm, [1, -8, 3])  # the direction is made a unit vector
    np.testing.assert_allclose(at.rotation, Rotation.from_euler("y", 30, degrees=True).as_matrix(), atol=1e-15)


def test_a_turntable_is_told_in_degrees_and_kept_as_arc() -> None:
    described = parse_rig(TURNTABLE, "turn.toml")
    assert described.name == "turn"
    limits = described.limits
    assert limits.travel_mm == pytest.approx((-50 * math.pi, 50 * math.pi))
    assert limits.speed_mm_per_s[1] == pytest.approx(25 * math.pi)
    assert described.mm_per_unit * 360 == pytest.approx(2 * math.pi * 50)
    quarter = described.rig().part_from_sensor(50 * math.pi / 2).rotation
    np.testing.assert_allclose(quarter, Rotation.from_euler("z", 90, degrees=True).as_matrix(), atol=1e-15)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("kind = \"grbl\"", "knd = 'grbl'"), "[stage] knd: is not known; did you mean kind?"),
        (("travel_mm = [0, 300]", "travel_mm = [300, 0]"), "[stage] travel_mm: must be [lowest, highest], not"),
        (("travel_mm = [0, 300]", ""), "[stage] travel_mm: is missing"),
        (("port = \"usb:1a86:7523\"", ""), "[stage] port: is missing"),
        (("port = \"usb:1a86:7523\"", "port = 'spy://x'"), "[stage] port: must be a path such as"),
        (("[0, 0, 150]", "[0, 0, 20]"), "[scanner] laser_mm: the laser at z = 20 mm must stand above"),
        (("range_mm = [-25, 25]", ""), "[scanner] range_mm: is missing"),
        (("latency_ms = 4", "latency_ms = -4"), "[pairing] latency_ms: must be a number of 0 or more, not -4"),
        (("latency_ms = 4", "latency_ms = nan"), "[pairing] latency_ms: must be a number of 0 or more, not nan"),
        (("by = \"time\"", "by = 'luck'"), "[pairing] by: must be one of device, time, count, not 'luck'"),
        (("travel = [0, -2, 0]", "travel = [0, 0, 0]"), "[mounting] travel: must be a direction, not three zeros"),
        (("{ rotation_deg = [0, 30, 0] }", "{ rotation = [[1,0,0],[0,1,0],[0,0,2]] }"),
         "[mounting.stage_from_sensor] rotation: the rotation of a pose must be orthonormal"),
        (("{ letter = \"Y\" }", "{ letter = [1] }"), "[stage] options.letter: must be a text"),
        (("noise_mm = 0.005", f"noise_mm = 1{'0' * 400}"), "[scanner] noise_mm: must be a number of 0 or more, not 1"),
        (("[pairing]", "[pairing"), "it is not TOML"),
    ],
)  # fmt: skip
def test_a_mistake_is_told_with_its_place(change: tuple[str, str], said: str) -> None:
    assert any(said in problem for problem in problems_of(LINEAR.replace(*change))), problems_of(
        LINEAR.replace(*change)
    )


def test_all_mistakes_are_told_at_once_and_an_absent_table_once() -> None:
    assert problems_of("") == ("scanner: is missing", "stage: is missing")
    assert len(problems_of(LINEAR.replace("usb:1a86:7523", "COM3").replace("-25", "'a'"))) == 2


def test_an_encoder_and_a_conveyor_are_not_driven_and_need_no_port() -> None:
    head = LINEAR.split("[stage]", maxsplit=1)[0]
    encoder = parse_rig(head + "[stage]\nkind = 'encoder'\n")
    assert (encoder.limits.is_driven, encoder.pairing.by, encoder.stage.port) == (False, PairBy.DEVICE, None)
    belt = parse_rig(head + "[stage]\nkind = 'constant_speed'\nspeed_mm_per_s = [50, 50]\n")
    assert (belt.limits.is_driven, belt.pairing.by) == (False, PairBy.TIME)
    assert "[v, v]" in problems_of(head + "[stage]\nkind = 'constant_speed'\nspeed_mm_per_s = [0, 50]\n")[0]
    assert "pair by" in problems_of(head + "[stage]\nkind = 'encoder'\n[pairing]\nby = 'time'\n")[0]


def test_a_file_that_cannot_be_read_is_told(tmp_path: Any) -> None:
    with pytest.raises(RigInvalid, match="cannot be read"):
        read_rig(tmp_path / "absent.toml")
    binary = tmp_path / "binary.toml"
    binary.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(RigInvalid, match="cannot be read"):
        read_rig(binary)
    large = tmp_path / "large.toml"
    large.write_bytes(b"#" * 100_000)
    with pytest.raises(RigInvalid, match="at most 65536 bytes"):
        read_rig(large)
    written = tmp_path / "bench.toml"
    written.write_text(LINEAR)
    assert read_rig(written).limits.travel_mm == (0.0, 300.0)


@given(st.tuples(*[st.floats(-360, 360)] * 3))
def test_angles_about_fixed_axes_are_scipys(degrees: tuple[float, float, float]) -> None:
    expected = Rotation.from_euler("xyz", degrees, degrees=True).as_matrix()
    np.testing.assert_allclose(rotation_about_axes(np.array(degrees)), expected, atol=1e-12)


@given(st.text(max_size=200))
def test_any_text_is_a_rig_or_is_told_why_not(text: str) -> None:
    try:
        parse_rig(text)
    except RigInvalid as error:
        assert error.problems


@given(st.sampled_from(LINEAR.splitlines()), st.sampled_from(LINEAR.splitlines()))
def test_lines_in_any_place_are_a_rig_or_are_told_why_not(line: str, at: str) -> None:
    try:
        parse_rig(LINEAR.replace(at, line, 1))
    except RigInvalid as error:
        assert error.problems


def test_limits_say_why_a_pass_cannot_be() -> None:
    limits = parse_rig(LINEAR).limits
    assert limits.why_not(0.0, 300.0) is None
    assert limits.why_not(-1.0, 10.0) == "the start at -1 mm is outside the stage's travel of 0 to 300 mm"
    assert limits.why_not(0.0, math.nan) is not None


@pytest.mark.parametrize(
    ("rates", "speeds", "order", "said"),
    [
        ((0.0, math.inf), (50.0, 50.0), (1e-4, math.nan), None),  # nothing tells the line rate yet
        ((5.0, 10.0), (50.0, 50.0), (1e-4, math.nan), "at least 5 mm apart: 50 mm/s at 10 lines a second"),
        ((5.0, 10.0), (50.0, 50.0), (12.0, math.nan), "at most 10 mm apart: 50 mm/s at 5 lines a second"),
        ((5.0, 10.0), (50.0, 50.0), (5.0, math.nan), None),
        ((5.0, 10.0), (0.0, 50.0), (1e-4, math.nan), None),  # a stage may go as slowly as that
        ((5.0, 10.0), (0.0, 50.0), (1e-4, 20.0), "at least 2 mm apart: 20 mm/s at 10 lines a second"),
        ((5.0, 10.0), (0.0, 50.0), (1e-4, 0.0), None),  # at rest any spacing can be had
    ],
)
def test_lines_come_as_far_apart_as_speeds_and_rates_let_them(rates, speeds, order, said) -> None:
    limits = RigLimits(AxisKind.LINEAR, (0.0, 300.0), speeds, rates, None, (-50.0, 50.0))
    why = limits.why_not_spaced(PassOrder(0.0, 100.0, *order))
    assert (why is None) if said is None else (why is not None and why.endswith(said))
    with pytest.raises(ValueError, match="lowest, highest"):
        RigLimits(AxisKind.LINEAR, (1, 0), (0, 1), (0, 1), None, (0, 1))
    with pytest.raises(ValueError, match="radius"):
        RigLimits(AxisKind.TURNTABLE, (0, 1), (0, 1), (0, 1), None, (0, 1))


def test_an_order_counts_its_lines_and_refuses_what_is_no_pass() -> None:
    assert PassOrder(0.0, 1.0, 0.1).line_count == 11
    assert PassOrder(1.0, 0.0, 0.3).line_count == 4
    for wrong in ((0.0, 0.0, 0.1), (0.0, 1.0, 0.0), (0.0, math.inf, 0.1), (0.0, 1.0, math.nan)):
        with pytest.raises(ValueError, match=r"pass|spacing"):
            PassOrder(*wrong)
    with pytest.raises(ValueError, match="speed"):
        PassOrder(0.0, 1.0, 0.1, -1.0)
