"""An RS-485 adapter that hears itself: what the host sends comes back to it before the device's answer."""

from simulators.pty_port import SerialDevice


class EchoingAdapter:
    """Any device behind such an adapter."""

    def __init__(self, device: SerialDevice) -> None:
        self._device = device
        self._echo = bytearray()

    @property
    def baud_rate(self) -> int:
        """The device's rate, where it has one of its own."""
        return int(getattr(self._device, "baud_rate", 0))

    def receive(self, data: bytes, now_s: float) -> None:
        """Take bytes from the host, and repeat them to it."""
        self._echo += data
        self._device.receive(data, now_s)

    def transmit(self, now_s: float, room_bytes: int) -> bytes:
        """The echo first, then what the device has to send."""
        echo = bytes(self._echo[:room_bytes])
        del self._echo[:room_bytes]
        return echo + self._device.transmit(now_s, room_bytes - len(echo))

    def next_due_s(self, now_s: float) -> float | None:
        """When there is next something to send."""
        return now_s if self._echo else self._device.next_due_s(now_s)
