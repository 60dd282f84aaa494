"""A serial port on this machine: exclusive, non-blocking, with errors that say what to do; the only user of pyserial.

It opens device files only: what a user writes is never taken for a URL. It knows no protocol.
"""

import contextlib
import errno
import grp
import os
import select
import stat
import termios
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

_READ_BYTES = 65_536
_GONE = {errno.ENOENT, errno.ENXIO, errno.ENODEV, errno.EIO}


class Port:
    """An open tty, locked against a second opening by any program that asks for the lock.

    Raises
    ------
    PortAbsent, PortBusy, PortNotPermitted, PortNotSerial, PortRateRefused : when it cannot be opened.
    """

    def __init__(self, path: str, baud_rate: int) -> None:
        self.path = path
        _check_device_file(path)
        try:
            self._serial = serial.Serial(path, baud_rate, timeout=0, write_timeout=0, exclusive=True)
        except ValueError as error:
            raise PortRateRefused(
                path, f"{path} refuses {baud_rate} baud ({error}); choose a rate that adapter and scanner both have"
            ) from error
        except OSError as error:  # SerialException is one
            raise _explain(path, error) from error
        self._fd: int = self._serial.fileno()
        # Where the adapter has no such switch it stays as it is: a matter of latency, not of right or wrong.
        with contextlib.suppress(ValueError, OSError, NotImplementedError):
            self._serial.set_low_latency_mode(True)

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
        except BlockingIOError:
            return b""
        except (OSError, ValueError) as error:
            raise self._lost(error) from error
        if not data:
            raise self._lost(None)
        return data

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

    def close(self) -> None:
        """Close at once; bytes still to be sent are discarded, or closing could wait for a dead line for ever."""
        with contextlib.suppress(OSError, termios.error):
            termios.tcflush(self._fd, termios.TCOFLUSH)
        self._serial.close()

    def _lost(self, error: Exception | None) -> PortLost:
        detail = f" ({error})" if error is not None else ""
        return PortLost(self.path, f"{self.path} was pulled out or hung up{detail}; plug it in again")


def _check_device_file(path: str) -> None:
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
        return PortAbsent(path, f"{path} does not exist or is not connected; plug the scanner in and check the path")
    if number in {errno.EACCES, errno.EPERM}:
        return PortNotPermitted(path, f"you may not open {path}; {_remedy(path)}")
    if number in {errno.EAGAIN, errno.EBUSY}:
        return PortBusy(path, f"{path} is held by another program; close that program and try again")
    if number in {errno.ENOTTY, errno.EINVAL, errno.ENOTDIR, errno.ELOOP, errno.ENAMETOOLONG}:
        return PortNotSerial(path, f"{path} is not a serial device ({error}); give one such as /dev/ttyUSB0")
    return PortError(path, f"{path} could not be opened: {error}")


def _remedy(path: str) -> str:
    """Return what a user without permission can do: join the group that owns the device, by its name."""
    group = "dialout"
    with contextlib.suppress(OSError, KeyError):
        group = grp.getgrgid(os.stat(path).st_gid).gr_name  # noqa: PTH116
    if group == "root":
        return "its group is root, usually it is dialout: ask the administrator for a udev rule"
    return f"join the group {group} (sudo usermod -aG {group} $USER) and log in again"
