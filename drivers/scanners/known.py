"""The scanners this project can drive, by name: how each is opened, its usual baud rates, and who answers on a port.

A name here is what a rig file, the command line and an entry point may say. It knows no protocol itself.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

from drivers.errors import DriverError, DriverUnknown, PortError, ScannerError
from drivers.plugins import SCANNERS_GROUP, added, find_added
from drivers.protocols import lms_host, ls100_host, rplidar_host, scip_plan
from drivers.scanline import DeviceInfo
from drivers.scanners.face import FreeRunningScanner, Scanner
from drivers.scanners.lms import open_lms
from drivers.scanners.ls100 import open_ls100
from drivers.scanners.native import NativeScanner
from drivers.scanners.options import Value, options_from
from drivers.scanners.rplidar import open_rplidar
from drivers.scanners.scip import open_scip

Opener: TypeAlias = Callable[..., Scanner]
"""Called with a path and a rate, and with the options where there are any."""


@dataclass(frozen=True, slots=True)
class KnownScanner:
    """A kind of scanner.

    `baud_rates` are those worth trying, the likeliest first. `opens` makes a driver for a path and a rate; nothing is
    opened before its `enter`. `runs_free` tells a `FreeRunningScanner` from one that has a stage of its own. A driver
    that `tries_rates` begins with the given one and finds the others itself. `options` is the class of its options.
    """

    name: str
    title: str
    baud_rates: tuple[int, ...]
    opens: Opener
    runs_free: bool
    tries_rates: bool = True
    options: type[Any] | None = None


@dataclass(frozen=True, slots=True)
class Found:
    """What answered on a port: the kind of scanner, the rate it answered at and what it said of itself."""

    scanner: KnownScanner
    baud_rate: int
    info: DeviceInfo


KNOWN: dict[str, KnownScanner] = {
    known.name: known
    for known in (
        KnownScanner(
            "native", "a scanner of the native protocol", (3_000_000, 921_600, 115_200), NativeScanner, False, False
        ),
        KnownScanner(
            "scip",
            "Hokuyo lidar, SCIP 2.0 (URG, UBG, UHG, UTM)",
            scip_plan.RATES,
            open_scip,
            True,
            True,
            scip_plan.ScipOptions,
        ),
        KnownScanner(
            "rplidar",
            "Slamtec RPLIDAR (A, S and C series)",
            rplidar_host.RATES,
            open_rplidar,
            True,
            True,
            rplidar_host.RplidarOptions,
        ),
        KnownScanner(
            "lms200", "SICK LMS200, 211, 220, 221, 291", lms_host.RATES, open_lms, True, True, lms_host.LmsOptions
        ),
        KnownScanner(
            "ls100",
            "SICK Profiler 2, Optex FASTUS LS-100",
            ls100_host.RATES,
            open_ls100,
            True,
            True,
            ls100_host.Ls100Options,
        ),
    )
}


def known_scanner(name: str) -> KnownScanner:
    """The kind of that name, or one that another package adds; raises DriverUnknown naming those there are."""
    if name in KNOWN:
        return KNOWN[name]
    found = find_added(SCANNERS_GROUP, name, KnownScanner)
    if found is None:
        names = sorted({*KNOWN, *added(SCANNERS_GROUP)})
        raise DriverUnknown(f"there is no scanner {name!r}; the scanners are {', '.join(names)}")
    return found


def open_scanner(
    name: str, path: str, baud_rate: int | None = None, options: Mapping[str, Value] | None = None
) -> Scanner:
    """A driver for the scanner of that name on `path`, not yet entered.

    Without a rate it is the kind's likeliest one; `identify` finds the right one by trying. `options` are plain values,
    as a file has them; raises DriverError for those that the kind does not have.
    """
    known = known_scanner(name)
    rate = known.baud_rates[0] if baud_rate is None else baud_rate
    if not options:
        return known.opens(path, rate)
    if known.options is None:
        raise DriverError(f"scanner {name} has no option {next(iter(options))!r}; it has none")
    return known.opens(path, rate, options_from(known.options, options))


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
        to_try = known.baud_rates if rates is None else rates
        for rate in to_try[:1] if known.tries_rates else to_try:
            scanner = known.opens(path, rate)
            try:
                info = scanner.enter()
                return Found(known, getattr(scanner, "baud_rate", None) or rate, info)
            except PortError:
                raise
            except ScannerError:
                continue
            finally:
                scanner.exit()
    return None
