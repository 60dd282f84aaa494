"""Which passes together bring most for their time: one after the other, each the best there is for what is left.

Greedy by gain per second (a cover within 1 - 1/e of the best, Nemhauser, Wolsey and Fisher 1978), over attitudes
judged roughly by the open sky of each place and then exactly, ray by ray, for the best of them and their neighbours.
"""

import math
from dataclasses import dataclass

import numpy as np

from drivers.scanline import BoolArray, Float64Array, Pose
from scanner_service.rescan.passes.errors import PassOutOfReach
from scanner_service.rescan.passes.gain import MARGIN, SERVED, Prospect, prospect_of
from scanner_service.rescan.passes.known_surface import KnownSurface
from scanner_service.rescan.passes.motion import Motion, StraightMotion
from scanner_service.rescan.passes.needs import Needs
from scanner_service.rescan.passes.optics import ScannerOptics
from scanner_service.rescan.passes.reach import Attitude, Reach
from scanner_service.rescan.passes.stretch import Stretch, best_stretch
from scanner_service.rescan.passes.visibility import OpenSky

ROUGH = 80
"""So many of the attitudes that see most are looked at for where to hold them."""
EXACT = 10
"""So many of the roughly best are judged exactly, and the winner's neighbours after them."""
_LEAST_PASS_S = 1.0  # no pass takes less, whatever it serves
_ENDLESS = (-math.inf, math.inf)


@dataclass(frozen=True, slots=True)
class Choice:
    """A pass chosen: its attitude, motion and stretch, with the exact prospect, and which needs it serves."""

    attitude: Attitude
    motion: Motion
    stretch: Stretch
    prospect: Prospect
    served: BoolArray


@dataclass(frozen=True, slots=True)
class Candidate:
    """An attitude with a place for it, and what it seems to be worth for its time."""

    attitude: Attitude
    motion: Motion
    worth_per_s: float


