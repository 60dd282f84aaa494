"""The host's half of a conversation with a scanner that runs free, whatever its protocol; no port, no clock, no thread.

What is common to such scanners is here: meeting a device on each new link, starting, stopping, going on after a lost
link. What a protocol has of its own are three scripts (`_greet`, `_begin`, `_end`), a decoder and `_take`, which makes
profiles of what the stream brings. The scripts run in `talk.py`, the account is kept by `profile_account.py`.
"""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np

from drivers.errors import ScannerError, ScannerNotConnected, ScannerRefused
from drivers.protocols.dialogue import Script
from drivers.protocols.framing import Damage
from drivers.protocols.listening import listened_s
from drivers.protocols.profile_account import ProfileAccount
from drivers.protocols.scanner_events import (
    Advice,
    ClockJumped,
    Disconnected,
    OtherDevice,
    PassEnded,
    PassNotResumed,
    Reconnected,
    ScannerEvent,
)
from drivers.protocols.talk import Decoder, Talk
from drivers.scanline import BoolArray, DeviceInfo, Float64Array, Profile
from drivers.tally import Tally


class Phase(Enum):
    """Where the conversation stands."""

    CLOSED = "closed"
    MEETING = "meeting"
    UP = "up"
    UNMET = "unmet"  # nobody, or nobody intelligible, answered on this link
    OTHER_DEVICE = "other_device"


@dataclass(slots=True)
class Task:
    """Something asked of the device: done, or done with in vain."""

    done: bool = False
    failure: ScannerError | None = None


@dataclass(frozen=True, slots=True)
class Listener:
    """Who is told of a conversation, and its number in the record: the devices of these protocols number no boots.

    `deliver` takes a profile, False when it could not, which is counted as `host_overflow`; `emit` takes an event.
    """

    deliver: Callable[[Profile], bool]
    emit: Callable[[ScannerEvent], None]
    boot_id: int


