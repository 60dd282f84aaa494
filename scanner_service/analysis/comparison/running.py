"""The comparison itself: clouds, noise levels and methods crossed, one row each; clock and memory are lent to it."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from drivers.scanline import Float64Array
from scanner_service.analysis.comparison.noise import LEVELS, NoiseLevel, add_noise
from scanner_service.analysis.comparison.scoring import Score, score
from scanner_service.analysis.comparison.shapes import KnownCloud, Reference, sphere
from scanner_service.analysis.errors import AnalysisError
from scanner_service.analysis.normals.estimating import METHODS, estimate_normals
from scanner_service.analysis.normals.field import NormalOptions

Estimator = Callable[[Float64Array], Float64Array]
"""Points (n, 3) in mm to normals (n, 3), NaN where there is none."""


@dataclass(frozen=True, slots=True)
class Contestant:
    """A method in the comparison; with several settings the one with the least rms error counts, and is named.

    A method that chooses for itself has one setting, called `""`.
    """

    name: str
    settings: dict[str, Estimator]


@dataclass(frozen=True, slots=True)
class Row:
    """One method on one cloud at one noise level; time and memory are those of the setting that counts.

    `failure` is the sentence by which the method refused, and the score is then all NaN. `reference` says what the
    score is against: where that is the live map, angles are differences from it, not errors.
    """

    cloud: str
    points: int
    noise: NoiseLevel
    method: str
    setting: str
    score: Score
    seconds: float
    memory_bytes: float
    failure: str | None = None
    reference: Reference = "shape"


@dataclass(frozen=True, slots=True)
class Meter:
    """What a run cost: `measure(work)` returns the work's value, its seconds and the growth of memory at its peak."""

    measure: Callable[[Callable[[], Float64Array]], tuple[Float64Array, float, float]]


def our_methods(names: Sequence[str] | None = None) -> list[Contestant]:
    """The methods of METHODS, all or those named, each as it comes; every normal that is determined is given."""
    everything = NormalOptions(max_error_rad=math.inf)

    def estimator(name: str) -> Estimator:
        return lambda points: estimate_normals(points, name, everything).normals

    return [Contestant(name, {"": estimator(name)}) for name in (METHODS if names is None else names)]


def compare(
    clouds: Sequence[KnownCloud],
    contestants: Sequence[Contestant],
    meter: Meter,
    rng: np.random.Generator,
    *,
    levels: Sequence[NoiseLevel] = LEVELS,
    tell: Callable[[float, str], None] = lambda share, what: None,
) -> list[Row]:
    """Run every contestant on every cloud at every noise level; all meet the same noise.

    `tell` hears the share that is done and what comes next; first of all, what is compiled.
    """
    _warm_up(contestants, tell)
    rows: list[Row] = []
    total = len(clouds) * len(levels) * len(contestants)
    for cloud in clouds:
        for level in levels:
            points = add_noise(cloud.points_mm, level, rng)
            for contestant in contestants:
                tell(len(rows) / total, f"{cloud.name}, noise {level.label}: {contestant.name}")
                rows.append(_best(cloud, points, level, contestant, meter))
    tell(1.0, "done")
    return rows


def _best(cloud: KnownCloud, points: Float64Array, level: NoiseLevel, contestant: Contestant, meter: Meter) -> Row:
    """The row of the setting with the least rms error."""
    best: Row | None = None
    nothing = Score(math.nan, math.nan, math.nan, math.nan, len(points))
    for setting, estimator in contestant.settings.items():
        try:
            normals, seconds, memory = meter.measure(lambda estimator=estimator: estimator(points))  # type: ignore[misc]
            found, failure = score(normals, cloud.normals), None
        except AnalysisError as error:
            found, seconds, memory, failure = nothing, math.nan, math.nan, str(error)
        whose = (cloud.name, len(points), level, contestant.name, setting)
        row = Row(*whose, found, seconds, memory, failure, cloud.reference)
        if best is None or not row.score.rms_rad >= best.score.rms_rad:
            best = row
    assert best is not None, "a contestant has at least one setting"
    return best


def _warm_up(contestants: Sequence[Contestant], tell: Callable[[float, str], None]) -> None:
    """Compile what is to be compiled, outside of the measurement; the first time after an installation takes long."""
    points = sphere(200, np.random.default_rng(0)).points_mm
    for number, contestant in enumerate(contestants, start=1):
        tell(0.0, f"compiling {contestant.name}, {number} of {len(contestants)} (a minute in all, the first time only)")
        next(iter(contestant.settings.values()))(points)
