"""SICK Profiler 2 and Optex FASTUS LS-100 on RS-485: the conversation of their protocol on a port."""

from functools import partial

from drivers.protocols.ls100_host import RATES, Ls100Host, Ls100Options
from drivers.scanners.free_running import FreeRunner


def open_ls100(path: str, baud_rate: int = RATES[0], options: Ls100Options | None = None) -> FreeRunner:
    """A driver for the sensor on `path`, not yet entered; tries `baud_rate` first, then its other rates."""
    rates = tuple(dict.fromkeys((baud_rate, *RATES)))
    return FreeRunner(path, partial(Ls100Host, rates=rates, options=options))