class Cover:
    """The search for passes over one set of needs; what was chosen takes its gain away from the rest."""

    def __init__(
        self,
        surface: KnownSurface,
        needs: Needs,
        sky: OpenSky,
        reach: Reach,
        optics: ScannerOptics,
        least_mm2: float = 0.0,
    ) -> None:
        self._surface, self._needs, self._sky, self._reach, self._optics = surface, needs, sky, reach, optics
        self._least_mm2 = least_mm2
        self._middle_mm = surface.points_mm.mean(axis=0) if len(surface.points_mm) else np.zeros(3)
        self.attitudes = reach.attitudes(self._middle_mm)
        self.left_mm2 = needs.gain_mm2.copy()
        self._least_cosine = np.cos(np.minimum(optics.limit_rad(needs.thin), needs.incidence_rad))
        self._visible: BoolArray = np.array([self._roughly_seen(attitude) for attitude in self.attitudes])
        self.reachable: BoolArray = np.asarray(self._visible.any(axis=0))

    def next(self, standing: Pose | None) -> Choice | None:
        """The best pass for what is left that brings enough; None when there is none."""
        ranked: list[Candidate] = []
        for number in self._promising(standing):
            ranked += self._rough(self.attitudes[number], self._visible[number], standing)
        ranked.sort(key=lambda one: -one.worth_per_s)
        best: Choice | None = None
        for candidate in ranked[:EXACT]:
            best = self._better(best, self._exact(candidate.attitude, candidate.motion, standing))
        if best is None:
            return None
        for attitude in self._reach.near(best.attitude):
            seen = self._roughly_seen(attitude)
            for candidate in self._rough(attitude, seen, standing)[:1]:
                best = self._better(best, self._exact(attitude, candidate.motion, standing)) or best
        self.left_mm2[best.served] = 0.0
        return best

    def _promising(self, standing: Pose | None) -> list[int]:
        """The attitudes that see most for the time it takes to get there, those that see nothing left out."""
        gain = self._visible @ self.left_mm2
        way = np.array([self._reach.seconds_between(standing, self._held(one), one.turn) for one in self.attitudes])
        order = np.argsort(-gain / (_LEAST_PASS_S + way), kind="stable")
        return [int(number) for number in order[:ROUGH] if gain[number] > 0]

    def _held(self, attitude: Attitude) -> Pose:
        """A pose in this attitude, as far as it is known before there is a place for it."""
        if attitude.motion is not None:
            return attitude.motion.part_from_sensor(0.0)
        return Pose(attitude.rotation.copy(), self._middle_mm.copy())

    def _better(self, one: Choice | None, other: Choice | None) -> Choice | None:
        if one is None or other is None:
            return one or other
        return other if other.stretch.gain_per_s > one.stretch.gain_per_s else one

    def _roughly_seen(self, attitude: Attitude) -> BoolArray:
        """(n,) which needs an attitude sees, laser and camera taken as far away."""
        needs, geometry = self._needs, self._optics.geometry
        if attitude.motion is not None:
            found = prospect_of(self._surface, needs, attitude.motion, self._optics)
            inside = (found.position_mm >= self._travel[0]) & (found.position_mm <= self._travel[1])
            return np.asarray((found.coarsest_mm >= self._reach.line_spacing_mm[0]) & inside)
        laser = attitude.rotation @ (geometry.laser_mm / np.linalg.norm(geometry.laser_mm))
        camera = attitude.rotation @ (geometry.camera_mm / np.linalg.norm(geometry.camera_mm))
        seen: BoolArray = (
            (needs.normals @ laser >= self._least_cosine)
            & (needs.normals @ camera >= math.cos(self._optics.max_camera_rad))
            & self._sky.along(laser)
            & self._sky.along(camera)
        )
        return seen

    @property
    def _travel(self) -> tuple[float, float]:
        return self._reach.limits.travel_mm

    def _rough(self, attitude: Attitude, seen: BoolArray, standing: Pose | None) -> list[Candidate]:
        """Where to hold an attitude, best first: each lane of the field of view, at the depth of most of the gain."""
        if attitude.motion is not None:
            return [Candidate(attitude, attitude.motion, float(self.left_mm2[seen].sum()) / self._turning_s(attitude))]
        rows = np.flatnonzero(seen & (self.left_mm2 > 0))
        if not len(rows):
            return []
        optics, rotation = self._optics, attitude.rotation
        local = self._needs.places_mm[rows] @ rotation
        gain = self.left_mm2[rows]
        low, high = optics.geometry.range_mm
        width = 0.92 * optics.field_of_view_mm * float(optics.widening(np.array([0.5 * high]))[0])
        # points for a mm of line and travel, were the sensor straight above
        density = (self._needs.normals[rows] @ rotation[:, 2]) / optics.point_spacing_mm(np.zeros(len(rows)))
        coarsest = density / (MARGIN * self._needs.density_per_mm2[rows])
        found = []
        for centre in _lanes(local[:, 0], gain, width):
            lane = np.abs(local[:, 0] - centre) <= 0.5 * width
            depth = _depth(local[lane, 2], gain[lane], 0.94 * (high - low)) - 0.5 * (low + high)
            lane &= (local[:, 2] - depth >= low) & (local[:, 2] - depth <= high)
            if not lane.any():
                continue
            motion = StraightMotion(
                Pose(rotation.copy(), rotation @ np.array([centre - optics.middle_mm, 0.0, depth])),
                rotation[:, 1].copy(),
            )
            way = self._reach.seconds_between(standing, motion.part_from_sensor(float(local[lane, 1].mean())))
            stretch = best_stretch(
                local[lane, 1], coarsest[lane], gain[lane], self._reach.line_spacing_mm, _ENDLESS,
                self._reach.seconds_each, way, self._least_mm2,
            )  # fmt: skip
            if stretch is not None:
                found.append(Candidate(attitude, motion, stretch.gain_per_s))
        found.sort(key=lambda one: -one.worth_per_s)
        return found

    def _turning_s(self, attitude: Attitude) -> float:
        turned = attitude.turn is not None and not attitude.turn.is_none
        return 10.0 + (self._reach.turn_part_s if turned else 0.0)

    def _exact(self, attitude: Attitude, motion: Motion, standing: Pose | None) -> Choice | None:
        prospect = prospect_of(self._surface, self._needs, motion, self._optics)
        is_free = attitude.motion is None
        way = self._reach.seconds_between(standing, motion.part_from_sensor(self._middle(prospect)), attitude.turn)
        stretch = best_stretch(
            prospect.position_mm, prospect.coarsest_mm, self.left_mm2, self._reach.line_spacing_mm,
            _ENDLESS if is_free else self._travel, self._reach.seconds_each, way,
            self._least_mm2,
        )  # fmt: skip
        if stretch is None:
            return None
        try:
            self._reach.check(motion, stretch.start_mm, stretch.end_mm, stretch.line_spacing_mm)
        except PassOutOfReach:
            return None
        # the margin is for choosing; what reaches the density with less of it is a gain as well
        served = stretch.serves(prospect.position_mm, MARGIN / SERVED * prospect.coarsest_mm) & (self.left_mm2 > 0)
        return Choice(attitude, motion, stretch, prospect, served)

    def _middle(self, prospect: Prospect) -> float:
        useful = (prospect.coarsest_mm > 0) & (self.left_mm2 > 0)
        return float(prospect.position_mm[useful].mean()) if useful.any() else 0.0


def _lanes(x_mm: Float64Array, gain: Float64Array, width_mm: float) -> list[float]:
    """Middles of lanes of a width across places: one when they fit, else by half widths."""
    low, high = float(x_mm.min()), float(x_mm.max())
    if high - low <= width_mm:
        return [0.5 * (low + high)]
    count = math.ceil((high - low - width_mm) / (0.5 * width_mm)) + 1
    return [float(x) for x in np.linspace(low + 0.5 * width_mm, high - 0.5 * width_mm, count)]


def _depth(z_mm: Float64Array, gain: Float64Array, span_mm: float) -> float:
    """Middle of the window of a span that holds most of the gain."""
    low, high = float(z_mm.min(initial=np.inf)), float(z_mm.max(initial=-np.inf))
    if not low <= high:
        return 0.0
    if high - low <= span_mm:
        return 0.5 * (low + high)
    middles = np.linspace(low + 0.5 * span_mm, high - 0.5 * span_mm, 9)
    held = [float(gain[np.abs(z_mm - middle) <= 0.5 * span_mm].sum()) for middle in middles]
    return float(middles[int(np.argmax(held))])
