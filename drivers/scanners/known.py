"""The scanners this project can drive, by name: how each is opened, its usual baud rates, and who answers on a port.

A name here is what a rig file, the command line and an entry point may say. It knows no protocol itself.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TypeAlias

from drivers.errors import DriverError, PortError, ScannerError
from drivers.scanline import DeviceInfo
from drivers.scanners.face import FreeRunningScanner, Scanner
from drivers.scanners.native import NativeScanner

Opener: TypeAlias = Callable[[str, int], Scanner]


@dataclass(frozen=True, slots=True)
class KnownScanner:
    """A kind of scanner.

    `baud_rates` are those worth trying, the likeliest first. `opens` makes a driver for a path and a rate; nothing is
    opened before its `enter`. `runs_free` tells a `FreeRunningScanner` from one that has a stage of its own.
    """

    name: str
    title: str
    baud_rates: tuple[int, ...]
    opens: Opener
    runs_free: bool


@dataclass(frozen=True, slots=True)
class Found:
    """What answered on a port: the kind of scanner, the rate it answered at and what it said of itself."""

    scanner: KnownScanner
    baud_rate: int
    info: DeviceInfo


KNOWN: dict[str, KnownScanner] = {
    known.name: known
    for known in (
        KnownScanner("native", "a scanner of the native protocol", (3_000_000, 921_600, 115_200), NativeScanner, False),
    )
}


def known_scanner(name: str) -> KnownScanner:
    """The kind of that name; raises DriverError naming those there are."""
    if name not in KNOWN:
        raise DriverError(f"there is no scanner {name!r}; the scanners are {', '.join(sorted(KNOWN))}")
    return KNOWN[name]


def open_scanner(name: str, path: str, baud_rate: int | None = None) -> Scanner:
    """A driver for the scanner of that name on `path`, not yet entered.

    Without a rate it is the kind's likeliest one; `identify` finds the right one by trying.
    """
    known = known_scanner(name)
    return known.opens(path, known.baud_rates[0] if baud_rate is None else baud_rate)


def open_free_running(name: str, path: str, baud_rate: int | None = None) -> FreeRunningScanner:
    """As `open_scanner`, for one without a stage of its own; raises DriverError for one that has."""
    scanner = open_scanner(name, path, baud_rate)
    if not known_scanner(name).runs_free:
        raise DriverError(f"a scanner of kind {name} has a stage of its own and runs passes; it cannot run free")
    return scanner  # type: ignore[return-value]  # `runs_free` says so


def identify(path: str, names: Iterable[str] | None = None, baud_rates: Iterable[int] | None = None) -> Found | None:
    """Try the scanners of these names (all of them) at their rates (or at these); return the first that answers.

    Nothing is left running: each attempt is entered and exited.

    Raises
    ------
    PortError : when the port itself cannot be used; another rate or kind would not help.
    """
    rates = None if baud_rates is None else tuple(baud_rates)
    for name in KNOWN if names is None else names:
        known = known_scanner(name)
        for rate in known.baud_rates if rates is None else rates:
            scanner = known.opens(path, rate)
            try:
                return Found(known, rate, scanner.enter())
            except PortError:
                raise
            except ScannerError:
                continue
            finally:
                scanner.exit()
    return None
