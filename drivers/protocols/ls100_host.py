"""The host's half of a conversation with a Profiler 2 or LS-100: ask for one profile after the other; no port.

RS-485 has one pair of wires: never is more than one request under way, and an adapter that hears itself is noticed.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from drivers.errors import ScannerRefused, ScannerTimeout
from drivers.protocols.conversation import Conversation, Listener
from drivers.protocols.device_clock import DeviceClock
from drivers.protocols.dialogue import Answer, Quiet, Script
from drivers.protocols.framing import Damage, DamageReason
from drivers.protocols.ls100 import (
    ERRORS,
    POINT_WORDS,
    PROFILE_ADDRESS,
    READ,
    TIME_SPAN,
    TIME_TICK_S,
    TRANSIENT_ERRORS,
    Frame,
    FrameDecoder,
    frame,
    read_header,
    read_points,
    read_request,
    reads_of_profile,
)
from drivers.scanline import DeviceInfo, Float64Array, SensorGeometry

RATES = (115_200, 921_600, 9_600, 19_200, 38_400, 57_600, 230_400, 460_800, 2_000_000, 4_000_000)
_REPLY_S = 0.1
_TRIES = 4
_REACH_MM = 32.766  # what sixteen bits of micrometres hold
_BITS_PER_BYTE = 10
_MAX_POINTS = 2_048


@dataclass(frozen=True, slots=True)
class Ls100Options:
    """How to read a sensor.

    Parameters
    ----------
    step : every how manieth point is read, 1 to 15.
    has_time : whether the reply to the size carries a time, which is then the profile's; None takes either form and
        goes by the arrival of that reply. No device has settled yet which form is right.
    laser_mm : origin of the laser fan in the sensor frame, from the data sheet; 100 mm above the points is a guess.
    name : what to call this sensor: the protocol tells no serial number.
    """

    step: int = 1
    has_time: bool | None = None
    laser_mm: tuple[float, float, float] = (0.0, 0.0, 100.0)
    name: str = "ls100"

    def __post_init__(self) -> None:
        if not 1 <= self.step <= 15:
            raise ValueError(f"step must be 1 to 15, not {self.step}")


_Result: TypeAlias = tuple[float, int | None, Float64Array, Float64Array, Float64Array]
"""When the size came, the sensor's own time, x, z, and of each point 0 measured, 1 not measured, 2 missing."""


