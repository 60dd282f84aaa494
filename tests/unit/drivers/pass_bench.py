"""A stage and a scanner by the faces that passes know, in a time of their own: a look at the scanner takes 0.05 s."""

import math
from types import SimpleNamespace

import numpy as np

from drivers.errors import StageNotConnected, StageStopped
from drivers.passes.drive import PassDrive
from drivers.passes.left_out import LeftOut
from drivers.passes.lines import PassLines
from drivers.passes.stopping import Stopping
from drivers.passes.told import Told
from drivers.protocols.scanner_events import Disconnected, PassEnded, Reconnected
from drivers.protocols.stage_events import StageDisconnected, StageReconnected
from drivers.rig import Rig
from drivers.rig_description import PairBy, Pairing
from drivers.rig_limits import PassOrder
from drivers.scanline import Profile
from drivers.stages.face import StageInfo, StageReading

LOOK_S = 0.05
MOST_LOOKS = 20_000
ORDER = PassOrder(0.0, 10.0, 0.5, 10.0)
AT_REST = PassOrder(0.0, 4.0, 0.2, 0.0)


class Workshop:
    """The time, what was sent in order, and what happens meanwhile: `at_call` by number of
    call, but while nothing is being sent; `at_look` by number of look at the scanner.
    """

    def __init__(self):
        self.now_s = 100.0
        self.sent = []
        self.moved_s = []  # when the stage set off
        self.calls = self.looks = 0
        self.at_call = lambda _number: None
        self.at_look = {}

    def clock(self):
        return self.now_s

    def called(self):
        self.calls += 1
        self.at_call(self.calls)


class BenchStage:
    """An axis that goes at the speed that it was told."""

    def __init__(self, shop):
        self.shop = shop
        self.is_connected = self._known = True
        self.at_known = lambda: None
        self._at_mm, self._target_mm, self._speed, self._since_s = -3.0, None, 0.0, 0.0
        self._failure = None
        self._events = []

    def enter(self):
        return StageInfo("bench")

    def exit(self):
        self.stop()

    @property
    def position_known(self):
        self.at_known()
        return True

    def unplug(self):
        self._at_mm, self._target_mm = self._place(), None
        self.is_connected, self._failure = False, StageNotConnected("unplugged")
        self._events.append(StageDisconnected("unplugged", self.shop.now_s))

    def replug(self):
        self.is_connected = True
        self._events.append(StageReconnected(0.1, True))

    def start_move(self, position_mm, speed_mm_per_s):
        self.shop.sent.append("move")
        self._check()
        self.shop.moved_s.append(self.shop.now_s)
        self._at_mm, self._since_s = self._place(), self.shop.now_s
        self._target_mm, self._speed, self._failure = position_mm, speed_mm_per_s, None

    def finish_move(self, timeout_s):
        self.shop.called()
        self.shop.now_s += timeout_s
        if self._failure is not None:
            raise self._failure
        if self._target_mm is not None and self._place() != self._target_mm:
            return None
        return self._reading()

    def move_to(self, position_mm, speed_mm_per_s):
        self.start_move(position_mm, speed_mm_per_s)
        while (reading := self.finish_move(1.0)) is None:
            pass
        return reading

    def readings(self):
        self.shop.called()
        return [self._reading()] if self.is_connected else []

    def stage_events(self):
        events, self._events = self._events, []
        return events

    def stop(self):
        self.shop.sent.append("stop")
        self._check()
        self._at_mm, self._target_mm, self._failure = self._place(), None, StageStopped("stopped")

    def _check(self):
        if not self.is_connected:
            raise StageNotConnected("unplugged")

    def _place(self):
        if self._target_mm is None:
            return self._at_mm
        way_mm = self._speed * (self.shop.now_s - self._since_s)
        left_mm = self._target_mm - self._at_mm
        return self._target_mm if way_mm >= abs(left_mm) else self._at_mm + math.copysign(way_mm, left_mm)

    def _reading(self):
        now_s = self.shop.now_s
        return StageReading(self._place(), now_s, now_s, False)


class BenchScanner:
    """One profile a look, from its start until it is stopped; `skipped` lines are made and never arrive."""

    most_lines_per_s = math.inf

    def __init__(self, shop):
        self.shop = shop
        self.is_connected = True
        self.laser_on = False
        self.skipped = frozenset()
        self._line = 0
        self._events = []

    def enter(self):
        return None  # nobody asks

    def exit(self):
        self.laser_on = False

    def miss(self, n_lines):
        """Make so many lines that never arrive."""
        self._line += n_lines

    def unplug(self):
        self.is_connected = False
        self._events.append(Disconnected("unplugged", self.shop.now_s))

    def replug(self):
        self.is_connected = True
        self._events.append(Reconnected(0.1, True))

    def start_profiles(self, *, resume=True):
        self.shop.sent.append("laser")
        self.laser_on = True
        return 1

    def start_pass(self, *order):
        self.ordered = order
        return self.start_profiles()

    def stop_profiles(self):
        self.laser_on = False

    def stop_pass(self):
        self.laser_on = False
        self._events.append(PassEnded(1, "stopped"))

    def events(self, timeout_s):
        shop = self.shop
        shop.called()
        shop.looks += 1
        assert shop.looks < MOST_LOOKS, "the pass hangs"
        shop.at_look.get(shop.looks, lambda: None)()
        shop.now_s += LOOK_S if timeout_s else 0.0
        happened, self._events = self._events, []
        if not (self.laser_on and self.is_connected):
            return happened
        self._line += 1
        if self._line in self.skipped:
            return happened
        no, nan = np.zeros(3), math.nan
        times = shop.now_s, shop.now_s
        return [*happened, Profile("S", 1, 1, self._line, *times, no, no, np.zeros(3, bool), no, nan, nan, nan)]


def bench(order=ORDER, by=PairBy.TIME):
    """A pass that is about to run: its workshop, stage, scanner and drive."""
    shop = Workshop()
    stage, scanner, told, pairing = BenchStage(shop), BenchScanner(shop), Told(), Pairing(by)
    limits = SimpleNamespace(speed_mm_per_s=(0.0, 20.0), line_rate_hz=(0.0, math.inf))
    description = SimpleNamespace(pairing=pairing, limits=limits)
    lines = PassLines(Rig(), order, pairing, told, LeftOut())
    return shop, stage, scanner, PassDrive(description, scanner, stage, stage, lines, told, shop.clock, Stopping())