class Conversation(Talk):
    """One conversation with one device, over as many links as it takes.

    Parameters
    ----------
    listener : who is told of it.
    decoder : understands the device's bytes.
    rates : baud rates to try, the likeliest first.
    """

    silent_after_s = 2.0
    """A stream without a profile for so long has stopped: the link is then opened anew."""

    def __init__(self, listener: Listener, decoder: Decoder, rates: tuple[int, ...]) -> None:
        super().__init__(decoder, lambda text: listener.emit(Advice(text)), rates)
        self.info: DeviceInfo | None = None
        self.phase = Phase.CLOSED
        self.failure: ScannerError | None = None
        """Why nobody was met on this link."""
        self.laser_on: bool | None = None
        self.boot_id = listener.boot_id
        self._deliver = listener.deliver
        self._emit = listener.emit
        self._task: Task | None = None
        self._account = ProfileAccount(listener.boot_id)
        self._told_jumps = 0
        self._streaming = False
        self._wanted = False
        self._resume = False
        self._other_id = ""
        self._lost_s: float | None = None
        self._profile_s = self._looked_s = 0.0
        self._in_trouble: str | None = None

    # ---- what a protocol brings -----------------------------------------------------------------------------------

    @abstractmethod
    def _greet(self) -> Script[DeviceInfo]:
        """End what an earlier program left running, find the rate, ask who is there."""

    @abstractmethod
    def _begin(self) -> Script[None]:
        """Start the stream."""

    @abstractmethod
    def _end(self) -> Script[None]:
        """Stop the stream; raises ScannerTimeout when the device does not."""

    @abstractmethod
    def _take(self, item: Any, now_s: float) -> None:
        """Take an item of the stream that no script waited for."""

    def _close_line(self, now_s: float) -> None:
        """Hand on the profile that is being collected, if there is one."""

    # ---- the link -------------------------------------------------------------------------------------------------

    def link_opened(self, now_s: float) -> None:
        """Begin to talk on a new link."""
        self.outgoing.clear()
        self.failure = self._in_trouble = None
        self.phase = Phase.MEETING
        self._run(self._greet(), now_s, self._met, self._unmet)

    def link_lost(self, reason: str, now_s: float) -> None:
        """The port is gone, or given up; `reason` is one sentence."""
        was_up = self.phase is Phase.UP
        self._abandon_dialogue()
        for damage in self._reset_decoder():
            self._damage(damage)
        self._close_line(now_s)
        self._account.link_lost()
        self._fail_task(ScannerNotConnected(reason))
        self._streaming = False
        self.laser_on = None
        self.outgoing.clear()
        self.phase = Phase.CLOSED
        if not was_up:
            return
        self._lost_s = now_s
        self._emit(Disconnected(reason, now_s))
        if self._wanted and not self._resume:
            self._wanted = False
            self._pass_ended("disconnected")
            self._emit(PassNotResumed("the link was lost, and this pass was not to go on by itself"))

    def tick(self, now_s: float) -> None:
        """Do what is due by now; while this program was not let run, no profile can have been missed."""
        not_listened_s = now_s - self._looked_s - listened_s(self._looked_s, now_s)
        self._profile_s = min(now_s, self._profile_s + max(0.0, not_listened_s))
        self._looked_s = now_s
        super().tick(now_s)

    def end(self) -> None:
        """The port will be closed in good order; nobody is told."""
        self._abandon_dialogue()
        self._fail_task(ScannerNotConnected("the port was closed"))
        self._wanted = self._streaming = False
        self.laser_on = None
        self.phase = Phase.CLOSED

    @property
    def pass_index(self) -> int:
        """The pass that runs, or ran last; 0 before the first."""
        return self._account.pass_index

    @property
    def is_met(self) -> bool:
        """True once a device has said who it is, on this link or an earlier one."""
        return self.info is not None

    def trouble(self, now_s: float) -> str | None:
        """One sentence when the link is best opened anew, or given up; None while all is well."""
        if self.phase is Phase.OTHER_DEVICE:
            return f"another scanner answers, {self._other_id}"
        if self.phase is Phase.UNMET:
            return str(self.failure)
        if self._in_trouble is not None:
            return self._in_trouble
        if self._streaming and self._dialogue is None and now_s - self._profile_s > self.silent_after_s:
            return f"no profile has come for {self.silent_after_s:g} s; check the scanner's power and its cable"
        return None

    # ---- commands -------------------------------------------------------------------------------------------------

    def start(self, now_s: float, *, resume: bool) -> Task:
        """Start a stream of profiles, as a new pass."""
        task = self._new_task()
        if task.done:
            return task
        if self._wanted:
            task.done, task.failure = True, ScannerRefused("the scanner is measuring already; stop it first")
            self._task = None
            return task
        self._account.begin_pass()
        self._wanted, self._resume = True, resume
        self._streaming = True
        self._profile_s = now_s

        def failed(error: ScannerError, at_s: float) -> None:
            self._wanted = self._streaming = False
            self._close_line(at_s)
            self._fail_task(error)

        self._run(self._begin(), now_s, self._begun, failed)
        return task

    def stop(self, now_s: float) -> Task:
        """End the stream; it will not go on by itself, whatever happens."""
        was_wanted, self._wanted = self._wanted, False
        if was_wanted and self.phase is not Phase.UP:
            self._pass_ended("stopped")
        if self._task is not None:
            self._fail_task(ScannerRefused("the scanner was stopped meanwhile"))
        task = self._new_task()
        if task.done:
            return task

        def over(_: object, at_s: float) -> None:
            self._end_stream(at_s, was_wanted, "stopped")
            self._finish_task()

        def failed(error: ScannerError, at_s: float) -> None:
            self._end_stream(at_s, was_wanted, "fault")
            self._fail_task(error)

        self._run(self._end(), now_s, over, failed)
        return task

    def tally(self) -> Tally:
        """The accounts so far."""
        return self._account.tally()

    # ---- for the protocols ----------------------------------------------------------------------------------------

    def _damage(self, damage: Damage) -> None:
        """Enter damage, once there is a device whose account it can be."""
        if self.info is not None:
            self._account.damage(damage)

    def _unasked(self, item: Any, now_s: float) -> None:
        if self._streaming:
            self._take(item, now_s)

    def _fault(self, text: str) -> None:
        """The device itself has stopped measuring; `text` is one sentence."""
        self._advise(text)
        self._streaming = False
        if self._wanted:
            self._wanted = False
            self._pass_ended("fault")

    def _jumped(self, jumps: int) -> None:
        """Tell of jumps of the device's clock, `jumps` of them so far."""
        if jumps > self._told_jumps:
            self._told_jumps = jumps
            self._emit(ClockJumped(jumps))

    def _profile(
        self,
        x_mm: Float64Array,
        z_mm: Float64Array,
        missing: BoolArray,
        device_time_s: float,
        now_s: float,
        no_return: dict[str, int],
    ) -> None:
        """Hand on the profile that was entered last."""
        assert self.info is not None
        self._profile_s = now_s
        profile = Profile(
            device_id=self.info.device_id,
            boot_id=self.boot_id,
            pass_index=self.pass_index,
            line_index=self._account.latest_line,
            device_time_s=device_time_s,
            arrival_s=now_s,
            x_mm=x_mm,
            z_mm=z_mm,
            missing=missing,
            laser_mm=self.info.geometry.laser_mm.copy(),
            position_mm=float(np.nan),
            line_spacing_mm=float(np.nan),
            step_mm=float(np.nan),
        )
        if self._deliver(profile):
            self._account.handed_on(no_return, whole=profile.is_whole)
        else:
            self._account.not_taken()

    # ---- inside ---------------------------------------------------------------------------------------------------

    def _new_task(self) -> Task:
        task = self._task = Task()
        if self.phase is not Phase.UP:
            self._fail_task(ScannerNotConnected("the scanner is not connected; wait until it is back"))
        return task

    def _finish_task(self) -> None:
        task, self._task = self._task, None
        if task is not None:
            task.done = True

    def _fail_task(self, error: ScannerError) -> None:
        task, self._task = self._task, None
        if task is not None:
            task.failure, task.done = error, True

    def _begun(self, _: object, now_s: float) -> None:
        self._profile_s = now_s
        self._finish_task()

    def _end_stream(self, now_s: float, was_wanted: bool, reason: str) -> None:
        self._close_line(now_s)
        self._streaming = False
        if was_wanted:
            self._pass_ended(reason)

    def _pass_ended(self, reason: str) -> None:
        self._account.end_pass()
        self._emit(PassEnded(self.pass_index, reason))

    def _met(self, info: DeviceInfo, now_s: float) -> None:
        if self.info is not None and info.device_id != self.info.device_id:
            if self._other_id != info.device_id:
                self._emit(OtherDevice(self.info.device_id, info.device_id))
            self._other_id = info.device_id
            self.phase = Phase.OTHER_DEVICE
            return
        is_first = self.info is None
        self.info = info
        self.phase = Phase.UP
        self._other_id = ""
        if is_first or self._lost_s is None:
            return
        gap_s, self._lost_s = now_s - self._lost_s, None
        if not self._wanted:
            self._emit(Reconnected(gap_s, streaming=False))
            return
        self._streaming = True
        self._profile_s = now_s

        def goes_on(_: object, at_s: float) -> None:
            self._begun(None, at_s)
            self._emit(Reconnected(gap_s, streaming=True))

        def does_not(error: ScannerError, _at_s: float) -> None:
            self._wanted = self._streaming = False
            self._emit(Reconnected(gap_s, streaming=False))
            self._emit(PassNotResumed(str(error)))

        self._run(self._begin(), now_s, goes_on, does_not)

    def _unmet(self, error: ScannerError, _now_s: float) -> None:
        self.failure = error
        self.phase = Phase.UNMET
