"""Slamtec RPLIDARs (A, S and C series) behind their USB adapter: the conversation of their protocol on a port."""

from functools import partial

from drivers.port import ModemLines
from drivers.protocols.rplidar_host import RATES, RplidarHost, RplidarOptions
from drivers.scanners.free_running import FreeRunner


def open_rplidar(path: str, baud_rate: int = RATES[0], options: RplidarOptions | None = None) -> FreeRunner:
    """A driver for the lidar on `path`, not yet entered; tries `baud_rate` first and then the other models' rates.

    DTR is set before the port is opened, and kept when it is closed: an A1's motor rests until profiles are wanted.
    """
    rates = tuple(dict.fromkeys((baud_rate, *RATES)))
    lines = ModemLines(dtr=True, hang_up=False)
    return FreeRunner(path, partial(RplidarHost, rates=rates, options=options), lines=lines)
