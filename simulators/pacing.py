"""How many bytes a serial wire has had time for; knows no port and no clock: the time is passed in."""

import math

_BITS_PER_BYTE = 10  # a start bit, eight data bits, a stop bit
_SLACK_S = 0.05  # how far a late loop may catch up


class Pacer:
    """How many bytes a wire has had time for: from `now_s` of its making never more than baud_rate / 10 a second."""

    def __init__(self, baud_rate: int, now_s: float) -> None:
        if baud_rate <= 0:
            raise ValueError(f"the baud rate must be greater than 0, not {baud_rate}")
        self.bytes_per_s = baud_rate / _BITS_PER_BYTE
        self._most_bytes = max(self.bytes_per_s * _SLACK_S, 16.0)
        self._credit_bytes = 0.0
        self._at_s = now_s

    def room_bytes(self, now_s: float) -> int:
        """Bytes that may leave now; an idle wire saves up no more than the slack."""
        earned = max(now_s - self._at_s, 0.0) * self.bytes_per_s
        self._credit_bytes = min(self._credit_bytes + earned, self._most_bytes)
        self._at_s = max(now_s, self._at_s)
        return math.floor(self._credit_bytes)

    def spend(self, n_bytes: int) -> None:
        """Note that bytes left."""
        self._credit_bytes -= n_bytes
