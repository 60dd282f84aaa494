"""A simulated device behind a real pseudo-terminal, paced to its baud rate; the only file with a pty and a clock.

Knows nothing of what the bytes mean. The pacing is that of a wire with flow control: what the client does not fetch
stays with the device, which then has to drop lines itself and count them, as real scanners do.
"""

import errno
import fcntl
import os
import select
import struct
import sys
import termios
import threading
import time
import tty
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self, runtime_checkable

import numpy as np

from simulators.faults import FaultCounts, Faults, FaultyWire, misread
from simulators.pacing import Pacer

_LONGEST_WAIT_S = 0.02
_READ_BYTES = 4096
_RATES = {getattr(termios, name): int(name[1:]) for name in dir(termios) if name[0] == "B" and name[1:].isdigit()}
_TCGETS2 = 0x802C542A  # Linux: the terminal's attributes with its rate as a number
_TERMIOS2 = struct.Struct("4IB19s2I")


class SimulatedPortError(Exception):
    """A simulated port that cannot serve.

    SimulatedPortError
    +-- LinkPathTaken     something that is not a link to a terminal is where the link should be
    +-- DeviceFailed      the simulated device raised; its exception is the cause
    +-- UnknownDevice     no device of that name, or not with that rate
    """


class LinkPathTaken(SimulatedPortError):
    """Something that is not a link to a terminal is where the link should be."""


class DeviceFailed(SimulatedPortError):
    """The simulated device raised; its exception is the cause."""


class UnknownDevice(SimulatedPortError):
    """No device of that name can be simulated, or not with that rate."""


class SerialDevice(Protocol):
    """The device's half of a protocol: bytes in, bytes out, time passed in."""

    def receive(self, data: bytes, now_s: float) -> None:
        """Take in what the host sent."""

    def transmit(self, now_s: float, room_bytes: int) -> bytes:
        """At most `room_bytes` of what the device has to send by now."""

    def next_due_s(self, now_s: float) -> float | None:
        """The time at which the device next has something to send; None = not before it receives something."""


@runtime_checkable
class RateChanging(Protocol):
    """A device that changes its rate when it is told to: the port follows it."""

    baud_rate: int


@dataclass(slots=True)
class PortCounts:
    """Bytes on the host's side of the wire, after faults.

    `sent_bytes` reached the terminal and `received_bytes` came from it. `unplugged_bytes` the device sent into the
    air; `misread_bytes` went either way while the two ends disagreed on the rate.
    """

    sent_bytes: int = 0
    received_bytes: int = 0
    unplugged_bytes: int = 0
    misread_bytes: int = 0


