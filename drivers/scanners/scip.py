"""Hokuyo lidars (URG, UBG, UHG, UTM) on RS-232 or USB: the conversation of SCIP 2.0 on a port."""

from functools import partial

from drivers.protocols.scip_host import ScipHost
from drivers.protocols.scip_plan import RATES, ScipOptions
from drivers.scanners.free_running import FreeRunner


def open_scip(path: str, baud_rate: int = RATES[0], options: ScipOptions | None = None) -> FreeRunner:
    """A driver for the lidar on `path`, not yet entered; tries `baud_rate` first and then the other rates of SCIP."""
    rates = tuple(dict.fromkeys((baud_rate, *RATES)))
    return FreeRunner(path, partial(ScipHost, rates=rates, options=options))
