"""A serial port on this machine: exclusive, non-blocking, with errors that say what to do; the only user of pyserial.

It opens device files only: what a user writes is never taken for a URL. It knows no protocol.
"""

import contextlib
import errno
import fcntl
import grp
import logging
import os
import select
import stat
import struct
import termios
from dataclasses import dataclass
from pathlib import Path

import serial

from drivers.errors import (
    PortAbsent,
    PortBusy,
    PortError,
    PortLost,
    PortNotPermitted,
    PortNotSerial,
    PortRateRefused,
)

_LOG = logging.getLogger(__name__)
_READ_BYTES = 65_536
_GONE = {errno.ENOENT, errno.ENXIO, errno.ENODEV, errno.EIO}
_TIOCGICOUNT = 0x545D  # Linux: what the adapter counted since it was plugged in
_ICOUNT = struct.Struct("11i9i")  # the eighth is the UART's overruns, the eleventh those of the kernel's buffer
_BY_ID = Path("/dev/serial/by-id")


@dataclass(frozen=True, slots=True)
class ModemLines:
    """How the two lines a host can switch are to stand while the port is open; None leaves one as the system has it.

    Set before the port is opened, because boards exist that reset, and scanners whose motor stops, when a line moves.
    `hang_up` False keeps them where they are when the port is closed.
    """

    dtr: bool | None = None
    rts: bool | None = None
    hang_up: bool = True


LEAVE_LINES = ModemLines()


class Port:
    """An open tty, locked against a second opening by any program that asks for the lock.

    Raises
    ------
    PortAbsent, PortBusy, PortNotPermitted, PortNotSerial, PortRateRefused : when it cannot be opened.
    """

    def __init__(self, path: str, baud_rate: int, lines: ModemLines = LEAVE_LINES) -> None:
        self.path = path
        check_device_file(path)
        try:
            self._serial = serial.Serial(None, baud_rate, timeout=0, write_timeout=0, exclusive=True)
            self._serial.port = path
            if lines.dtr is not None:
                self._serial.dtr = lines.dtr
            if lines.rts is not None:
                self._serial.rts = lines.rts
            self._serial.open()
        except ValueError as error:
            raise _rate_refused(path, baud_rate, error) from error
        except OSError as error:  # SerialException is one
            raise _explain(path, error) from error
        self.baud_rate = baud_rate
        self._fd: int = self._serial.fileno()
        self._overruns_at_open = self._read_overruns()
        if not lines.hang_up:
            with contextlib.suppress(OSError, termios.error):
                attributes = termios.tcgetattr(self._fd)
                attributes[2] &= ~termios.HUPCL
                termios.tcsetattr(self._fd, termios.TCSANOW, attributes)
        try:
            self._serial.set_low_latency_mode(True)
        except (ValueError, OSError, NotImplementedError) as error:  # a matter of latency, not of right or wrong
            _LOG.info("%s has no switch for low latency, its adapter may hold bytes back for a while: %s", path, error)

    def read(self, timeout_s: float) -> bytes:
        """Return what has arrived, after at most `timeout_s`; empty when nothing has.

        Raises
        ------
        PortLost : when the port has been pulled out or hung up.
        """
        try:
            readable, _, _ = select.select([self._fd], [], [], timeout_s)
            if not readable:
                return b""
            data = os.read(self._fd, _READ_BYTES)
            data += self._rest(len(data))
        except BlockingIOError:
            return b""
        except (OSError, ValueError) as error:
            raise self._lost(error) from error
        if not data:
            raise self._lost(None)
        return data

    def _rest(self, had: int) -> bytes:
        """What else waits behind the first `had` bytes: a terminal gives some 4,000 at a time, whatever it holds."""
        pieces: list[bytes] = []
        with contextlib.suppress(OSError):  # nothing waits; or the port is lost, which the next reading tells
            while 0 < had < _READ_BYTES:
                piece = os.read(self._fd, _READ_BYTES - had)
                if not piece:
                    break
                pieces.append(piece)
                had += len(piece)
        return b"".join(pieces)

    def write(self, data: bytes) -> int:
        """Write what the port takes at once; return how many bytes that were.

        Raises
        ------
        PortLost : when the port has been pulled out or hung up.
        """
        try:
            return os.write(self._fd, data)
        except BlockingIOError:
            return 0
        except OSError as error:
            raise self._lost(error) from error

    def set_baud_rate(self, baud_rate: int) -> None:
        """Go on at another rate; what has not left yet leaves at the new one.

        Raises
        ------
        PortRateRefused : when the adapter does not do it; the old rate stays.
        PortLost : when the port has been pulled out or hung up.
        """
        if baud_rate == self.baud_rate:
            return
        try:
            self._serial.baudrate = baud_rate
        except ValueError as error:
            self._serial._baudrate = self.baud_rate  # pyserial keeps the refused one, and would refuse for ever
            raise _rate_refused(self.path, baud_rate, error) from error
        except (OSError, termios.error) as error:
            raise self._lost(error) from error
        self.baud_rate = baud_rate

    def set_dtr(self, on: bool) -> bool:
        """Switch DTR; False where there is no such line, as on a pseudo-terminal."""
        try:
            self._serial.dtr = on
        except OSError as error:
            if error.errno in {errno.ENOTTY, errno.EINVAL, errno.ENOTSUP}:
                return False
            raise self._lost(error) from error
        return True

    def overruns(self) -> int | None:
        """Bytes that UART and kernel dropped since the opening because nobody read in time; None where none count."""
        now = self._read_overruns()
        return None if now is None or self._overruns_at_open is None else max(0, now - self._overruns_at_open)

    def close(self) -> None:
        """Close at once; bytes still to be sent are discarded, or closing could wait for a dead line for ever."""
        with contextlib.suppress(OSError, termios.error):
            termios.tcflush(self._fd, termios.TCOFLUSH)
        self._serial.close()

    def _read_overruns(self) -> int | None:
        try:
            counts = _ICOUNT.unpack(fcntl.ioctl(self._fd, _TIOCGICOUNT, bytes(_ICOUNT.size)))
        except OSError:
            return None
        return int(counts[7] + counts[10])

    def _lost(self, error: Exception | None) -> PortLost:
        detail = f" ({error})" if error is not None else ""
        return PortLost(self.path, f"{self.path} was pulled out or hung up{detail}; plug it in again")


