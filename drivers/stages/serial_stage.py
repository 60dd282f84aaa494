"""A stage on a serial port, whatever its protocol: soft limits, refusals, and waiting; knows no protocol.

The conversation is a `StageHost`, port and thread are `stage_link.py`, positions `whereabouts.py`; here are the soft
limits, and the refusals that need no controller.
"""

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from types import TracebackType
from typing import Self, TypeAlias

from drivers.errors import (
    DriverError,
    StageLimit,
    StageNotConnected,
    StagePositionUnknown,
    StageRefused,
    StageSilent,
    StageTimeout,
)
from drivers.patience import wait_patiently
from drivers.port import ModemLines
from drivers.protocols.stage_events import Reading, StageDisconnected, StageEvent, StageReconnected
from drivers.protocols.stage_host import Errand, Phase, StageHost
from drivers.rig_limits import Interval
from drivers.stages.face import StageInfo, StageReading
from drivers.stages.stage_link import StageLink
from drivers.stages.whereabouts import Whereabouts

HostMaker: TypeAlias = Callable[[Callable[[Reading], None], Callable[[StageEvent], None]], StageHost]

_AS_IT_IS = ModemLines()
_EXIT_S = 3.0
_READING_S = 5.0
_MAX_EVENTS = 1_000
_SLACK_MM = 1e-6


