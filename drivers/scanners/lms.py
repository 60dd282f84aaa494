"""SICK LMS200, 211, 220, 221 and 291 on RS-232 or RS-422: the conversation of their telegrams on a port."""

from functools import partial

from drivers.protocols.lms_host import RATES, LmsHost, LmsOptions
from drivers.scanners.free_running import FreeRunner


def open_lms(path: str, baud_rate: int = RATES[0], options: LmsOptions | None = None) -> FreeRunner:
    """A driver for the scanner on `path`, not yet entered; tries `baud_rate` first and then its other rates."""
    rates = tuple(dict.fromkeys((baud_rate, *RATES)))
    return FreeRunner(path, partial(LmsHost, rates=rates, options=options))
