"""The law of a map that grows: regions found again and again are those found from nothing, after any lines."""

from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from drivers.scanline import Scanline, SensorGeometry
from scanner_service.analysis.intake import StoredLine, quantise
from scanner_service.analysis.live_map import LiveMap
from scanner_service.analysis.map_settings import MapSettings
from scanner_service.rescan.coverage import CoverageBook, observed_coverage
from scanner_service.rescan.judgement import Reason
from scanner_service.rescan.regions import RegionFinder, find_regions
from scanner_service.rescan.requirement import Interest, Requirement
from scanner_service.sessions.mirror import Mirror
from tests.unit.rescan.synthetic_scan import Height

GEOMETRY = SensorGeometry(np.array([0.0, 0.0, 100.0]), np.array([0.0, 50.0, 100.0]), (-4.0, 8.0), 0.005)

SURFACES: dict[str, Height] = {
    "roof": lambda x, y: 2.2 * np.minimum(y, 8.0 - y),
    "step across": lambda x, y: np.where(y > 4.0, 3.0, 0.0),
    "step along": lambda x, y: np.where(x + 0.3 * y > 1.0, 2.5, 0.0),
    "pit": lambda x, y: np.where(x**2 + (y - 4.0) ** 2 < 3.0, -3.0, 0.1 * x),
    "hole": lambda x, y: np.where(x**2 + (y - 4.0) ** 2 < 3.0, np.nan, 0.0),
    "post": lambda x, y: np.where(x**2 + (y - 4.0) ** 2 < 2.0, 5.0, 0.0),
}
REQUIREMENTS = {
    "default": Requirement(region_area_mm2=0.2),
    "line spacing": Requirement(line_spacing_mm=0.35, region_area_mm2=0.2),
    "chord and incidence": Requirement(chord_error_mm=0.02, incidence_rad=0.9, region_area_mm2=0.2),
    "near the limit": Requirement(density_per_mm2=12.5, region_area_mm2=0.2),
    "interest": Requirement(density_per_mm2=12.5, interest=Interest((-2.0, 1.0, -9.0), (3.0, 7.0, 9.0))),
}


