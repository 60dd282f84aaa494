"""One recommended pass as it is told: where, how, how long, what for and with what result to expect; plans none."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from drivers.rig_limits import lines_between
from drivers.scanline import BoolArray, Float64Array, Pose, read_only
from scanner_service.rescan.passes.motion import Motion, StraightMotion
from scanner_service.rescan.passes.needs import UNSEEN
from scanner_service.rescan.passes.promises import (
    NO_EXPERIENCE,
    Expectation,
    Experience,
    expectation_of,
    promised_places,
)
from scanner_service.rescan.passes.reach import PartTurn


@dataclass(frozen=True, slots=True)
class Promise:
    """What a pass is expected to give one region: area, median density, median and largest incidence.

    `region` is the region's number in the report planned from, UNSEEN for surface that no region has found yet.
    """

    region: int
    gain_mm2: float
    density_per_mm2: float
    incidence_rad: float
    largest_incidence_rad: float

    def to_dict(self) -> dict[str, object]:
        """For JSON; angles in degrees."""
        return {
            "region": None if self.region == UNSEEN else self.region,
            "gain_mm2": self.gain_mm2,
            "density_per_mm2": self.density_per_mm2,
            "incidence_deg": math.degrees(self.incidence_rad),
            "largest_incidence_deg": math.degrees(self.largest_incidence_rad),
        }


@dataclass(frozen=True, slots=True)
class RecommendedPass:
    """A pass that can be carried out: the motion from `start_mm` to `end_mm`, lines `line_spacing_mm` apart.

    `duration_s` is the time of the pass itself, `approach_s` the time to get there (turning the part included);
    `promises` what is counted on region by region when passes are chosen; `gain_mm2` their sum. `places_mm` (k, 3) are
    the places served, `place_regions` (k,) their regions, `place_evidence` (k,) why they are believed in,
    `place_area_mm2` (k,) their areas, `place_mm2` (k,) what of these is counted on, `place_normals` (k, 3) where they
    face, and `place_tried` (k,) where passes were in vain; they are kept for the reckoning afterwards. `turn` is what
    the operator does first; `learned` is what earlier passes taught, by which the areas were multiplied.
    """

    number: int
    motion: Motion
    start_mm: float
    end_mm: float
    line_spacing_mm: float
    line_rate_hz: float
    duration_s: float
    approach_s: float
    promises: tuple[Promise, ...]
    places_mm: Float64Array
    place_regions: Float64Array
    place_mm2: Float64Array
    place_area_mm2: Float64Array
    place_evidence: Float64Array
    place_normals: Float64Array
    place_tried: BoolArray
    turn: PartTurn | None = None
    learned: Experience = NO_EXPERIENCE

    def __post_init__(self) -> None:
        for array in (
            self.places_mm, self.place_regions, self.place_mm2, self.place_area_mm2, self.place_evidence,
            self.place_normals, self.place_tried,
        ):  # fmt: skip
            read_only(array)

    @property
    def gain_mm2(self) -> float:
        """Surface that is to meet the requirement afterwards and does not now."""
        return sum(promise.gain_mm2 for promise in self.promises)

    @property
    def told_mm2(self) -> Float64Array:
        """(k,) what is expected of each place served."""
        return self.learned.told_mm2(self.place_mm2, self.place_evidence)

    @property
    def told(self) -> tuple[Promise, ...]:
        """What is expected region by region, most first; together what is promised and what is explored."""
        told_mm2, found = self.told_mm2, []
        for promise in self.promises:
            mine = self.place_regions == promise.region
            counted_mm2 = float(self.place_mm2[mine].sum())
            more = float(told_mm2[mine].sum()) / counted_mm2 if counted_mm2 > 0.0 else 1.0
            found.append(replace(promise, gain_mm2=more * promise.gain_mm2))
        return tuple(sorted(found, key=lambda one: -one.gain_mm2))

    @property
    def is_promised(self) -> BoolArray:
        """(k,) the places served that are promised; what of the others is there is too unsure: they are explored."""
        return promised_places(
            self.told_mm2, self.place_area_mm2, self.place_evidence, self.place_tried, self.learned
        )  # fmt: skip

    @property
    def promised(self) -> Expectation:
        """What of the gain is promised."""
        return self._expected(self.is_promised)

    @property
    def explores(self) -> Expectation:
        """What of the gain is expected where much more, or nothing, may be found."""
        return self._expected(~self.is_promised)

    def _expected(self, places: BoolArray) -> Expectation:
        return expectation_of(
            self.told_mm2[places], self.place_area_mm2[places], self.place_evidence[places],
            self.place_tried[places], self.learned,
        )  # fmt: skip

    @property
    def line_count(self) -> int:
        """Lines, both ends included."""
        return lines_between(self.start_mm, self.end_mm, self.line_spacing_mm)

    @property
    def start_pose(self) -> Pose:
        """part_from_sensor at the first line."""
        return self.motion.part_from_sensor(self.start_mm)

    @property
    def end_pose(self) -> Pose:
        """part_from_sensor at the last line."""
        return self.motion.part_from_sensor(self.end_mm)

    @property
    def direction(self) -> Float64Array:
        """(3,) unit direction in which the sensor goes at the start, part frame."""
        if isinstance(self.motion, StraightMotion):
            return self.motion.travel * math.copysign(1.0, self.end_mm - self.start_mm)
        around = np.cross(self.motion.axis, self.start_pose.translation_mm)
        return np.asarray(around / max(float(np.linalg.norm(around)), 1e-12), dtype=np.float64)

    def to_dict(self) -> dict[str, object]:
        """For JSON; what a person or a rig needs to carry it out."""
        promised, explores = self.promised, self.explores
        told_mm2 = promised.mm2 + explores.mm2
        return {
            "number": self.number,
            "start_mm": self.start_mm,
            "end_mm": self.end_mm,
            "line_spacing_mm": self.line_spacing_mm,
            "line_rate_hz": self.line_rate_hz,
            "lines": self.line_count,
            "duration_s": self.duration_s,
            "approach_s": self.approach_s,
            "speed_mm_per_s": self.line_rate_hz * self.line_spacing_mm,
            "start_pose": pose_dict(self.start_pose),
            "end_pose": pose_dict(self.end_pose),
            "direction": self.direction.tolist(),
            "laser_direction": (-self.start_pose.rotation[:, 2]).tolist(),
            "turn_part": None if self.turn is None or self.turn.is_none else str(self.turn),
            "turn_about_mm": None if self.turn is None or self.turn.about_mm is None else list(self.turn.about_mm),
            "gain_mm2": told_mm2,
            "promised_mm2": promised.mm2,
            "promised_between_mm2": promised.between_mm2,
            "explores_mm2": explores.mm2,
            "explores_between_mm2": explores.between_mm2,
            "gain_per_s_mm2": told_mm2 / (self.duration_s + self.approach_s),
            "serves": [promise.to_dict() for promise in self.told],
        }


@dataclass(frozen=True, slots=True)
class Unreachable:
    """Surface of one region that no pass within the limits can bring, and why.

    `share` of what is wanted of the region, and `area_mm2` that share of its area: a region whose surface is out of
    reach for several reasons has several, and what they leave of it can be reached. Surface outside of any region
    (UNSEEN) is told as large as it is guessed where hidden space begins.
    """

    region: int
    area_mm2: float
    share: float
    why: str

    def to_dict(self) -> dict[str, object]:
        """For JSON."""
        region = None if self.region == UNSEEN else self.region
        return {"region": region, "area_mm2": self.area_mm2, "share": self.share, "why": self.why}


@dataclass(frozen=True, slots=True)
class Plan:
    """Recommended passes of one version of the map, the best for its time first, and what none of them can bring.

    `needed_mm2` is all that is still wanted, `promised_mm2` what the listed passes promise of it.
    `reachable_regions` are those of which some pose sees something; `lost_regions` those of which nothing can be
    brought, with the reason.
    """

    version: int
    passes: tuple[RecommendedPass, ...]
    unreachable: tuple[Unreachable, ...]
    needed_mm2: float
    reachable_regions: frozenset[int] = frozenset()
    lost_regions: Mapping[int, str] = field(default_factory=dict)

    @property
    def promised_mm2(self) -> float:
        """What the listed passes promise together."""
        return sum(one.promised.mm2 for one in self.passes)

    def to_dict(self) -> dict[str, object]:
        """For JSON."""
        return {
            "version": self.version,
            "needed_mm2": self.needed_mm2,
            "promised_mm2": self.promised_mm2,
            "explores_mm2": sum(one.explores.mm2 for one in self.passes),
            "passes": [one.to_dict() for one in self.passes],
            "unreachable": [one.to_dict() for one in self.unreachable],
        }


def pose_dict(pose: Pose) -> dict[str, object]:
    """A pose for JSON: rows of the rotation, and the translation."""
    return {"rotation": pose.rotation.tolist(), "translation_mm": pose.translation_mm.tolist()}