class SerialStage:
    """One axis on one port; a thread of its own reads and writes, and reopens a lost port about every 0.1 s.

    Parameters
    ----------
    makes_host : makes the conversation, given whom to tell of readings and events.
    port_name : a path, or `usb:VID:PID[:SERIAL]`; looked up anew at each opening, since names change at a replug.
    travel_mm, speed_mm_per_s : the soft limits.
    mm_per_unit : millimetres of travel in one unit of the controller.
    lines : how DTR and RTS are to stand; boards exist that start anew when they move.
    patience_s : how long `enter` waits for an answer; a board that starts anew when it is opened needs some seconds.
    """

    def __init__(
        self,
        makes_host: HostMaker,
        port_name: str,
        baud_rate: int,
        *,
        travel_mm: Interval,
        speed_mm_per_s: Interval = (0.0, math.inf),
        mm_per_unit: float = 1.0,
        lines: ModemLines = _AS_IT_IS,
        clock: Callable[[], float] = time.monotonic,
        patience_s: float = 12.0,
    ) -> None:
        self._makes_host = makes_host
        self._port_name = port_name
        self._baud_rate = baud_rate
        self._travel_mm = travel_mm
        self._speed_mm_per_s = speed_mm_per_s
        self._mm_per_unit = mm_per_unit
        self._lines = lines
        self._clock = clock
        self._patience_s = patience_s
        self._changed = threading.Condition()  # guards everything below
        self._host = makes_host(self._take_reading, self._take_event)
        self._where = Whereabouts(mm_per_unit)
        self._events: deque[StageEvent] = deque(maxlen=_MAX_EVENTS)
        self._identity = ""
        self._link: StageLink | None = None

    def __enter__(self) -> Self:
        self.enter()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.exit()

    # ---- connecting -------------------------------------------------------------------------------------------------

    def enter(self) -> StageInfo:
        """Open the port, end what an earlier program left running, and ask who is there.

        Raises
        ------
        PortError : when the port cannot be opened, or is lost meanwhile.
        StageSilent : when nothing intelligible answers.
        StageRefused : when the controller cannot be driven; the message says what to set.
        """
        if self._link is not None:
            raise DriverError(f"{self._port_name} has been entered already; exit first")
        self._host = self._makes_host(self._take_reading, self._take_event)
        self._link = StageLink(
            self._port_name, self._baud_rate, self._lines, self._host, self._changed, self._clock, self._lost
        )
        with self._changed:
            wait_patiently(
                self._changed,
                lambda: (
                    (self._host.phase is Phase.UP and self._where.latest is not None)
                    or self._host.refusal is not None
                    or self._failure is not None
                ),
                self._patience_s,
            )
            host, failure, is_up = self._host, self._failure, self._host.phase is Phase.UP
            self._identity = host.identity
        if failure is None and host.refusal is None and is_up:
            return StageInfo(host.identity)
        self.exit()
        raise failure or host.refusal or StageSilent(self._describe_silence(host.heard_bytes))

    def exit(self) -> None:
        """Stop a motion under way, close the port; never raises, and returns within about 4 s."""
        link = self._link
        if link is None:
            return
        with self._changed:
            if self._host.phase is Phase.UP and self._host.is_busy and self._failure is None:
                errand = self._host.stop(self._clock())
                wait_patiently(self._changed, lambda: errand.is_over or self._failure is not None, _EXIT_S)
        link.close()
        with self._changed:  # whoever still waits, in another thread, waits for nobody
            self._link = None
            self._where.latest = None
            self._host.link_lost("the port was closed", self._clock())
            self._changed.notify_all()

    @property
    def is_connected(self) -> bool:
        """True while the controller answers."""
        with self._changed:
            return self._host.phase is Phase.UP

    # ---- what is known ----------------------------------------------------------------------------------------------

    @property
    def position_known(self) -> bool:
        """True after homing or the user's word, until something may have moved the stage unseen."""
        with self._changed:
            return self._host.position_known

    @property
    def position_mm(self) -> float:
        """The latest reading; NaN while the position is unknown."""
        with self._changed:
            latest = self._where.latest
            return latest.position_mm if latest is not None and self._host.position_known else math.nan

    def readings(self) -> list[StageReading]:
        """Return the readings since the last call, in order; the latest 10,000 are kept."""
        with self._changed:
            return self._where.take()

    def stage_events(self) -> list[StageEvent]:
        """Return what happened since the last call, in order; the latest 1,000 are kept."""
        with self._changed:
            taken = list(self._events)
            self._events.clear()
        return taken

    # ---- moving -----------------------------------------------------------------------------------------------------

    def home(self) -> StageReading:
        """Find the controller's reference and return where the stage is then.

        Raises
        ------
        StageRefused, StageAlarm, StageTimeout, StageStopped, StageNotConnected : when it does not come about.
        """
        with self._changed:
            self._refuse_while_busy()
            self._where.found_reference()
            errand = self._host.home(self._clock())
        self._wait_for(errand)
        return self._fresh_reading()

    def set_position(self, position_mm: float) -> None:
        """State where the stage is; a controller that locked itself is freed.

        Raises
        ------
        StageLimit : the position is outside the soft limits.
        StageRefused, StageTimeout, StageNotConnected : when the controller does not free itself.
        """
        with self._changed:
            self._refuse_while_busy()
            self._check_target(position_mm)
            errand = self._host.unlock(self._clock())
        self._wait_for(errand)
        with self._changed:
            if not self._where.state(position_mm):
                raise StageNotConnected(f"the stage on {self._port_name} has not said where it is; try again")
            self._host.trust()

    def start_move(self, position_mm: float, speed_mm_per_s: float) -> None:
        """Set off and return at once; see `DrivenStage.start_move`."""
        with self._changed:
            self._refuse_while_busy()
            self._check_target(position_mm)
            self._check_speed(speed_mm_per_s)
            if self._host.phase is not Phase.UP:
                raise StageNotConnected(f"the stage on {self._port_name} is not connected; wait until it is back")
            if not self._host.position_known:
                raise StagePositionUnknown(
                    f"the stage does not move while its position is unknown ({self._host.why_unknown}); home it, or "
                    "state where it is"
                )
            self._host.move(self._where.units(position_mm), speed_mm_per_s / self._mm_per_unit, self._clock())

    def finish_move(self, timeout_s: float) -> StageReading | None:
        """Wait for the motion under way; see `DrivenStage.finish_move`."""
        with self._changed:
            errand = self._host.errand
            if errand is None:
                return self._where.latest
            self._changed.wait_for(lambda: errand.is_over or self._failure is not None, timeout_s)
            if not errand.is_over and self._failure is None:
                return None
        self._raise_failure(errand)
        with self._changed:
            return self._where.latest

    def move_to(self, position_mm: float, speed_mm_per_s: float) -> StageReading:
        """Move, wait, and return where the stage came to rest; see `DrivenStage.move_to`."""
        self.start_move(position_mm, speed_mm_per_s)
        while (reading := self.finish_move(1.0)) is None:
            pass
        return reading

    def stop(self) -> None:
        """Stop before anything that waits to be sent; returns when the stage rests.

        Raises
        ------
        StageTimeout, StageNotConnected : when the controller does not confirm; treat the stage as moving.
        """
        with self._changed:
            if self._link is None:
                return  # left, and stopped then
            errand = self._host.stop(self._clock())
        self._wait_for(errand)

    # ---- inside -----------------------------------------------------------------------------------------------------

    def _refuse_while_busy(self) -> None:
        if self._link is None:
            raise StageNotConnected(f"the stage on {self._port_name} has not been entered")
        if self._host.is_busy:
            raise StageRefused("a motion is under way; wait for it or stop it first")

    def _check_target(self, position_mm: float) -> None:
        low, high = self._travel_mm
        if not low - _SLACK_MM <= position_mm <= high + _SLACK_MM:
            raise StageLimit(f"{position_mm:g} mm is outside the soft limits of the stage, {low:g} to {high:g} mm")

    def _check_speed(self, speed_mm_per_s: float) -> None:
        highest = self._speed_mm_per_s[1]
        if not (0.0 < speed_mm_per_s <= highest * (1 + 1e-9)) or math.isinf(speed_mm_per_s):
            raise StageLimit(
                f"a speed of {speed_mm_per_s:g} mm/s is outside what the stage does, more than 0 to {highest:g} mm/s"
            )

    def _wait_for(self, errand: Errand) -> None:
        with self._changed:
            self._changed.wait_for(lambda: errand.is_over or self._failure is not None)
        self._raise_failure(errand)

    def _raise_failure(self, errand: Errand) -> None:
        if errand.failure is not None:
            raise errand.failure
        if not errand.is_over and self._failure is not None:
            raise self._failure

    def _fresh_reading(self) -> StageReading:
        """Wait for a reading that was asked for from now on."""
        now_s = self._clock()
        with self._changed:
            wait_patiently(
                self._changed,
                lambda: (
                    (self._where.latest is not None and self._where.latest.asked_s >= now_s)
                    or self._failure is not None
                ),
                _READING_S,
            )
            latest = self._where.latest
            if latest is None or latest.asked_s < now_s:
                raise StageTimeout(f"the stage on {self._port_name} does not say where it is; check cable and power")
            return latest

    @property
    def _failure(self) -> Exception | None:
        """What ended the link's thread."""
        return None if self._link is None else self._link.failure

    def _describe_silence(self, heard_bytes: int) -> str:
        where = f"{self._port_name} at {self._baud_rate} baud"
        if heard_bytes:
            return (
                f"what comes from {where} is not this controller's language ({heard_bytes} bytes); try its other "
                "rates, or another kind"
            )
        return f"no stage answers on {where}; check its power, the cable, the path and the rate"

    # ---- in the thread of the link; these are called with the lock held ---------------------------------------------

    def _take_reading(self, reading: Reading) -> None:
        astray = self._where.read(reading)
        if astray is not None:
            self._host.distrust(astray, self._clock())

    def _take_event(self, event: StageEvent) -> None:
        if isinstance(event, StageReconnected) and self._identity not in ("", self._host.identity):
            self._host.distrust(f"another controller answers ({self._host.identity})", self._clock())
            event = StageReconnected(event.gap_s, False)
        self._events.append(event)

    def _lost(self, reason: str, now_s: float) -> bool:
        """The link is gone; True when it is worth waiting for, False when the controller was never met."""
        met = bool(self._identity) or self._host.phase is Phase.UP
        if self._host.phase is Phase.UP:
            self._events.append(StageDisconnected(reason, now_s))
            errand = self._host.errand
            self._where.lost_sight(None if errand is None or errand.is_over else errand.target)
        self._host.link_lost(reason, now_s)
        return met