class PtyPort:
    """Runs a simulated device behind a pseudo-terminal, in a thread (`start`, `stop`) or in the foreground (`run`).

    Parameters
    ----------
    device : the device; called from one thread only.
    baud_rate : the rate of the device's wire.
    faults : what the wire does to the device's bytes.
    clock : seconds that never go back.
    link_path : a symbolic link that always names the present terminal, as udev's links do.
    rng : chance for the faults; needed with `faults` and with `heeds_client_rate`.
    heeds_client_rate : whether a client that sets another rate than the device's reads, and writes, noise.
    """

    def __init__(
        self,
        device: SerialDevice,
        baud_rate: int,
        faults: Faults | None = None,
        clock: Callable[[], float] = time.monotonic,
        link_path: Path | None = None,
        rng: np.random.Generator | None = None,
        heeds_client_rate: bool = False,
    ) -> None:
        if rng is None and (faults is not None or heeds_client_rate):
            raise ValueError("faults and misread bytes are drawn by chance: give rng")
        self._device = device
        self._baud_rate = baud_rate
        self._clock = clock
        self._link_path = link_path
        self._rng = np.random.default_rng(0) if rng is None else rng
        self._wire = FaultyWire(faults or Faults(), self._rng)
        self._heeds_client_rate = heeds_client_rate
        self._pacer = Pacer(baud_rate, clock())
        self._master = self._slave = -1
        self._path: Path | None = None
        self._pending = bytearray()
        self._is_quiet = False
        self._counts = PortCounts()
        self._requests: deque[tuple[Callable[[], None], threading.Event]] = deque()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._failure: BaseException | None = None

    @property
    def path(self) -> Path:
        """The link if there is one, else the terminal itself: what a client opens."""
        if self._link_path is not None:
            return self._link_path
        if self._path is None:
            raise SimulatedPortError("the simulated port is not plugged in; start it or plug it in again first")
        return self._path

    @property
    def is_plugged(self) -> bool:
        """True while there is a terminal to open."""
        return self._master >= 0

    @property
    def is_quiet(self) -> bool:
        """True once the device has said all it had to say by itself, so that a client opens on a frame's border."""
        return self._is_quiet

    @property
    def has_failed(self) -> bool:
        """True when the device raised in the thread; `stop` then says what."""
        return self._failure is not None

    @property
    def counts(self) -> PortCounts:
        """A copy of the counts so far."""
        return replace(self._counts)

    @property
    def fault_counts(self) -> FaultCounts:
        """A copy of what the wire did so far."""
        return replace(self._wire.counts)

    def client_baud_rate(self) -> int | None:
        """The rate that the client set, None when unplugged or not to be told."""
        if not self.is_plugged:
            return None
        rate = _RATES.get(termios.tcgetattr(self._slave)[5])
        if rate is None and sys.platform == "linux":
            attributes = fcntl.ioctl(self._slave, _TCGETS2, bytes(_TERMIOS2.size))
            rate = int(_TERMIOS2.unpack(attributes)[-1])
        return rate

    def start(self) -> None:
        """Plug in and serve in a thread until `stop`."""
        if self._thread is not None:
            raise SimulatedPortError("the simulated port is already running")
        self._stop.clear()
        self._plug_in()
        self._thread = threading.Thread(target=self._serve_in_thread, name="simulated-port", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop serving and close everything. Raises `DeviceFailed` when the device raised meanwhile."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self._pull_out()
        if self._failure is not None:
            failure, self._failure = self._failure, None
            raise DeviceFailed(f"the simulated device stopped with {type(failure).__name__}: {failure}") from failure

    def run(self, stop: threading.Event) -> None:
        """Serve in the calling thread until `stop` is set, then close everything."""
        self._plug_in()
        try:
            self._serve(stop)
        finally:
            self._pull_out()

    def unplug(self) -> None:
        """Pull the cable: the client's terminal hangs up and the link vanishes; the device runs on unheard."""
        self.in_loop(self._pull_out)

    def replug(self) -> None:
        """Put the cable back: a new terminal, most likely under a new name, and the link points to it."""
        self.in_loop(self._plug_in)

    def in_loop(self, action: Callable[[], None]) -> None:
        """Have the serving thread do it: only that one may touch the device, or close what it is waiting on."""
        if self._thread is None or not self._thread.is_alive():
            action()
            return
        done = threading.Event()
        self._requests.append((action, done))
        while not done.wait(_LONGEST_WAIT_S):
            if not self._thread.is_alive():
                raise SimulatedPortError("the simulated port stopped before the cable could be moved")

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def _serve_in_thread(self) -> None:
        try:
            self._serve(self._stop)
        except Exception as failure:  # noqa: BLE001 - a thread's loop; `stop` raises it
            self._failure = failure
            self._pull_out()

    def _serve(self, stop: threading.Event) -> None:
        while not stop.is_set():
            while self._requests:
                action, done = self._requests.popleft()
                action()
                done.set()
            self._take_from_device()
            self._write()
            if self._wait():
                self._read()

    def _take_from_device(self) -> None:
        now_s = self._clock()
        # While the client does not fetch there is no room, but the device must know the time: it goes on measuring.
        room_bytes = 0 if self._pending else self._pacer.room_bytes(now_s)
        data = self._device.transmit(now_s, room_bytes)
        if len(data) > room_bytes:
            raise ValueError(f"the device sent {len(data)} bytes where {room_bytes} were allowed")
        self._pacer.spend(len(data))
        pieces = self._wire.carry(data) if data or not room_bytes else self._wire.release()
        arrived = b"".join(pieces)
        if self._rates_differ():
            arrived = misread(arrived, self._baud_rate, self.client_baud_rate() or self._baud_rate, self._rng)
            self._counts.misread_bytes += len(arrived)
        self._follow_rate(now_s)
        if not self.is_plugged:
            self._counts.unplugged_bytes += len(arrived)
            return
        self._pending += arrived

    def _write(self) -> None:
        while self._pending:
            try:
                written = os.write(self._master, self._pending)
            except BlockingIOError:
                return
            self._counts.sent_bytes += written
            del self._pending[:written]

    def _read(self) -> None:
        try:
            data = os.read(self._master, _READ_BYTES)
        except BlockingIOError:
            return
        except OSError as error:
            if error.errno != errno.EIO:
                raise
            return
        self._counts.received_bytes += len(data)
        if self._rates_differ():
            self._counts.misread_bytes += len(data)
            data = misread(data, self.client_baud_rate() or self._baud_rate, self._baud_rate, self._rng)
        self._device.receive(data, self._clock())
        self._follow_rate(self._clock())

    def _follow_rate(self, now_s: float) -> None:
        if isinstance(self._device, RateChanging) and self._device.baud_rate != self._baud_rate:
            self._baud_rate = self._device.baud_rate
            self._pacer = Pacer(self._baud_rate, now_s)

    def _wait(self) -> bool:
        """Until the client sends, or fetches what is pending, or the device is due; True when there is input."""
        now_s = self._clock()
        due_s = self._device.next_due_s(now_s)
        self._is_quiet = due_s is None and not self._pending
        wait_s = _LONGEST_WAIT_S if due_s is None else min(max(due_s - now_s, 0.002), _LONGEST_WAIT_S)
        poll = select.poll()
        if self.is_plugged:
            poll.register(self._master, select.POLLIN | (select.POLLOUT if self._pending else 0))
        events = poll.poll(wait_s * 1000.0)
        return any(event & select.POLLIN for _, event in events)

    def _rates_differ(self) -> bool:
        return self._heeds_client_rate and self.client_baud_rate() not in (None, self._baud_rate)

    def _plug_in(self) -> None:
        if self.is_plugged:
            return
        self._check_link()
        self._master, self._slave = os.openpty()
        # Raw before anyone can open it, or the terminal would echo the device's bytes back to it.
        tty.setraw(self._master)
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self._set_rate()
        self._path = Path(os.ttyname(self._slave))
        if self._link_path is not None:
            beside = self._link_path.with_name(f".{self._link_path.name}.{os.getpid()}")
            beside.unlink(missing_ok=True)
            beside.symlink_to(self._path)
            beside.replace(self._link_path)

    def _set_rate(self) -> None:
        """Start the terminal at the device's rate where that has a name, as if the last client had got it right."""
        constant = next((constant for constant, rate in _RATES.items() if rate == self._baud_rate), None)
        if constant is not None:
            attributes = termios.tcgetattr(self._slave)
            attributes[4] = attributes[5] = constant
            termios.tcsetattr(self._slave, termios.TCSANOW, attributes)

    def _check_link(self) -> None:
        link = self._link_path
        if link is None or not (link.exists() or link.is_symlink()):
            return
        if not (link.is_symlink() and str(link.readlink()).startswith("/dev/")):
            raise LinkPathTaken(f"{link} is there already and is not a link to a terminal; remove it or name another")

    def _pull_out(self) -> None:
        if not self.is_plugged:
            return
        if self._link_path is not None and self._link_path.is_symlink() and self._link_path.readlink() == self._path:
            self._link_path.unlink()
        os.close(self._master)
        os.close(self._slave)
        self._master = self._slave = -1
        self._path = None
        self._counts.unplugged_bytes += len(self._pending)
        self._pending.clear()
