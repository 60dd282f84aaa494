"""A plain cloud through the live map: density and normals where there are no scanlines; knows no file."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from drivers.scanline import Float64Array, Scanline
from scanner_service.analysis.intake import QUANTUM_MM, quantise
from scanner_service.analysis.live_map import LiveMap
from scanner_service.analysis.map_settings import MapSettings
from scanner_service.analysis.radius import (
    FLEXIBLE_POINTS,
    GLOBAL_SHARE,
    flexible_radius_mm,
    sample_rows,
)
from scanner_service.analysis.snapshot import MapSnapshot, RadiusRule

CloudRule = Literal["fixed", "flexible", "global"]

TURNED_UP = "a plain cloud knows no laser: normals are turned upwards (+z)"


@dataclass(frozen=True, slots=True)
class CloudAnswer:
    """The map of a cloud, and what was decided on the way."""

    snapshot: MapSnapshot
    dropped: dict[str, int]
    notes: tuple[str, ...]


def analyse_cloud(
    points_mm: Float64Array,
    rule: CloudRule,
    *,
    radius_mm: float | None = None,
    uncertainty_mm: float = 0.1,
    max_radius_mm: float | None = None,
    seen_from_mm: Float64Array | None = None,
    noise_mm: float = 0.0,
    threads: int = 1,
) -> CloudAnswer:
    """Density, normals and reliability of a cloud (n, 3) without scanlines.

    Parameters
    ----------
    rule : `fixed` (one given `radius_mm`), `flexible` (each point grown to 20 points), `global` (the median of those of
        a repeatable 1 % sample).
    uncertainty_mm, max_radius_mm : bounds of a grown radius; 20 times the uncertainty by default.
    seen_from_mm : (3,) where normals are turned to; far above the cloud by default, which the notes say.

    Raises
    ------
    ValueError : no points, or a radius that is not positive.
    """
    if not len(points_mm):
        raise ValueError("the cloud holds no points, so there is nothing to analyse")
    if rule == "fixed" and not (radius_mm is not None and math.isfinite(radius_mm) and radius_mm > 0):
        raise ValueError(f"the rule `fixed` needs a radius greater than 0 mm, not {radius_mm}")
    limit_mm = 20.0 * uncertainty_mm if max_radius_mm is None else max_radius_mm
    notes: list[str] = []
    middle = np.round((points_mm.min(axis=0) + points_mm.max(axis=0)) / 2.0)
    if seen_from_mm is None:
        seen_from_mm = middle + np.array([0.0, 0.0, 1e6])
        notes.append(TURNED_UP)
    line = quantise(_as_line(points_mm, seen_from_mm), middle)
    stored_mm = line.xyz_q.astype(np.float64)
    rows = np.arange(len(line.index))
    radius: Float64Array
    if rule == "fixed":
        radius = np.full(len(rows), radius_mm)
    elif rule == "flexible":
        radius = flexible_radius_mm(stored_mm * QUANTUM_MM, rows, uncertainty_mm, limit_mm)
        notes.append(f"radius grown until {FLEXIBLE_POINTS} points are covered, at most {limit_mm:g} mm")
        notes += _at_the_limit(radius, limit_mm, "points")
    else:
        sample = sample_rows("cloud", 0, np.zeros(len(rows), dtype=np.int64), line.index.astype(np.int64))
        if not len(sample):
            sample = rows
            notes.append("the cloud is too small for a 1 % sample, so every point is in it")
        grown = flexible_radius_mm(stored_mm * QUANTUM_MM, sample, uncertainty_mm, limit_mm)
        notes += _at_the_limit(grown, limit_mm, "sampled points")
        one = float(np.median(grown))
        radius = np.full(len(rows), one)
        notes.append(f"global radius {one:.4f} mm: median of {len(sample)} points (1 in {GLOBAL_SHARE})")
    settings = MapSettings(
        noise_mm=noise_mm,
        max_radius_mm=0.0,  # the rule's radius stands: a cloud has no lines whose spacing could have misled it
        needs_lines=False,
        max_points=max(1024, len(points_mm)),
        threads=threads,
    )
    live_map = LiveMap(settings, middle)
    rules = {"fixed": RadiusRule.FIXED, "flexible": RadiusRule.FLEXIBLE, "global": RadiusRule.GLOBAL}
    accepted = live_map.add(line, radius, rules[rule])
    live_map.close_all_passes()
    snapshot = live_map.snapshot()
    live_map.close()
    if accepted.counted < 0.5 * len(points_mm):
        notes.append(
            f"only {accepted.counted} of {len(points_mm)} points count, the others crowd into cells of "
            f"{accepted.radius_mm:g} mm: is the unit of the file right, and the radius?"
        )
    return CloudAnswer(snapshot, {**line.dropped, **accepted.left_out}, tuple(notes))


def _at_the_limit(radius_mm: Float64Array, limit_mm: float, what: str) -> list[str]:
    """Say when a limit, and not the rule, gave radii."""
    count = int((radius_mm >= limit_mm).sum())
    if not count:
        return []
    return [
        f"{count} of {len(radius_mm)} {what} reach the limit of {limit_mm:g} mm before 20 points: allow a larger one"
    ]


def _as_line(points_mm: Float64Array, seen_from_mm: Float64Array) -> Scanline:
    """The cloud as one scanline of unknown travel; its line spacing stands for nothing."""
    return Scanline(
        device_id="cloud",
        boot_id=0,
        pass_index=0,
        line_index=0,
        device_time_s=0.0,
        points_mm=np.array(points_mm, dtype=np.float64),
        missing=np.zeros(len(points_mm), dtype=np.bool_),
        laser_mm=np.array(seen_from_mm, dtype=np.float64),
        plane_normal=np.full(3, np.nan),
        travel=np.full(3, np.nan),
        position_mm=math.nan,
        line_spacing_mm=1.0,
        step_mm=math.nan,
    )
