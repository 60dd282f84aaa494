"""The host's half of the native protocol: greeting, commands, keepalive, resuming; time is passed in, bytes out.

It knows no port and no thread, so that every schedule of noise, silence and reboot can be played to it in simulated
time. The bytes to send collect in `outgoing`; what happens goes to the two functions it is given.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum

from drivers.protocols.framing import Damage
from drivers.protocols.native import Decoder, encode
from drivers.protocols.native_messages import (
    NM_PER_MM,
    Ack,
    Chunk,
    EndOfPass,
    EndReason,
    EndSeen,
    FromHost,
    Hello,
    HelloRequest,
    Keepalive,
    Laser,
    Message,
    OtherVersion,
    Start,
    Status,
    Stop,
)
from drivers.protocols.native_requests import COMMAND_S, PassPlan, Request, describe_failure
from drivers.protocols.native_stream import ProfileStream, position_mm
from drivers.protocols.scanner_events import (
    Disconnected,
    OtherDevice,
    PassEnded,
    PassNotResumed,
    PassResumed,
    Rebooted,
    Reconnected,
    ScannerEvent,
)
from drivers.scanline import Profile

KEEPALIVE_S = 0.1
RETRY_S = 0.25
QUIET_S = 0.15
"""Silence after which a stale stream is taken to have ended."""
SILENT_S = 1.0
"""Silence, in spite of keepalives, after which the link is taken to be down."""
LINE_TIMEOUT_S = 1.0


class Phase(Enum):
    """Where the conversation stands."""

    CLOSED = "closed"
    QUIETING = "quieting"  # ending whatever an earlier host left running
    ASKING = "asking"  # waiting for the hello
    UP = "up"
    OTHER_DEVICE = "other_device"


@dataclass(slots=True)
class NativeHost:
    """One conversation with one device, over as many links and boots as it takes.

    The laser is only ever switched on by `arm` and, when the caller asked to resume it, for a pass that was running
    when it was interrupted by a dead-man or a reboot.
    """

    deliver: Callable[[Profile], bool]
    emit: Callable[[ScannerEvent], None]
    stream: ProfileStream | None = None
    phase: Phase = Phase.CLOSED
    other_version: int | None = None
    laser_on: bool | None = None
    """The device's last word on its laser; None is unknown, and to be shown as on."""
    outgoing: bytearray = field(default_factory=bytearray)
    heard_bytes: int = 0
    plan: PassPlan | None = None
    _decoder: Decoder = field(default_factory=Decoder)
    _requests: dict[int, Request] = field(default_factory=dict)
    _command_id: int = 0
    _laser_wanted: bool = False
    _other_id: str = ""
    _opened_s: float = 0.0
    _lost_s: float = 0.0
    _heard_s: float = 0.0
    _chunk_s: float = 0.0
    _next_say_s: float = 0.0

    # ---- the link -------------------------------------------------------------------------------------------------

    def link_opened(self, now_s: float) -> None:
        """Begin to talk: at first ends any stale stream, later only asks who is there."""
        self._opened_s = self._heard_s = now_s
        self._next_say_s = now_s
        self.outgoing.clear()
        self.phase = Phase.QUIETING if self.stream is None else Phase.ASKING
        self.tick(now_s)

    def link_lost(self, reason: str, now_s: float) -> None:
        """The port is gone, or given up; `reason` is one sentence."""
        for damage in self._decoder.reset():
            self._take(damage, now_s)
        if self.stream is not None:
            self.stream.link_lost()
        if self.phase is Phase.UP:
            self._lost_s = now_s
            self.emit(Disconnected(reason, now_s))
        self.laser_on = None
        self.outgoing.clear()
        self.phase = Phase.CLOSED

    def is_silent(self, now_s: float) -> bool:
        """True when the device should have been heard and was not: the link is best opened anew."""
        if self.phase is Phase.ASKING and self.stream is not None:
            return now_s - self._opened_s > SILENT_S
        return self.phase is Phase.UP and self._keeps_alive and now_s - self._heard_s > SILENT_S

    @property
    def is_met(self) -> bool:
        """True once a device has said who it is, on this link or an earlier one."""
        return self.stream is not None

    def trouble(self, now_s: float) -> str | None:
        """One sentence when the link is best opened anew; None while all is well."""
        if self.is_silent(now_s):
            return "the scanner has fallen silent; check cable and power"
        return "another device answers" if self.phase is Phase.OTHER_DEVICE else None

    def receive(self, data: bytes, now_s: float) -> None:
        """Take bytes from the device."""
        if data:
            self.heard_bytes += len(data)
            self._heard_s = now_s
        for item in self._decoder.receive(data):
            self._take(item, now_s)

    def tick(self, now_s: float) -> None:
        """Do what is due by now: retries, keepalives, time-outs."""
        if self.phase is Phase.QUIETING and now_s - max(self._heard_s, self._opened_s) >= QUIET_S:
            self.phase = Phase.ASKING
            self._next_say_s = now_s
        if now_s >= self._next_say_s:
            self._say(now_s)
        for command_id, request in list(self._requests.items()):
            if now_s >= request.give_up_s:
                self._fail(command_id, request, now_s)
            elif self.phase is Phase.UP and now_s >= request.next_try_s:
                request.next_try_s = now_s + RETRY_S
                self.outgoing += encode(request.command)
        stream = self.stream
        if stream is not None and stream.has_open_line and now_s - self._chunk_s > LINE_TIMEOUT_S:
            stream.close_line()

    # ---- commands -------------------------------------------------------------------------------------------------

    def arm(self, on: bool, now_s: float, then: Callable[[Request, float], None] | None = None) -> Request:
        """Switch the laser; while it is wanted on, keepalives hold the dead-man off."""
        if not on:
            self._call_off(now_s)
            if self.plan is not None:
                self.plan.resume = False
        if on and not self._keeps_alive:
            self._heard_s = now_s  # an idle device is asked for nothing: its silence counts from here
        self._laser_wanted = on
        return self._request(Laser(self._new_id(), on), now_s, then)

    def start(self, plan: PassPlan, now_s: float, then: Callable[[Request, float], None] | None = None) -> Request:
        """Start a pass; the laser must be on."""
        start, end, spacing = (
            round(length_mm * NM_PER_MM) for length_mm in (plan.start_mm, plan.end_mm, plan.line_spacing_mm)
        )
        command = Start(self._new_id(), spacing, start, end, round(plan.line_rate_hz * 1000))
        self.plan = plan

        def started(request: Request, at_s: float) -> None:
            if request.ok and request.ack is not None:
                plan.index = request.ack.status.pass_index
            elif self.plan is plan:
                self.plan = None
            if then is not None:
                then(request, at_s)

        return self._request(command, now_s, started)

    def stop(self, now_s: float) -> Request:
        """Stop the pass; it will not be resumed, whatever happens."""
        self._call_off(now_s)
        if self.plan is not None:
            self.plan.resume = False
        self._laser_wanted = False
        return self._request(Stop(self._new_id()), now_s, None)

    def abandon(self, now_s: float) -> None:
        """Forget the pass: no keepalive, no resuming; the device's dead-man does the rest."""
        self._call_off(now_s)
        self.plan = None
        self._laser_wanted = False

    # ---- inside ---------------------------------------------------------------------------------------------------

    @property
    def _keeps_alive(self) -> bool:
        return self._laser_wanted or self.plan is not None

    def _new_id(self) -> int:
        self._command_id = self._command_id % 0xFFFF + 1  # 0 is the hello nobody asked for
        return self._command_id

    def _request(self, command: FromHost, now_s: float, then: Callable[[Request, float], None] | None) -> Request:
        request = Request(command, now_s + COMMAND_S, now_s, then)
        self._requests[command.command_id] = request
        self.tick(now_s)
        return request

    def _call_off(self, now_s: float) -> None:
        """Fail what would still switch the laser on or start, so that no retry of it comes after a stop."""
        for command_id, request in list(self._requests.items()):
            if isinstance(request.command, Start) or (isinstance(request.command, Laser) and request.command.on):
                self._fail(command_id, request, now_s)

    def _fail(self, command_id: int, request: Request, now_s: float) -> None:
        if self._requests.pop(command_id, None) is None:
            return
        request.failed = True
        if request.then is not None:
            request.then(request, now_s)

    def _say(self, now_s: float) -> None:
        """Send what this phase repeats."""
        match self.phase:
            case Phase.QUIETING:
                self.outgoing += b"\0" + encode(Stop(self._new_id())) + encode(Laser(self._new_id(), False))
                self._next_say_s = now_s + 2 * RETRY_S
            case Phase.ASKING:
                self.outgoing += encode(HelloRequest(self._new_id()))
                self._next_say_s = now_s + RETRY_S
            case Phase.UP if self._keeps_alive:
                self.outgoing += encode(Keepalive(self._new_id()))
                self._next_say_s = now_s + KEEPALIVE_S
            case _:
                self._next_say_s = now_s

    def _take(self, item: Message | Damage, now_s: float) -> None:
        if self._is_strange(item):
            return
        match item:
            case Damage():
                if self.stream is not None:
                    self.stream.damage(item)
            case OtherVersion(version):
                self.other_version = version
            case Hello():
                self._take_hello(item, now_s)
            case Chunk():
                if self.stream is not None:
                    self._notice_reboot(item.boot_id, now_s)
                    self._chunk_s = now_s
                    if self.stream.chunk(item, now_s) and self.plan is not None and item.pass_index == self.plan.index:
                        self.plan.last_position_mm = position_mm(item, self.stream.encoder_mm_per_count)
            case Ack(command_id, _, _, status):
                self._take_status(status, now_s)
                request = self._requests.pop(command_id, None)
                if request is not None:
                    request.ack = item
                    if request.then is not None:
                        request.then(request, now_s)
            case EndOfPass(status):
                self._take_status(status, now_s)
                self._take_end(status, now_s)

    def _is_strange(self, item: Message | Damage) -> bool:
        """True for what may come from another device than ours: on a new link, before the hello told a new boot."""
        if self.stream is None or isinstance(item, Hello | OtherVersion | Damage):
            return False
        if self.phase is Phase.OTHER_DEVICE:
            return True
        match item:
            case Chunk(boot_id=boot_id):
                return self.phase is Phase.ASKING and self.stream.is_new_boot(boot_id)
            case Ack(status=status) | EndOfPass(status=status):
                return self.phase is Phase.ASKING and self.stream.is_new_boot(status.boot_id)
            case _:
                return True

    def _take_hello(self, hello: Hello, now_s: float) -> None:
        self.other_version = None
        stream = self.stream
        if stream is None:
            if self.phase is not Phase.ASKING:
                return
            if hello.status.streaming or hello.status.laser_on:  # the stop was lost on the way
                self.phase = Phase.QUIETING
                self._next_say_s = now_s
                return
            self.stream = ProfileStream(hello, self.deliver)
            self.laser_on = hello.status.laser_on
            self.phase = Phase.UP
            return
        if hello.info.device_id != stream.info.device_id:
            if self._other_id != hello.info.device_id:
                self.emit(OtherDevice(stream.info.device_id, hello.info.device_id))
            self._other_id = hello.info.device_id
            self.phase = Phase.OTHER_DEVICE
            return
        if self.phase is Phase.ASKING:
            self.phase = Phase.UP
            self._other_id = ""
            self._next_say_s = now_s
            self.emit(Reconnected(now_s - self._lost_s, hello.status.streaming))
        self._notice_reboot(hello.status.boot_id, now_s)
        stream.introduce(hello)
        self.laser_on = hello.status.laser_on

    def _take_status(self, status: Status, now_s: float) -> None:
        if self.stream is None:
            return
        self._notice_reboot(status.boot_id, now_s)
        self.stream.totals(status)
        self.laser_on = status.laser_on

    def _take_end(self, status: Status, now_s: float) -> None:
        """Acknowledge the end of a pass, and tell it once; a pass whose start is not yet acknowledged can wait."""
        plan = self.plan
        stream = self.stream
        if stream is not None and (status.boot_id != stream.boot_id or (plan is not None and plan.index is None)):
            return
        self.outgoing += encode(EndSeen(self._new_id(), status.pass_index))
        if plan is not None and plan.index == status.pass_index and status.end_reason is not EndReason.NONE:
            if stream is not None:
                stream.close_line()
            self._pass_over(plan, status.end_reason.name.lower(), now_s)

    def _notice_reboot(self, boot_id: int, now_s: float) -> None:
        """Tell a new boot once; the hello that belongs to it is asked for, in case it was lost."""
        stream = self.stream
        if stream is None or not stream.is_new_boot(boot_id):
            return
        old_boot_id = stream.boot_id
        stream.begin_boot(boot_id)
        self.emit(Rebooted(old_boot_id, boot_id))
        self.outgoing += encode(HelloRequest(self._new_id()))
        if self.plan is not None and self.plan.index is not None:
            self._pass_over(self.plan, "rebooted", now_s)

    def _pass_over(self, plan: PassPlan, reason: str, now_s: float) -> None:
        self.plan = None
        self._laser_wanted = False
        self.emit(PassEnded(plan.index or 0, reason))
        if not plan.resume or reason not in {"dead_man", "rebooted"} or self.stream is None:
            return
        from_mm = self._resume_mm(plan)
        if (plan.end_mm - from_mm) * (plan.end_mm - plan.start_mm) < 0:
            return  # the last line had been read
        rest = PassPlan(plan.line_spacing_mm, from_mm, plan.end_mm, plan.line_rate_hz, resume=True)
        self.plan = rest  # keeps the dead-man off until the start is acknowledged

        def report(request: Request, _at_s: float) -> None:
            if request.ok and rest.index is not None:
                self.emit(PassResumed(rest.index, from_mm))
            else:
                self._laser_wanted = False
                self.emit(PassNotResumed(describe_failure(request)))

        def armed(request: Request, at_s: float) -> None:
            if self.plan is not rest:  # stopped by the caller meanwhile
                return
            if request.ok and rest.resume:
                self.start(rest, at_s, report)
            else:
                self.plan = None
                self._laser_wanted = False
                self.emit(PassNotResumed(describe_failure(request)))

        self.arm(True, now_s, armed)

    def _resume_mm(self, plan: PassPlan) -> float:
        """Return the position of the first line that was not read."""
        last_mm = plan.last_position_mm
        if math.isnan(last_mm):
            return plan.start_mm
        return last_mm + math.copysign(plan.line_spacing_mm, plan.end_mm - plan.start_mm)
