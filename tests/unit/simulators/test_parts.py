"""Laws of the demo part: it must really cause what it was made for."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from drivers.scanline import Pose
from simulators.optics import Exposure, Return, demo_scanner
from simulators.parts import PARTS, mesh_part

LINE_SPACING_MM = 0.5


def scan(name: str) -> tuple[np.ndarray, list[Exposure]]:
    part = PARTS[name]()
    rng = np.random.default_rng(1)
    positions = np.arange(*part.travel_mm, LINE_SPACING_MM)
    poses = [Pose(np.eye(3), np.array([0.0, y, 0.0])) for y in positions]
    return positions, [demo_scanner().trace(part.surface, pose, rng) for pose in poses]


@pytest.mark.parametrize("name", PARTS)
def test_every_part_is_covered_by_its_travel_and_returns_light(name: str) -> None:
    _, exposures = scan(name)
    assert sum(int((e.outcome == Return.SEEN).sum()) for e in exposures) > 1000
    assert np.isnan(exposures[0].x_mm).all(), "the first line lies before the part"
    assert np.isnan(exposures[-1].x_mm).all(), "the last line lies behind it"


def test_the_demo_part_causes_shadow_steepness_thinness_and_a_hole() -> None:
    positions, exposures = scan("demo")
    outcome = np.array([e.outcome for e in exposures])
    truth = np.array([e.truth_mm for e in exposures])
    incidence = np.array([e.incidence_rad for e in exposures])
    y = np.broadcast_to(positions[:, None], outcome.shape)
    x, z = truth[..., 0], truth[..., 2]
    cell = LINE_SPACING_MM * demo_scanner().point_spacing_mm

    floor = (np.abs(z - 2.0) < 1e-6) & (x > -18.0) & (x < -4.0)
    assert (floor & (outcome == Return.SEEN)).sum() * cell > 60.0, "the pocket's floor is partly seen"
    assert (floor & (outcome == Return.CAMERA_SHADOW)).sum() * cell > 60.0, "and partly hidden from the camera"
    assert x[floor].max() < -4.0 - 0.3, "and hidden from the laser along the wall nearest to it"

    on_flank = (x < 1.9) & (x > -20.0) & (y > 34.0) & (y < 46.0) & (outcome == Return.SEEN)
    tilt = np.degrees(incidence[on_flank])
    assert ((tilt > 44.5) & (tilt < 46.5)).sum() > 500
    assert ((tilt > 67.5) & (tilt < 69.0)).sum() > 200

    wall = (x > 18.9) & (x < 19.45) & (y > 38.0) & (y < 56.0) & (np.abs(z - 8.0) < 1e-6)
    assert 1 <= wall.sum(axis=1).max() <= 4, "a thin wall is a few points wide"

    hole = (np.hypot(demo_scanner().field_of_view_mm * (np.arange(400) / 399 - 0.5) - 10.0, y - 18.0)) < 2.5
    assert (outcome[hole] == Return.NO_SURFACE).all(), "through the hole the laser meets nothing"
    assert np.nanmax(z) == pytest.approx(19.0, abs=1e-6)


def test_a_mesh_is_set_down_within_reach_of_the_scanner(tmp_path: Path) -> None:
    path = tmp_path / "block.stl"
    block = trimesh.creation.box(extents=(0.02, 0.03, 0.01))
    block.apply_translation((5.0, -7.0, 3.0))
    block.export(path)
    part = mesh_part(path, scale_to_mm=1000.0)
    assert part.travel_mm == pytest.approx((-1.0, 31.0), abs=1e-2)
    exposure = demo_scanner().trace(part.surface, Pose(np.eye(3), np.array([0.0, 15.0, 0.0])), np.random.default_rng(1))
    seen = exposure.outcome == Return.SEEN
    np.testing.assert_allclose(exposure.truth_mm[seen, 2], 5.0, atol=1e-2)
    assert exposure.x_mm[seen].min() == pytest.approx(-10.0, abs=0.2)
    assert exposure.x_mm[seen].max() == pytest.approx(10.0, abs=0.2)