class Ls100Host(Conversation):
    """One conversation with one sensor. Its laser shines for as long as it has power: there is no command for it."""

    break_after_s = 0.09

    def __init__(self, listener: Listener, rates: tuple[int, ...] = RATES, options: Ls100Options | None = None) -> None:
        self._frames = FrameDecoder()
        super().__init__(listener, self._frames, rates)
        self._options = options or Ls100Options()
        self._address = 0
        self._n_points = 0
        self._clock = DeviceClock(TIME_SPAN, TIME_TICK_S)
        self._has_echo = False

    def _break_off(self) -> Sequence[Any]:
        return self._frames.break_off()

    # ---- scripts --------------------------------------------------------------------------------------------------

    def _greet(self) -> Script[DeviceInfo]:
        reply = yield from self._find_rate(self._ask_address)
        if len(reply.data) != 4:
            raise ScannerRefused(f"the sensor told its profile's address in {len(reply.data)} bytes instead of 4")
        self._address = int.from_bytes(reply.data, "big")
        n_points, _ = yield from self._header()
        self._n_points = n_points
        self.laser_on = True
        n = -(-n_points // self._options.step)
        return DeviceInfo(
            device_id=self._options.name,
            model="SICK Profiler 2 / FASTUS LS-100",
            firmware="",
            calibration_id="factory",
            boot_id=self.boot_id,
            points_per_line=n,
            geometry=SensorGeometry(
                np.array(self._options.laser_mm), np.array(self._options.laser_mm), (-_REACH_MM, _REACH_MM), 0.0
            ),
        )

    def _nobody(self, tried: str, *, heard: bool) -> str:
        if not heard:
            return f"no Profiler 2 or LS-100 answers at {tried} baud; check its power and swap A with B"
        echo = "; the adapter repeats what is sent, but nobody answers" if self._has_echo else ""
        return f"what comes at {tried} baud is no reply of a Profiler 2 or LS-100{echo}"

    def _ask_address(self) -> Script[Frame | None]:
        yield Quiet(0.02, 0.5)  # the rest of a reply that an earlier program asked for
        self._decoder.reset()
        return (yield from self._ask(frame(PROFILE_ADDRESS), tries=2))

    def _ask(self, request: bytes, tries: int = _TRIES) -> Script[Frame | None]:
        """Ask, and again after damage or silence; None when no reply comes.

        Raises
        ------
        ScannerRefused : when the sensor answers with an error that asking again does not mend.
        """
        command = int.from_bytes(request[2:4], "big")
        within_s = _REPLY_S + 2 * (len(request) + 516) * _BITS_PER_BYTE / self.baud_rate
        for _ in range(tries):
            self._say(request)
            reply: Frame | None = yield Answer(lambda item: _may_answer(item, request), within_s)
            if reply is not None and reply.whole == request:
                if not self._has_echo:
                    self._has_echo = True
                    self._advise("the adapter repeats what is sent to the sensor; its echo is passed over")
                reply = yield Answer(lambda item: _may_answer(item, request) and item.whole != request, within_s)
            if reply is None:
                continue
            if reply.command == command:
                return reply
            if reply.command in ERRORS and reply.command not in TRANSIENT_ERRORS:
                raise ScannerRefused(f"the sensor refused: {ERRORS[reply.command]} ({reply.command:04X}h)")
        return None

    def _header(self) -> Script[tuple[int, int | None]]:
        """Return points and time of the present profile."""
        reply = yield from self._ask(read_request(self._address, 1, 1))
        if reply is None:
            raise ScannerTimeout("the sensor does not tell the size of its profile")
        try:
            n_points, time = read_header(reply.data, has_time=self._options.has_time)
        except ValueError as error:
            raise ScannerRefused(f"the size of the profile cannot be read: {error}; try the other has_time") from error
        if not 1 <= n_points <= _MAX_POINTS:
            raise ScannerRefused(f"the sensor says its profile has {n_points} points")
        return n_points, time

    def _begin(self) -> Script[None]:
        n_reads = len(reads_of_profile(self._address, self._n_points, self._options.step))
        n_bytes = 26 + n_reads * 22 + 4 * -(-self._n_points // self._options.step)
        profile_s = n_bytes * _BITS_PER_BYTE / self.baud_rate
        self._advise(
            f"one profile takes {profile_s:.2g} s at {self.baud_rate} baud: move the stage no faster than that"
        )
        self.silent_after_s = max(2.0, 5 * profile_s)
        yield from self._header()

    def _end(self) -> Script[None]:
        """The reply under way is let pass; nothing has to be switched off."""
        yield Quiet(0.02, 0.5)
        self._decoder.reset()

    # ---- the stream -----------------------------------------------------------------------------------------------

    def _poll(self, now_s: float) -> None:
        """Ask for the next profile as soon as the one before is read."""
        if self._streaming and self._dialogue is None:
            self._run(self._profile_script(), now_s, self._read, self._not_read)

    def _take(self, item: Any, now_s: float) -> None:
        """Late replies: whoever asked has given up."""

    def _profile_script(self) -> Script[_Result]:
        """Read one profile, a hundred points and more at a time; what cannot be read is missing."""
        n_points, time = yield from self._header()
        measured_s = self._heard_s
        step = self._options.step
        pieces = []
        for address, n in reads_of_profile(self._address, n_points, step):
            reply = yield from self._ask(read_request(address, n, POINT_WORDS, step))
            gone = np.full(n, np.nan)
            x_mm, z_mm, state = gone, gone, np.full(n, 2.0)
            if reply is not None and int.from_bytes(reply.data[:4], "big") == address:
                try:
                    x_mm, z_mm, nothing = read_points(reply.data, n)
                    state = nothing.astype(np.float64)
                except ValueError:
                    self._damage(Damage(DamageReason.BAD_LAYOUT, len(reply.whole)))
            pieces.append((x_mm, z_mm, state))
        x, z, states = (np.concatenate(parts) for parts in zip(*pieces, strict=True))
        return measured_s, time, x, z, states

    def _read(self, result: _Result, now_s: float) -> None:
        device_time_s, time, x_mm, z_mm, state = result
        if self._options.has_time and time is not None:
            device_time_s = self._clock.read(time, device_time_s)
            self._jumped(self._clock.jumps)
        missing = state == 2.0
        if missing.all():
            self._not_read(ScannerTimeout("no part of the profile could be read"), now_s)
        elif self._account.enter():
            self._profile(x_mm, z_mm, missing, device_time_s, now_s, {"no_measurement": int((state == 1.0).sum())})

    def _not_read(self, _error: Any, now_s: float) -> None:
        """A profile that was asked for and did not come; when none comes for long the link is opened anew."""
        self._account.lost(1)
        if now_s - self._profile_s > self.silent_after_s:
            self._in_trouble = (
                f"no profile has come for {self.silent_after_s:.2g} s; check the sensor's power and its cable"
            )


def _may_answer(item: Any, request: bytes) -> bool:
    """False for a reply that came too late: one to a read of another address, which was asked for and given up."""
    if not isinstance(item, Frame):
        return False
    return item.command != READ or request[2:4] != READ.to_bytes(2, "big") or item.data[:4] == request[4:8]
