"""A computer that is too busy to read counts how late it came: the device may have dropped what nobody fetched."""

import threading
from dataclasses import replace

from hypothesis import given
from hypothesis import strategies as st

from drivers.errors import PortLost
from drivers.port import Port
from drivers.port_thread import PortThread
from drivers.tally import Tally

Reading = tuple[float, bool, float]
"""How long a reading took, whether something had come, and how long it was until the next one."""


class ScriptedPort(Port):
    """A port on which each reading takes as long as the script says; nothing is opened."""

    def __init__(self, readings: list[Reading]) -> None:
        self.path = "/dev/none"
        self.now_s = 100.0
        self.left = list(readings)

    def read(self, timeout_s: float) -> bytes:
        if not self.left:
            raise PortLost(self.path, "the script is over")
        self.now_s += min(self.left[0][0], timeout_s)
        return b"x" if self.left[0][1] else b""

    def close(self) -> None:
        pass


class Reader(PortThread):
    """The thread of that port; what it does between two readings takes as long as the script says."""

    def __init__(self, port: ScriptedPort) -> None:
        self._port = port
        super().__init__(threading.Condition(), lambda: port.now_s)

    def read_all(self) -> None:
        self._begin(self._port, "script")
        assert self._thread is not None
        self._thread.join()

    def _talk(self, port: Port, data: bytes) -> None:
        self._port.now_s += self._port.left.pop(0)[2]

    def _opened(self, now_s: float) -> None:
        pass

    def _lost(self, reason: str, now_s: float) -> bool:
        return False

    def _open_again(self) -> Port:
        raise NotImplementedError


SECONDS = st.sampled_from((0.0, 0.001, 0.02, 0.09, 0.2, 1.5, 60.0))


@given(st.lists(st.tuples(st.floats(0.0, 0.02), st.booleans(), SECONDS), max_size=30))
def test_a_reading_is_late_when_something_waited_for_more_than_a_tenth_of_a_second(readings: list[Reading]) -> None:
    reader = Reader(ScriptedPort(readings))
    reader.read_all()
    assert isinstance(reader.failure, PortLost)
    away_s = [0.0] + [busy_s for _, _, busy_s in readings]
    found = [before_s + took_s for before_s, (took_s, came, _) in zip(away_s, readings, strict=False) if came]
    assert reader.late_reads == sum(pause_s > 0.12 for pause_s in found)
    assert abs(reader.largest_pause_s - max(found, default=0.0)) < 1e-9


def test_the_accounts_of_two_scanners_add_what_was_late_and_keep_the_longest_pause() -> None:
    one, other = Tally(late_reads=2, largest_pause_s=0.5), Tally(late_reads=3, largest_pause_s=1.5)
    assert one + other == other + one == replace(Tally(), late_reads=5, largest_pause_s=1.5)
    assert (one + other).to_dict()["late_reads"] == 5
