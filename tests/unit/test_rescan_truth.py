"""The rescan benchmark: its truth against drawings, and a small draw of its cases against the truth."""

import ast
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("embreex", reason="the extra `simulation` is not installed")
pytest.importorskip("manifold3d", reason="the extra `bench` is not installed")

import trimesh
from scipy.spatial import cKDTree

from benchmarks import rescan, rescan_truth
from benchmarks.rescan_truth import Caster, Optics, Sweep, band_of, sample_surface, sight_of, truth_of

ROOT = Path(rescan.__file__).resolve().parent
MESHES = ROOT.parent.parent / "shared" / "data" / "meshes"
OPTICS = Optics(
    np.array([0.0, 0.0, 150.0]), np.array([0.0, 150.0 * np.tan(np.radians(27.0)), 150.0]), 56.0, (-30.0, 30.0), 480
)


def _sweep(low: float, high: float) -> Sweep:
    stations = np.arange(low, high, 0.2)
    return Sweep(np.eye(3), np.zeros(3), np.array([0.0, 1.0, 0.0]), stations, np.arange(len(stations)), 0.2)


def _truth_of(mesh: trimesh.Trimesh) -> tuple:
    samples, caster, sweep = sample_surface(mesh, 0.25), Caster(mesh), _sweep(-1.0, 31.0)
    sight = sight_of(caster, samples, OPTICS, sweep)
    return samples, sight, truth_of(samples, sight, OPTICS, sweep, 20.0, caster=caster)


def test_the_truth_imports_neither_planner_nor_optics() -> None:
    tree = ast.parse(Path(rescan_truth.__file__).read_text())
    named = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    named |= {name.name for node in ast.walk(tree) if isinstance(node, ast.Import) for name in node.names}
    assert not any(name and name.split(".")[0] in ("scanner_service", "simulators", "drivers") for name in named)


def test_a_wall_s_shadow_is_as_long_as_the_camera_s_angle_says_and_its_foot_is_hidden() -> None:
    """A block 6 mm high on a plate; the camera stands at +y and looks down at 27 degrees from the laser."""
    plate = trimesh.creation.box(bounds=[[-10.0, 0.0, -4.0], [10.0, 30.0, 0.0]])
    block = trimesh.creation.box(bounds=[[-10.0, 14.0, -1.0], [10.0, 20.0, 6.0]])
    mesh = trimesh.boolean.union([plate, block], engine="manifold")
    samples, sight, truth = _truth_of(mesh)
    floor = (
        (np.abs(samples.points_mm[:, 2]) < 1e-6)
        & (np.abs(samples.points_mm[:, 0]) < 5.0)
        & (samples.normals[:, 2] > 0.9)
    )
    y = samples.points_mm[floor, 1]
    hidden = truth["shadow"][floor]
    slope = 150.0 * np.tan(np.radians(27.0)) / 150.0
    reach = 14.0 - 6.0 * slope
    assert hidden[(y > reach + 0.3) & (y < 13.9)].all()
    assert not hidden[(y < reach - 0.3) | (y > 20.1)].any()
    side = (samples.normals[:, 1] < -0.9) & (samples.points_mm[:, 2] > 0.1) & (np.abs(samples.points_mm[:, 0]) < 5.0)
    assert truth["shadow"][side].mean() > 0.98
    under = samples.normals[:, 2] < -0.9
    assert not truth["shadow"][under].any(), "the end of the part is no shadow"
    assert not sight.visible[under].any()
    assert samples.area_mm2 * len(samples) == pytest.approx(mesh.area)


def test_samples_at_other_places_of_a_surface_tell_the_same_shadow() -> None:
    """A block whose wall sees as much of the plate beside it as of nothing: where it is its shadow is a line."""
    plate = trimesh.creation.box(bounds=[[-10.0, 0.0, -4.0], [10.0, 30.0, 0.0]])
    block = trimesh.creation.box(bounds=[[-10.0, 1.0, -1.0], [1.0, 29.0, 12.0]])
    mesh = trimesh.boolean.union([plate, block], engine="manifold")
    caster, sweep, said = Caster(mesh), _sweep(-1.0, 31.0), []
    for seed in (1, 2):
        samples = sample_surface(mesh, 0.5, seed)
        sight = sight_of(caster, samples, OPTICS, sweep)
        said.append((samples, truth_of(samples, sight, OPTICS, sweep, 20.0, caster=caster)["shadow"]))
    (one, hidden), (other, again) = said
    there, here = (np.column_stack([of.points_mm, 5.0 * of.normals]) for of in (other, one))
    again = again[cKDTree(there).query(here)[1]]
    assert 0.1 < hidden.mean() < 0.5
    assert (hidden != again).sum() < 0.02 * (hidden | again).sum()


@pytest.mark.parametrize(("degrees", "is_steep"), [(50.0, False), (57.0, False), (60.0, True), (75.0, True)])
def test_a_flank_is_steep_beyond_the_angle_at_which_a_radius_no_longer_reaches_the_next_line(
    degrees: float, is_steep: bool
) -> None:
    run = 8.0 / np.tan(np.radians(degrees))
    corners = [(x, y, z) for x in (-8.0, 8.0) for y, z in ((5.0, 0.0), (5.0, 8.0), (8.0, 8.0), (8.0 + run, 0.0))]
    samples, sight, truth = _truth_of(trimesh.convex.convex_hull(np.array(corners)))
    flank = np.abs(samples.normals[:, 2] - np.cos(np.radians(degrees))) < 1e-6
    np.testing.assert_allclose(sight.stretch[flank], 1.0 / np.cos(np.radians(degrees)), rtol=1e-6)
    assert truth["steep"][flank & sight.visible].mean() == pytest.approx(float(is_steep), abs=0.001)


def test_the_band_is_one_radius_on_either_side_of_a_true_boundary() -> None:
    samples = sample_surface(trimesh.creation.box(bounds=[[0, 0, -1], [20, 20, 0]]), 0.1)
    top = samples.normals[:, 2] > 0.9
    away = np.abs(samples.points_mm[:, 0] - 10.0)
    band = band_of(samples, samples.points_mm[:, 0] < 10.0, 0.5)
    assert band[top & (away < 0.35)].all() and not band[top & (away > 0.5)].any()


@pytest.mark.parametrize(
    ("part", "reasons"),
    [
        ("waves", ("sparse", "lost_lines", "noisy")),
        ("bowl", ("out_of_range",)),
        pytest.param("wedges", ("steep", "shadow"), marks=pytest.mark.long),
    ],
)
def test_flagged_area_agrees_with_the_truth_of_a_generated_part(part: str, reasons: tuple[str, ...]) -> None:
    found, _ = rescan.compare(rescan.cases(part)[0], 0.35, 0.35, "shadow" in reasons)
    for reason in reasons:
        assert found[reason].recall >= 0.95, (part, reason, found[reason])
        assert found[reason].precision >= 0.95, (part, reason, found[reason])


@pytest.mark.long
@pytest.mark.skipif(not MESHES.is_dir(), reason="the folder of shared meshes is absent")
@pytest.mark.parametrize("name", rescan.MESHES)
def test_steep_area_of_a_mesh_agrees_with_the_truth(name: str) -> None:
    """Where there is less than 20 mm2 of it, one facet makes a percent."""
    found, _ = rescan.compare(rescan.cases(name, MESHES)[0], 0.15, with_shadows=False)
    if found["steep"].true_mm2 > 0.0:
        least = 0.95 if found["steep"].true_mm2 > 20.0 else 0.9
        assert found["steep"].recall >= least
        assert found["steep"].precision >= least
