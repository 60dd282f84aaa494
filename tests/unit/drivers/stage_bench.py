"""A stage's host and a simulated controller on a wire that can be cut and made noisy, in simulated time."""

from collections.abc import Callable
from typing import Any

from drivers.protocols.grbl_host import GrblHost
from drivers.protocols.marlin_host import MarlinHost
from drivers.protocols.stage_events import Reading, StageEvent
from drivers.protocols.stage_host import Errand, Phase, StageHost
from drivers.protocols.zaber_host import ZaberHost
from simulators.devices.grbl import GrblDevice
from simulators.devices.marlin import MarlinDevice
from simulators.devices.zaber import ZaberDevice

TICK_S = 0.01
MICROSTEP_MM = 0.001
KINDS = ("grbl", "marlin", "zaber")


class StageBench:
    """One axis; `where` is the truth in mm."""

    def __init__(self, kind: str, device: Any = None) -> None:
        self.kind = kind
        self.readings: list[Reading] = []
        self.told: list[StageEvent] = []
        self.host: StageHost
        if kind == "grbl":
            self.device = device or GrblDevice()
            self.host = GrblHost(self.readings.append, self.told.append)
        elif kind == "marlin":
            self.device = device or MarlinDevice()
            self.host = MarlinHost(self.readings.append, self.told.append)
        else:
            self.device = device or ZaberDevice()
            self.host = ZaberHost(self.readings.append, self.told.append, MICROSTEP_MM)
        self.now_s = 0.0
        self.plugged = True
        self.sent = bytearray()
        self.to_host: Callable[[bytes], bytes] = lambda data: data
        self.to_device: Callable[[bytes], bytes] = lambda data: data

    @property
    def where(self) -> float:
        place = float(self.device.axes.position(self.now_s)[0])
        return place * MICROSTEP_MM if self.kind == "zaber" else place

    def is_moving(self) -> bool:
        return bool(self.device.axes.is_moving(self.now_s))

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / TICK_S)):
            self.now_s += TICK_S
            data = self.device.transmit(self.now_s, 1000)
            if not self.plugged:
                continue
            self.host.receive(self.to_host(data), self.now_s)
            self.host.tick(self.now_s)
            outgoing = self.host.outbox.peek()[:60]
            self.host.outbox.wrote(len(outgoing))
            self.sent += outgoing
            self.device.receive(self.to_device(outgoing), self.now_s)

    def until(self, condition: Callable[[], bool], within_s: float = 60.0) -> None:
        end_s = self.now_s + within_s
        while not condition():
            assert self.now_s < end_s, f"not within {within_s} s of simulated time"
            self.run(TICK_S)

    def greet(self) -> "StageBench":
        self.host.link_opened(self.now_s)
        self.until(lambda: self.host.phase is Phase.UP and bool(self.readings), 10.0)
        return self

    def ask(self, errand: Errand) -> Errand:
        self.until(lambda: errand.is_over, 200.0)
        return errand

    def homed(self) -> "StageBench":
        self.greet()
        assert self.ask(self.host.home(self.now_s)).is_done, self.host.errand
        assert self.host.position_known
        return self

    def queue(self, words: str) -> None:
        """Let a line wait to be sent, as the conversation does it."""
        if isinstance(self.host, GrblHost):
            self.host._send(words.encode() + b"\n")
        elif isinstance(self.host, MarlinHost | ZaberHost):
            self.host._put(words, self.now_s)

    def target(self, mm: float) -> float:
        """A place that the axis can go to: GRBL's lie below zero."""
        return -mm if self.kind == "grbl" else mm

    def unplug(self) -> None:
        self.plugged = False
        self.host.link_lost("pulled out", self.now_s)

    def plug(self) -> None:
        self.plugged = True
        self.device.transmit(self.now_s, 100_000)
        self.host.link_opened(self.now_s)