@st.composite
def passes(draw: st.DrawFn) -> list[StoredLine]:
    """Lines of one to three passes over one surface, each in its own direction, some lost, stopped or late."""
    surface = SURFACES[draw(st.sampled_from(sorted(SURFACES)))]
    rng = np.random.default_rng(draw(st.integers(0, 2**16)))
    lines = []
    is_long = draw(st.booleans())  # long enough for lines that nothing touches any more
    for number in range(draw(st.integers(1, 1 if is_long else 3))):
        turned, backward = draw(st.booleans()), draw(st.booleans())
        lean_mm = draw(st.sampled_from([0.0, -70.0, 70.0]))  # what one pass hides another may see
        turn_deg = draw(st.sampled_from([0.0, 1.0]))  # a line: the scanner goes round the part
        spacing = draw(st.sampled_from([0.3, 0.45]))
        stations = np.arange(0.5, 7.5, spacing) if not is_long else 0.5 + spacing * np.arange(96)
        if draw(st.booleans()):
            stations[len(stations) // 2 :] += 2.0 * spacing  # a jump: too fast, or lines lost
        if draw(st.booleans()):
            stations = np.insert(stations, 5, stations[4])  # the stage stood still
        stations = stations[::-1] if backward else stations
        lost = set(rng.choice(len(stations), size=draw(st.integers(0, 3)), replace=False).tolist())
        order = [at for at in range(len(stations)) if at not in lost]
        if draw(st.booleans()):
            late = order.pop(3)
            order.insert(8, late)
        lean_rad = np.radians(turn_deg * (np.arange(len(stations)) - len(stations) // 2))
        lines += [_line(surface, number, at, stations[at], spacing, turned, rng, lean_mm, lean_rad[at]) for at in order]
    return lines


def _line(
    surface: Height,
    number: int,
    at: int,
    station: float,
    spacing: float,
    turned: bool,
    rng: np.random.Generator,
    lean_mm: float = 0.0,
    lean_rad: float = 0.0,
) -> StoredLine:
    along = np.arange(-4.0, 4.0, 0.25)
    across = np.full_like(along, station)
    x, y = (across - 4.0, along + 4.0) if turned else (along, across)
    z = surface(x, np.mod(y, 8.0)) + 0.005 * rng.standard_normal(len(x))
    seen = np.isfinite(z) & (rng.random(len(x)) > 0.03) & (rng.random() > 0.05)
    travel = np.array([1.0, 0.0, 0.0]) if turned else np.array([0.0, 1.0, 0.0])
    up, back_mm = np.array([0.0, 0.0, 1.0]), 100.0 * np.tan(lean_rad)  # the plane leans, and the laser with it
    line = Scanline(
        device_id="A",
        boot_id=1,
        pass_index=number,
        line_index=at,
        device_time_s=0.0,
        points_mm=np.column_stack([x, y, z]),
        missing=~seen,
        laser_mm=np.array([station - 4.0, 4.0 + lean_mm, 100.0] if turned else [lean_mm, station, 100.0])
        - back_mm * travel,
        plane_normal=np.cos(lean_rad) * travel + np.sin(lean_rad) * up,
        travel=travel,
        position_mm=station,
        line_spacing_mm=spacing,
        step_mm=spacing,
    )
    return quantise(line, np.zeros(3))


def same(one: Any, other: Any, name: str = "") -> None:
    """Equal to the last bit, NaN where NaN."""
    if isinstance(one, np.ndarray):
        np.testing.assert_array_equal(one, other, err_msg=name)
    elif isinstance(one, tuple):
        assert len(one) == len(other), name
        for a, b in zip(one, other, strict=True):
            same(a, b, name)
    elif hasattr(one, "__dataclass_fields__"):
        for item in fields(one):
            same(getattr(one, item.name), getattr(other, item.name), f"{name}.{item.name}")
    else:
        assert repr(one) == repr(other), name


class Analyst:
    """A map, and what is found again and again in it, held against what is found from nothing."""

    def __init__(self, requirement: Requirement, known: bool) -> None:
        self._requirement = requirement
        self._seen: Any = (GEOMETRY, None, np.array([0.0, 0.0, 1.0])) if known else (None, 0.005, None)
        self.live = LiveMap(MapSettings(noise_mm=0.005, max_points=20_000))
        self._mirror, self._cells = Mirror(), CoverageBook()
        self._finder = RegionFinder(requirement, *self._seen)

    def check(self) -> int:
        """Judge what changed; how many points that took."""
        self._mirror.catch_up(lambda question: question(self.live), lambda question: question(self.live))
        snapshot, changed = self._mirror.changes()
        again = self._finder.find(snapshot, changed)
        anew = find_regions(snapshot, self._requirement, *self._seen)
        same(again, anew)
        renewed = self._finder.renewed
        same(self._cells.renew(snapshot, again, renewed), observed_coverage(snapshot, anew))
        return len(renewed)


@settings(max_examples=12, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    lines=passes(),
    asked=st.sampled_from(sorted(REQUIREMENTS)),
    known=st.booleans(),
    closed=st.booleans(),
    withdrawn=st.booleans(),
    before_the_end=st.sets(st.integers(1, 30), min_size=2, max_size=6),
)
def test_regions_found_again_are_those_found_from_nothing(
    lines: list[StoredLine], asked: str, known: bool, closed: bool, withdrawn: bool, before_the_end: set[int]
) -> None:
    analyst = Analyst(REQUIREMENTS[asked], known)
    for number, line in enumerate(lines):
        if closed and number and line.pass_index != lines[number - 1].pass_index:
            analyst.live.close_all_passes()
        analyst.live.add(line)
        if len(lines) - number in before_the_end:
            analyst.check()
    analyst.live.close_all_passes()
    analyst.check()
    if withdrawn:
        analyst.live.withdraw_pass(("A", 1, 0))
        analyst.check()
    analyst.live.close()


@pytest.mark.parametrize(
    "surface", ["hole", pytest.param("pit", marks=pytest.mark.long), pytest.param("roof", marks=pytest.mark.long)]
)
def test_after_every_line_of_a_long_pass_regions_are_those_found_from_nothing_and_little_is_judged(
    surface: str,
) -> None:
    rng, analyst = np.random.default_rng(3), Analyst(REQUIREMENTS["near the limit"], True)
    judged = []
    for at in range(96):
        analyst.live.add(_line(SURFACES[surface], 0, at, 0.5 + 0.3 * at, 0.3, False, rng))
        if at >= 76:
            judged.append(analyst.check())
    assert max(judged[1:]) < 0.6 * len(analyst.live), judged
    analyst.live.close()


def test_a_wall_that_turns_out_a_shadow_is_judged_again_in_lines_that_nothing_touched() -> None:
    """A wall 12 mm high along the travel: 20 lines have returns on it, as on a flank, and most after them have none."""
    rng, analyst = np.random.default_rng(4), Analyst(REQUIREMENTS["default"], False)

    def wall(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        on_it = (x > 0.9) & (x < 1.4)
        way_down = np.where(x < 1.2, 2.0, -2.0) + rng.uniform(-0.6, 0.6, len(x)) if at < 20 else np.full(len(x), np.nan)
        return np.where(on_it, way_down, np.where(x < 0.9, 6.0, -6.0))

    shadows = []
    for at in range(61):
        analyst.live.add(_line(wall, 0, at, 0.5 + 0.3 * at, 0.3, False, rng))
        if at in (36, 60):  # between the two the pass keeps its frame
            analyst.check()
            snapshot = analyst.live.snapshot()
            first = snapshot.lines.line_index[snapshot.line] < 15
            reason = find_regions(snapshot, REQUIREMENTS["default"], None, 0.005).reason
            shadows.append(int((reason[first] == Reason.SHADOW).sum()))
    assert shadows[0] == 0 and shadows[1] > 20
    analyst.live.close()