def lasting_path(path: str, by_id: Path = _BY_ID) -> str:
    """Return the link in `by_id` that leads to the same device as `path`, else `path`.

    The kernel may give a replugged adapter another number (ttyUSB0 becomes ttyUSB1); the link, made of vendor, product
    and serial number, then leads to the new one.
    """
    try:
        device = Path(path).resolve(strict=True)
        links = sorted(link for link in by_id.iterdir() if link.resolve() == device)
    except (OSError, RuntimeError):
        return path
    return path if Path(path).parent == by_id or not links else str(links[0])


def _rate_refused(path: str, baud_rate: int, error: Exception) -> PortRateRefused:
    return PortRateRefused(
        path, f"{path} refuses {baud_rate} baud ({error}); choose a rate that adapter and scanner both have"
    )


def check_device_file(path: str) -> None:
    """Raise a PortError when `path` cannot be a serial port; nothing is opened."""
    if "\0" in path or not Path(path).is_absolute():
        raise PortNotSerial(path, f"{path!r} is no path of a serial device; give one such as /dev/ttyUSB0")
    try:
        mode = os.stat(path).st_mode  # noqa: PTH116 - follows links, as the opening will
    except OSError as error:
        raise _explain(path, error) from error
    if not stat.S_ISCHR(mode):
        raise PortNotSerial(path, f"{path} is not a serial device; give one such as /dev/ttyUSB0")


def _explain(path: str, error: OSError) -> PortError:
    """Return the error of this package for one of the system's."""
    number = error.errno
    if number is None and isinstance(error.__context__, termios.error):
        number = error.__context__.args[0]  # pyserial drops the number where the attributes cannot be read
    if number in _GONE:
        where = "plug the device in and check the path (`scanner devices` lists the ports there are)"
        return PortAbsent(path, f"{path} does not exist or is not connected; {where}")
    if number in {errno.EACCES, errno.EPERM}:
        return PortNotPermitted(path, f"you may not open {path}; {_remedy(path)}")
    if number in {errno.EAGAIN, errno.EBUSY}:
        return PortBusy(path, f"{path} is held by another program; close that program and try again")
    if number in {errno.ENOTTY, errno.EINVAL, errno.ENOTDIR, errno.ELOOP, errno.ENAMETOOLONG}:
        return PortNotSerial(path, f"{path} is not a serial device; give one such as /dev/ttyUSB0")
    return PortError(path, f"{path} could not be opened: {error}")


def _remedy(path: str) -> str:
    """Return what a user without permission can do: join the group that owns the device, by its name."""
    group = "dialout"
    with contextlib.suppress(OSError, KeyError):
        group = grp.getgrgid(os.stat(path).st_gid).gr_name  # noqa: PTH116
    if group == "root":
        return "its group is root, usually it is dialout: ask the administrator for a udev rule"
    return f"join the group {group} (sudo usermod -aG {group} $USER) and log in again"
