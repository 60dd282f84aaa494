"""What to ask a SCIP 2.0 lidar for: the request that its parameters, the options and the line allow; no port."""

import math
from dataclasses import dataclass

import numpy as np

from drivers.errors import ScannerRefused
from drivers.protocols.scip import BLOCK_CHARS, STREAMS, n_steps
from drivers.protocols.scip_echoes import ECHO_STREAMS
from drivers.scanline import Float64Array

RATES = (115_200, 19_200, 38_400, 57_600, 250_000, 500_000, 750_000)
_BITS_PER_BYTE = 10
_MAX_INTERVAL = 9
_WIDTHS = STREAMS | ECHO_STREAMS
_LINE_SHARE = 0.95  # of the line's time that scans may fill: replies and a slow motor need the rest


@dataclass(frozen=True, slots=True)
class ScipOptions:
    """What to ask a lidar for.

    Parameters
    ----------
    field_of_view_rad : (lowest, highest) angle, 0 ahead, counter-clockwise; None is all the sensor has.
    command : `MD` distances of three characters, `MS` of two (up to 4,095 mm), `ME` with intensities; of newer models
        `ND` with several echoes a step, `NE` the same with intensities.
    echo : which of several echoes counts: `first`, `last`, or the `strongest`, which needs `NE`.
    cluster : neighbouring steps merged into one value, the smallest distance of them.
    interval : scans left out between two, 0 to 9; None is as few as the line has time for, and says so.
    work_rate : baud rate to switch to where the sensor answers at a lower one; None stays.
    """

    field_of_view_rad: tuple[float, float] | None = None
    command: str = "MD"
    cluster: int = 1
    interval: int | None = None
    work_rate: int | None = 115_200
    echo: str = "first"

    def __post_init__(self) -> None:
        if self.command not in _WIDTHS:
            raise ValueError(f"a lidar is asked with one of {', '.join(_WIDTHS)}, not {self.command!r}")
        needed = {"first": tuple(_WIDTHS), "last": ("ND", "NE"), "strongest": ("NE",)}.get(self.echo)
        if needed is None:
            raise ValueError(f"echo must be first, last or strongest, not {self.echo!r}")
        if self.command not in needed:
            raise ValueError(f"the {self.echo} echo is told with command {' or '.join(needed)}, not {self.command}")
        if not 1 <= self.cluster <= 99:
            raise ValueError(f"cluster must be 1 to 99, not {self.cluster}")
        if self.interval is not None and not 0 <= self.interval <= _MAX_INTERVAL:
            raise ValueError(f"interval must be 0 to {_MAX_INTERVAL}, not {self.interval}")
        if self.field_of_view_rad is not None and not self.field_of_view_rad[0] < self.field_of_view_rad[1]:
            raise ValueError("the field of view must be (lowest, highest) angle")
        if self.work_rate is not None and self.work_rate not in RATES:
            raise ValueError(f"SCIP has the rates {', '.join(map(str, sorted(RATES)))}, not {self.work_rate}")


@dataclass(frozen=True, slots=True)
class Parameters:
    """What PP says: distances in mm, steps of a turn, and the motor's turns a minute."""

    model: str
    min_mm: int
    max_mm: int
    steps_per_turn: int
    first_step: int
    last_step: int
    front_step: int
    rpm: int

    @property
    def period_s(self) -> float:
        """Seconds of one turn."""
        return 60.0 / self.rpm

    def step_at(self, angle_rad: float) -> int:
        """The step nearest to an angle, kept within those there are."""
        step = self.front_step + round(angle_rad * self.steps_per_turn / math.tau)
        return min(max(step, self.first_step), self.last_step)


@dataclass(frozen=True, slots=True)
class Request:
    """A measurement: steps `start` to `end`, `cluster` of them a value, `interval` scans left out between two."""

    command: str
    start: int
    end: int
    cluster: int
    interval: int

    @property
    def text(self) -> str:
        """As it goes on the wire."""
        return f"{self.command}{self.start:04d}{self.end:04d}{self.cluster:02d}{self.interval}00"

    @property
    def n_values(self) -> int:
        """Values of a scan."""
        return n_steps(self.start, self.end, self.cluster)

    def wire_s(self, baud_rate: int) -> float:
        """Seconds that a scan takes on the line."""
        return scan_bytes(self.command, self.n_values) * _BITS_PER_BYTE / baud_rate

    def period_s(self, parameters: Parameters) -> float:
        """Seconds from one scan to the next."""
        return parameters.period_s * (self.interval + 1)

    def angles_rad(self, parameters: Parameters) -> Float64Array:
        """Angles (n,) of the values, 0 ahead, counter-clockwise."""
        first = self.start + (self.cluster - 1) / 2
        steps = first + self.cluster * np.arange(self.n_values)
        return np.asarray((steps - parameters.front_step) * math.tau / parameters.steps_per_turn)


def scan_bytes(command: str, n_values: int) -> int:
    """Return the bytes of one scan on the wire: echo, status, time, blocks of 64 with sum and end, empty line.

    Of ND and NE with one echo a step; each further one is a character more than the first.
    """
    n_chars = n_values * _WIDTHS[command]
    return 16 + 4 + 6 + n_chars + 2 * -(-n_chars // BLOCK_CHARS) + 1


def request_for(options: ScipOptions, parameters: Parameters, baud_rate: int) -> Request:
    """Return the measurement to ask for; where the interval is free, the smallest that the line has time for."""
    start, end = parameters.first_step, parameters.last_step
    if options.field_of_view_rad is not None:
        start, end = (parameters.step_at(angle) for angle in options.field_of_view_rad)
    request = Request(options.command, start, end, options.cluster, options.interval or 0)
    if options.interval is not None:
        return request
    for interval in range(_MAX_INTERVAL + 1):
        request = Request(options.command, start, end, options.cluster, interval)
        if request.wire_s(baud_rate) <= request.period_s(parameters) * _LINE_SHARE:
            break
    return request


def parameters_of(fields: dict[str, str]) -> Parameters:
    """The parameters in an answer to PP; raises ScannerRefused when they cannot be a lidar's."""
    try:
        numbers = [int(fields[key]) for key in ("DMIN", "DMAX", "ARES", "AMIN", "AMAX", "AFRT", "SCAN")]
    except (KeyError, ValueError) as error:
        raise ScannerRefused(f"the lidar's parameters (PP) cannot be read: {error}") from error
    low, high, turn, first, last, front, rpm = numbers
    if not (
        0 < low < high < 1 << 18 and 0 <= first <= front <= last <= 9999 and last - first < turn and 0 < rpm < 60_000
    ):
        raise ScannerRefused(f"the lidar's parameters (PP) contradict each other: {fields}")
    return Parameters(fields.get("MODL", "Hokuyo lidar"), low, high, turn, first, last, front, rpm)
