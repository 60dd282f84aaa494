"""Rig files: TOML into a `RigDescription`, every mistake told in one sentence with its place; opens no device."""

import math
import tomllib
from pathlib import Path
from types import MappingProxyType

import numpy as np

from drivers.errors import RigInvalid
from drivers.rig_description import ENDLESS, DeviceChoice, Option, PairBy, Pairing, RigDescription
from drivers.rig_limits import AxisKind, Interval, RigLimits
from drivers.rig_table import RigTable
from drivers.scanline import Float64Array, Pose, SensorGeometry

MAX_BYTES = 65_536
_NO_PORT = ("encoder", "constant_speed")
_NOT_DRIVEN = ("encoder", "constant_speed")


def read_rig(path: Path) -> RigDescription:
    """Read a rig file.

    Raises
    ------
    RigInvalid : when it cannot be read, is no TOML, or does not describe a rig; all problems are told at once.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            raise RigInvalid(path.name, (f"a rig file has at most {MAX_BYTES} bytes; this is something else",))
        text = path.read_text(encoding="utf-8")
    except (OSError, ValueError) as error:  # ValueError: not UTF-8, or a path with a NUL
        raise RigInvalid(str(path), (f"the file cannot be read ({error}); give the path of a rig file",)) from None
    return parse_rig(text, path.name)


def parse_rig(text: str, source: str = "rig") -> RigDescription:
    """Parse the text of a rig file; `source` names it in messages.

    Raises
    ------
    RigInvalid : when it is no TOML or does not describe a rig; all problems are told at once.
    """
    try:
        content = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise RigInvalid(source, (f"it is not TOML: {error}",)) from None
    problems: list[str] = []
    top = RigTable(content, "", problems)
    name = top.text("name", default=source.removesuffix(".toml"))
    scanner_table, stage_table = top.table("scanner", needed=True), top.table("stage", needed=True)
    mounting, pairing_table = top.table("mounting"), top.table("pairing")
    scanner, geometry, view_mm, rate_hz = _scanner(scanner_table)
    stage, limits = _stage(stage_table, geometry, view_mm, rate_hz)
    pairing = _pairing(pairing_table, stage)
    direction, part_from_stage, stage_from_sensor = _mounting(mounting, limits)
    top.finish()
    if problems or limits is None:
        raise RigInvalid(source, tuple(problems) or ("it does not describe a rig",))
    return RigDescription(name, scanner, stage, limits, pairing, part_from_stage, stage_from_sensor, direction)


def _scanner(table: RigTable) -> tuple[DeviceChoice, SensorGeometry | None, Interval, Interval]:
    choice = _device(table, needs_port=True)
    view_mm = table.interval("field_of_view_mm", ENDLESS)
    rate_hz = table.interval("line_rate_hz", (0.0, math.inf), lowest=0.0)
    geometry = _geometry(table)
    table.finish()
    return choice, geometry, view_mm, rate_hz


def _geometry(table: RigTable) -> SensorGeometry | None:
    """The optics, when the file tells any of them; then it must tell laser and range."""
    names = ("laser_mm", "camera_mm", "range_mm", "noise_mm")
    if not any(table.has(name) for name in names):
        return None
    laser_mm = table.vector("laser_mm", needed=True)
    camera_mm = table.vector("camera_mm", laser_mm)
    range_mm = table.interval("range_mm", (math.nan, math.nan), needed=True)
    noise_mm = table.number("noise_mm", 0.0, lowest=0.0)
    if float(laser_mm[2]) <= range_mm[1]:
        table.problem(
            "laser_mm", f"the laser at z = {float(laser_mm[2]):g} mm must stand above the range_mm it looks down into"
        )
    return SensorGeometry(laser_mm, camera_mm.copy(), range_mm, noise_mm)


def _device(table: RigTable, needs_port: bool) -> DeviceChoice:
    kind = table.text("kind", needed=True)
    port = table.text("port") or None
    if port is not None and not (port.startswith(("/", "usb:")) and "\0" not in port):
        table.problem("port", f"must be a path such as /dev/serial/by-id/... or usb:VID:PID:SERIAL, not {port!r}")
    if port is not None and port.startswith("usb:") and not 3 <= len(port.split(":")) <= 4:
        table.problem("port", f"a USB adapter is named usb:VID:PID or usb:VID:PID:SERIAL, not {port!r}")
    if port is None and needs_port:
        table.problem(
            "port", "is missing: say where the device is, for example /dev/serial/by-id/... (`scanner devices`)"
        )
    baud_rate = table.integer("baud_rate", lowest=1)
    options: dict[str, Option] = {}
    for name, value in table.table("options").rest().items():
        if isinstance(value, str | int | float | bool):
            options[name] = value
        else:
            table.problem(f"options.{name}", "must be a text, a number, true or false")
    return DeviceChoice(kind, port, baud_rate, MappingProxyType(options))


def _stage(
    table: RigTable, geometry: SensorGeometry | None, view_mm: Interval, rate_hz: Interval
) -> tuple[DeviceChoice, RigLimits | None]:
    kind = table.text("kind")
    choice = _device(table, needs_port=bool(kind) and kind not in _NO_PORT)
    axis = AxisKind(table.choice("axis", AxisKind, AxisKind.LINEAR))
    radius_mm, reach = math.nan, None
    if axis is AxisKind.TURNTABLE:
        radius_mm = table.number("radius_mm", math.nan, needed=True, above=0.0)
        travel_mm = _arc(table.interval("turn_deg", ENDLESS), radius_mm)
        speed_mm_per_s = _arc(table.interval("speed_deg_per_s", (0.0, math.inf), lowest=0.0), radius_mm)
    else:
        travel_mm = table.interval("travel_mm", ENDLESS, needed=axis is AxisKind.LINEAR and kind not in _NO_PORT)
        speed_mm_per_s = table.interval("speed_mm_per_s", (0.0, math.inf), lowest=0.0)
    if axis is AxisKind.FREE_POSE and table.has("reach_mm"):
        reach = table.box("reach_mm")
    is_driven = kind not in _NOT_DRIVEN and axis is not AxisKind.FREE_POSE
    stops = table.flag("stops_for_lines", is_driven)
    if kind == "constant_speed" and speed_mm_per_s[0] != speed_mm_per_s[1]:
        table.problem("speed_mm_per_s", "a stage of constant speed needs [v, v], lowest and highest alike")
    table.finish()
    if table.failed:
        return choice, None
    return choice, RigLimits(
        axis, travel_mm, speed_mm_per_s, rate_hz, geometry, view_mm, radius_mm, reach, is_driven, stops and is_driven
    )


def _arc(degrees: Interval, radius_mm: float) -> Interval:
    low, high = (math.radians(value) * radius_mm if value else 0.0 for value in degrees)
    return (low, high)


def _pairing(table: RigTable, stage: DeviceChoice) -> Pairing:
    usual = PairBy.DEVICE if stage.kind == "encoder" else PairBy.TIME
    by = PairBy(table.choice("by", PairBy, usual))
    if stage.kind == "encoder" and by is not PairBy.DEVICE:
        table.problem("by", 'an encoder is latched by the scanner: its positions pair by "device"')
    latency_s = table.number("latency_ms", 0.0, lowest=0.0) / 1000.0
    uncertainty_s = table.number("latency_uncertainty_ms", 2.0, lowest=0.0) / 1000.0
    table.finish()
    return Pairing(by, latency_s, uncertainty_s)


def _mounting(table: RigTable, limits: RigLimits | None) -> tuple[Float64Array, Pose, Pose]:
    is_turntable = limits is not None and limits.axis is AxisKind.TURNTABLE
    usual = np.array([0.0, 0.0, 1.0]) if is_turntable else np.array([0.0, 1.0, 0.0])
    direction = table.vector("turn_axis" if is_turntable else "travel", usual)
    length = float(np.linalg.norm(direction))
    if not length > 1e-9:
        table.problem("turn_axis" if is_turntable else "travel", "must be a direction, not three zeros")
        direction, length = usual, 1.0
    part_from_stage = _pose(table.table("part_from_stage"))
    stage_from_sensor = _pose(table.table("stage_from_sensor"))
    table.finish()
    return direction / length, part_from_stage, stage_from_sensor


def _pose(table: RigTable) -> Pose:
    """A pose: translation_mm, and a rotation as degrees about x, y, z in turn, or as a matrix."""
    translation_mm = table.vector("translation_mm", np.zeros(3))
    rotation = np.eye(3)
    if table.has("rotation_deg") and table.has("rotation"):
        table.problem("rotation", "a pose has rotation_deg or rotation, not both")
    if table.has("rotation_deg"):
        rotation = rotation_about_axes(table.vector("rotation_deg"))
    elif table.has("rotation"):
        rotation = table.matrix("rotation")
    table.finish()
    try:
        return Pose(rotation, translation_mm)
    except ValueError as error:
        table.problem("rotation", str(error))
        return Pose.identity()


def rotation_about_axes(degrees: Float64Array) -> Float64Array:
    """Return the rotation (3, 3) by three angles about the fixed axes x, then y, then z of the target frame."""
    x, y, z = (math.radians(float(value)) for value in degrees)
    cx, sx, cy, sy, cz, sz = math.cos(x), math.sin(x), math.cos(y), math.sin(y), math.cos(z), math.sin(z)
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cx, -sx], [0.0, sx, cx]])
    about_y = np.array([[cy, 0.0, sy], [0.0, 1.0, 0.0], [-sy, 0.0, cy]])
    about_z = np.array([[cz, -sz, 0.0], [sz, cz, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(about_z @ about_y @ about_x)
