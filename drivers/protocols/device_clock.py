"""A device's own clock, continued over its wraps and resets; knows nothing of what it times.

The raw counter says when, the host's clock only how many wraps lie between two readings, so that a delay on the wire
or in the host never shifts a measurement.
"""

from drivers.protocols.unwrap import unwrap

_TOLERANCE_S = 2.0
_DRIFT = 0.01


class DeviceClock:
    """Counter readings as seconds that never run backwards.

    Parameters
    ----------
    span : the counter counts 0 to span - 1 and begins again.
    tick_s : seconds of one count.

    Notes
    -----
    A reading that disagrees with the host's clock by more than 2 s and 1 % of the time between, or that lies before its
    predecessor, is a *jump*: the device was reset. Its time then goes on by the host's clock, and `jumps` counts it.
    """

    def __init__(self, span: int, tick_s: float) -> None:
        self._span = span
        self._tick_s = tick_s
        self._ticks: int | None = None
        self._ahead = 0  # what was added at jumps
        self._arrival_s = 0.0
        self.jumps = 0

    def read(self, raw: int, arrival_s: float) -> float:
        """Return the device's time in seconds for a raw reading that arrived at `arrival_s` of the host's clock."""
        if self._ticks is None:
            self._ticks, self._arrival_s = raw, arrival_s
            return raw * self._tick_s
        waited_s = max(0.0, arrival_s - self._arrival_s)
        expected = self._ticks + round(waited_s / self._tick_s)
        ticks = unwrap(expected - self._ahead, raw, self._span) + self._ahead
        off_s = abs(ticks - expected) * self._tick_s
        if off_s > _TOLERANCE_S + _DRIFT * waited_s or ticks < self._ticks:
            self.jumps += 1
            self._ahead += expected - ticks
            ticks = expected
        self._ticks, self._arrival_s = ticks, arrival_s
        return ticks * self._tick_s
