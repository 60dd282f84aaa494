"""Which of the needs no attitude of the rig can bring, and why; plans nothing."""

import math

import numpy as np

from drivers.scanline import BoolArray
from scanner_service.rescan.passes.needs import Needs
from scanner_service.rescan.passes.optics import ScannerOptics
from scanner_service.rescan.passes.reach import Attitude
from scanner_service.rescan.passes.recommendation import Unreachable
from scanner_service.rescan.passes.tried import TRIES
from scanner_service.rescan.passes.visibility import OpenSky

_ALL = 0.98
"""Share of what is wanted of a region that is out of reach, from which on nothing of it can be brought."""

Whys = np.ndarray[tuple[int], np.dtype[np.object_]]


def unreachable(
    needs: Needs, reachable: BoolArray, attitudes: tuple[Attitude, ...], sky: OpenSky, optics: ScannerOptics
) -> tuple[Unreachable, ...]:
    """The needs that no attitude sees, by region and reason; `reachable` (n,) are those that one sees."""
    missing = ~reachable
    if not missing.any():
        return ()
    why = np.full(len(needs), "no pass within the rig's limits reaches it with laser and camera", dtype=object)
    faced, lit = np.zeros(len(needs), dtype=np.bool_), np.zeros(len(needs), dtype=np.bool_)
    laser = optics.geometry.laser_mm / np.linalg.norm(optics.geometry.laser_mm)
    least_cosine = np.cos(optics.limit_rad(needs.thin))
    for attitude in attitudes:
        direction = attitude.rotation @ laser
        facing = needs.normals @ direction >= least_cosine
        faced |= facing
        lit |= facing & sky.along(direction)
    degrees = math.degrees(optics.max_incidence_rad)
    why[~faced] = f"the rig cannot face it within {degrees:.0f}° of its normal"
    why[faced & ~lit] = "the part itself hides it from the laser wherever the rig can stand"
    why[faced & lit] = "where the laser reaches it, the part hides it from the camera or the rig ends"
    return _by_region(needs, needs, missing, why)


def in_vain(given_up: Needs, needs: Needs) -> tuple[Unreachable, ...]:
    """The needs that were given up, by region; `needs` are those that were not."""
    why = np.full(len(given_up), f"{TRIES} passes that should have seen it brought no returns", dtype=object)
    return _by_region(given_up, needs, np.ones(len(given_up), dtype=np.bool_), why)


def lost_regions(found: tuple[Unreachable, ...]) -> dict[int, str]:
    """Regions of which nothing can be brought, each with the reason that holds for most of it."""
    shares: dict[int, float] = {}
    whys: dict[int, str] = {}
    for one in sorted(found, key=lambda one: one.area_mm2):
        shares[one.region] = shares.get(one.region, 0.0) + one.share
        whys[one.region] = one.why
    return {region: whys[region] for region, share in shares.items() if region and share >= _ALL}


def _by_region(needs: Needs, others: Needs, which: BoolArray, why: Whys) -> tuple[Unreachable, ...]:
    found = []
    for region in np.unique(needs.region[which]):
        of_region = needs.region == region
        whole = float(needs.area_mm2[of_region].sum())
        if others is not needs:
            whole += float(others.area_mm2[others.region == region].sum())
        for reason in sorted(set(why[which & of_region])):
            area = float(needs.area_mm2[which & of_region & (why == reason)].sum())
            found.append(Unreachable(int(region), area, area / whole, str(reason)))
    found.sort(key=lambda one: -one.area_mm2)
    return tuple(found)
