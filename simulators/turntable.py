"""A simulated scanner that looks at a simulated turntable: two terminals, one part, and the rig file for both.

The scanner has no stage of its own: it reads the encoder of the table, and measures a line whenever the table has come
to the place of one. So lines lie where the table truly was, however late a busy computer is.
"""

import math
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np

from drivers.scanline import Float64Array, Pose
from simulators.devices.zaber import ZaberDevice
from simulators.optics import LaserLineScanner
from simulators.parts import Part
from simulators.shapes import Cylinder, Difference, Union, box

RADIUS_MM = 12.0
"""Where line spacings are stated: positions are millimetres of arc there."""
MICROSTEP_DEG = 0.001
ENCODER_MM_PER_COUNT = 0.001
STAGE_BAUD_RATE = 115_200
TURN_DEG = (0.0, 360.0)
SPEED_DEG_PER_S = 120.0
LINE_RATE_HZ = 60.0
_HOMING_DEG_PER_S = 360.0
_ELEVATION_RAD = math.radians(45.0)
_LOOKS_AT_MM = (0.0, 0.0, 5.0)
_RIG_FILE = """\
name = "simulated turntable"

[scanner]
kind = "native"
port = "{scanner}"
baud_rate = {baud_rate}
line_rate_hz = [1, {line_rate_hz:g}]

[stage]
kind = "zaber"
port = "{stage}"
baud_rate = {stage_baud_rate}
axis = "turntable"
radius_mm = {radius_mm:g}
turn_deg = [{lowest:g}, {highest:g}]
speed_deg_per_s = [0, {speed:g}]
options = {{ microstep = {microstep} }}

[mounting]
turn_axis = [0, 0, 1]
stage_from_sensor = {{ translation_mm = {translation}, rotation = {rotation} }}

[pairing]
by = "device"   # the scanner reads the table's encoder
"""


def turned_part() -> Part:
    """What stands on the table: a block with a groove across it, a pin and a bore, all within 14 mm of the axis."""
    block = box((-11.0, -8.0, 0.0), (11.0, 8.0, 10.0))
    groove = box((1.0, -9.0, 6.0), (5.0, 9.0, 11.0))
    bore = Cylinder((8.0, 0.0, 4.0), (8.0, 0.0, 11.0), 2.0)
    pin = Cylinder((-6.0, 0.0, 9.0), (-6.0, 0.0, 17.0), 3.0)
    surface = Union(Difference(block, groove, bore), pin)
    return Part(surface, (0.0, 2.0 * math.pi * RADIUS_MM), "a block with a groove, a bore and a pin on a turntable")


def stage_from_sensor() -> Pose:
    """Where the scanner stands: beside the table and above it, its laser plane through the axis."""
    away = np.array([0.0, -math.cos(_ELEVATION_RAD), math.sin(_ELEVATION_RAD)])  # from the part to the scanner
    travel = np.array([1.0, 0.0, 0.0])
    return Pose(np.column_stack([np.cross(travel, away), travel, away]), np.array(_LOOKS_AT_MM))


class Table:
    """A rotary stage behind a Zaber controller, whose encoder another thread may read; `clock` is its terminal's."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._zaber = ZaberDevice(limit_max=round(TURN_DEG[1] / MICROSTEP_DEG))
        self._zaber.settings["maxspeed"] = str(round(_HOMING_DEG_PER_S / MICROSTEP_DEG * 1.6384))

    def receive(self, data: bytes, now_s: float) -> None:
        """Take in what the host sent."""
        with self._lock:
            self._zaber.receive(data, now_s)

    def transmit(self, now_s: float, room_bytes: int) -> bytes:
        """At most `room_bytes` of what the controller has to send by now."""
        with self._lock:
            return self._zaber.transmit(now_s, room_bytes)

    def next_due_s(self, now_s: float) -> float | None:
        """When it has something to say."""
        with self._lock:
            return self._zaber.next_due_s(now_s)

    def stall(self) -> None:
        """Meet an obstacle, or be held by hand: it stands at once, and says so; homing it mends that."""
        with self._lock:
            self._zaber.stall(self._clock())

    def encoder_mm(self, now_s: float) -> float:
        """Where the table stands, in millimetres of arc."""
        with self._lock:
            steps = self._zaber.axes.position(now_s)[0]
        return math.radians(steps * MICROSTEP_DEG) * RADIUS_MM


def turned_scene(
    scanner: LaserLineScanner, part: Part, rng: np.random.Generator
) -> Callable[[float], tuple[Float64Array, Float64Array]]:
    """What the scanner sees of a part with the table at a position (millimetres of arc)."""
    mounted = stage_from_sensor()

    def seen(position_mm: float) -> tuple[Float64Array, Float64Array]:
        angle_rad = position_mm / RADIUS_MM
        cosine, sine = math.cos(angle_rad), math.sin(angle_rad)
        around = Pose(np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3))
        return scanner.expose(part.surface, around @ mounted, rng)

    return seen


def rig_text(scanner: Path, baud_rate: int, stage: Path) -> str:
    """The rig file that puts scanner and table together."""
    mounted = stage_from_sensor()
    return _RIG_FILE.format(
        scanner=scanner,
        baud_rate=baud_rate,
        line_rate_hz=LINE_RATE_HZ,
        stage=stage,
        stage_baud_rate=STAGE_BAUD_RATE,
        radius_mm=RADIUS_MM,
        lowest=TURN_DEG[0],
        highest=TURN_DEG[1],
        speed=SPEED_DEG_PER_S,
        microstep=MICROSTEP_DEG,
        translation=mounted.translation_mm.tolist(),
        rotation=mounted.rotation.tolist(),
    )
