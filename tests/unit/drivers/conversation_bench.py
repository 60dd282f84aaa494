"""A host's half and a simulated device on one wire in simulated time: paced, of one rate or noise, and to be cut."""

import numpy as np

from drivers.protocols.conversation import Conversation, Listener, Phase, Task
from drivers.scanline import Float64Array, Profile
from simulators.faults import misread
from simulators.pacing import Pacer

TICK_S = 0.004


def flat_scene(height_mm: float = 200.0):
    """Ranges of a lidar over a plane that rises with time, so that no two scans are alike."""

    def ranges(angles_rad: Float64Array, elapsed_s: float) -> Float64Array:
        with np.errstate(divide="ignore"):
            distance = (height_mm + elapsed_s) / np.cos(angles_rad)
        return np.where((np.cos(angles_rad) > 0.2) & (distance < 900.0), distance, np.nan)

    return ranges


class ConversationBench:
    """`corrupt` may change what the device sends, `lose_to_device` drops what the host says."""

    def __init__(self, make, device):
        self.lines: list[Profile] = []
        self.told = []
        self.keeps = True
        self.host: Conversation = make(Listener(self._deliver, self.told.append, 4711))
        self.device = device
        self.now_s = 100.0
        self.plugged = False
        self.corrupt = lambda data: data
        self.lose_to_device = lambda: False
        self.to_device = bytearray()
        self.sent_bytes = 0
        self._rng = np.random.default_rng(9)
        self._rate = device.baud_rate
        self._pacer = Pacer(self._rate, self.now_s)

    def _deliver(self, profile):
        if self.keeps:
            self.lines.append(profile)
        return self.keeps

    def run(self, seconds, until=lambda: False):
        """Let time pass; True when `until` came true."""
        for _ in range(round(seconds / TICK_S)):
            if until():
                return True
            self.now_s += TICK_S
            room = self._pacer.room_bytes(self.now_s)
            rate = self.device.baud_rate
            data = self.device.transmit(self.now_s, room)
            self.device.next_due_s(self.now_s)
            self._pacer.spend(len(data))
            self.sent_bytes += len(data)
            if self.plugged:
                arrived = misread(data, rate, self.host.baud_rate, self._rng) if data else b""
                self.host.receive(self.corrupt(arrived), self.now_s)
                self.host.tick(self.now_s)
                trouble = self.host.trouble(self.now_s)
                if trouble is not None and self.host.is_met:
                    self.host.link_lost(trouble, self.now_s)
                    self.host.link_opened(self.now_s)
                said = bytes(self.host.outgoing)
                self.host.outgoing.clear()
                if said and not self.lose_to_device():
                    self.to_device += said
                    self.device.receive(misread(said, self.host.baud_rate, rate, self._rng), self.now_s)
            if self.device.baud_rate != self._rate:
                self._rate = self.device.baud_rate
                self._pacer = Pacer(self._rate, self.now_s)
        return until()

    def plug(self):
        self.plugged = True
        self.host.link_opened(self.now_s)

    def unplug(self):
        self.plugged = False
        self.host.link_lost("pulled out", self.now_s)

    def meet(self, seconds=20.0):
        self.plug()
        self.run(seconds, lambda: self.host.phase is not Phase.MEETING)
        assert self.host.phase is Phase.UP, self.host.failure
        return self

    def ask(self, task: Task):
        assert self.run(20.0, lambda: task.done)
        if task.failure is not None:
            raise task.failure
        return task

    def start(self, *, resume=True):
        self.ask(self.host.start(self.now_s, resume=resume))

    def stop(self):
        self.ask(self.host.stop(self.now_s))

    def scan(self, n_lines):
        """Measure until so many more lines are there."""
        wanted = len(self.lines) + n_lines
        assert self.run(60.0, lambda: len(self.lines) >= wanted), (len(self.lines), self.told, self.host.tally())

    def told_of(self, kind):
        return [event for event in self.told if isinstance(event, kind)]
