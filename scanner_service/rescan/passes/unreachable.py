"""Which of the needs no attitude of the rig can bring, and why; plans nothing."""

import math
from collections.abc import Sequence

import numpy as np

from drivers.scanline import BoolArray
from scanner_service.rescan.passes.needs import Needs
from scanner_service.rescan.passes.optics import ScannerOptics
from scanner_service.rescan.passes.reach import Attitude
from scanner_service.rescan.passes.recommendation import Unreachable
from scanner_service.rescan.passes.tried import TRIES
from scanner_service.rescan.passes.visibility import OpenSky
from scanner_service.rescan.region import RescanRegion

_ALL = 0.98
"""Share of what is wanted of a region that is out of reach, from which on nothing of it can be brought."""

Whys = np.ndarray[tuple[int], np.dtype[np.object_]]


def unreachable(
    needs: Needs,
    reachable: BoolArray,
    attitudes: tuple[Attitude, ...],
    sky: OpenSky,
    optics: ScannerOptics,
    given_up: Needs,
    regions: Sequence[RescanRegion],
) -> tuple[Unreachable, ...]:
    """What no attitude sees, and what passes were to see in vain, by region and reason, the largest first.

    Parameters
    ----------
    reachable : (n,) those of the `needs` that some attitude sees.
    given_up : further needs, that were promised in vain so often that they are not wanted any more.
    regions : of a region the share of its needs that are out of reach is told as that share of its area, so that the
        parts of one region never add up to more than it; surface outside of any is told as large as it is guessed.
    """
    if reachable.all() and not len(given_up):
        return ()
    region = np.concatenate([needs.region, given_up.region])
    area_mm2 = np.concatenate([needs.area_mm2, given_up.area_mm2])
    in_vain = f"{TRIES} passes that should have seen it brought no returns"
    why = np.concatenate([_why(needs, attitudes, sky, optics), np.full(len(given_up), in_vain, dtype=object)])
    missing = np.concatenate([~reachable, np.ones(len(given_up), dtype=np.bool_)])
    known_mm2 = {one.number: one.area_mm2 for one in regions}
    found = []
    for number in np.unique(region[missing]).tolist():
        of_region = region == number
        whole_mm2 = float(area_mm2[of_region].sum())
        for reason in sorted(set(why[missing & of_region])):
            share = float(area_mm2[missing & of_region & (why == reason)].sum()) / whole_mm2
            found.append(Unreachable(number, share * known_mm2.get(number, whole_mm2), share, str(reason)))
    return tuple(sorted(found, key=lambda one: -one.area_mm2))


def _why(needs: Needs, attitudes: tuple[Attitude, ...], sky: OpenSky, optics: ScannerOptics) -> Whys:
    """(n,) why each need is out of reach, if it is."""
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
    return why


def lost_regions(found: tuple[Unreachable, ...]) -> dict[int, str]:
    """Regions of which nothing can be brought, each with the reason that holds for most of it."""
    shares: dict[int, float] = {}
    whys: dict[int, str] = {}
    for one in sorted(found, key=lambda one: one.area_mm2):
        shares[one.region] = shares.get(one.region, 0.0) + one.share
        whys[one.region] = one.why
    return {region: whys[region] for region, share in shares.items() if region and share >= _ALL}
