"""The nominal part: share of its area that is good, surface never touched, and which meshes are refused, and why."""

import struct
from pathlib import Path

import numpy as np
import pytest

from scanner_service.rescan.judgement import Reason
from scanner_service.rescan.reference import (
    ReferenceApart,
    ReferenceOpen,
    ReferenceSurface,
    ReferenceUnits,
    check_place,
    reference_coverage,
)
from scanner_service.rescan.regions import find_regions
from scanner_service.rescan.requirement import Interest, Requirement
from scanner_service.storage.formats.errors import FormatError
from scanner_service.storage.formats.reference_mesh import read_mesh
from tests.unit.rescan.synthetic_scan import snapshot_of, straight_down

SIDE_MM, HEIGHT_MM = 8.0, 5.0


def block(size: tuple[float, float, float] = (SIDE_MM, SIDE_MM, HEIGHT_MM)) -> np.ndarray:
    """(12, 3, 3) a box on z = -size z .. 0, x and y from 0, wound outwards."""
    corners = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (-1.0, 0.0)]) * size
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))]
    return corners[np.array(faces)]


def scanned(lines_to: float = SIDE_MM):
    x, y = np.arange(0.05, SIDE_MM, 0.2), np.arange(0.05, lines_to, 0.3)
    snapshot = snapshot_of(straight_down(lambda x, y: np.zeros_like(x), x, y, 0.3))
    return snapshot, find_regions(snapshot)


def test_coverage_is_the_share_of_the_nominal_area_and_the_rest_is_untouched() -> None:
    surface = ReferenceSurface.of(block())
    whole = 2 * SIDE_MM**2 + 4 * SIDE_MM * HEIGHT_MM
    assert surface.area_mm2 == pytest.approx(whole)
    snapshot, report = scanned()
    assert check_place(surface, snapshot)
    found = reference_coverage(surface, snapshot, report, Requirement())
    assert found.share == pytest.approx(SIDE_MM**2 / whole, abs=0.08)  # the rim of the walls is within reach of the top
    assert {region.reason for region in found.untouched} == {Reason.UNTOUCHED}
    assert sum(region.area_mm2 for region in found.untouched) == pytest.approx(whole - SIDE_MM**2, rel=0.15)
    down = [region for region in found.untouched if region.normal[2] < -0.9]
    assert len(down) == 1 and down[0].area_mm2 == pytest.approx(SIDE_MM**2, rel=0.1)


def test_half_a_scan_leaves_half_the_top_untouched_and_the_region_of_interest_bounds_what_counts() -> None:
    snapshot, report = scanned(lines_to=0.5 * SIDE_MM)
    top = Requirement(interest=Interest((-1.0, -1.0, -0.05), (9.0, 9.0, 1.0)))
    found = reference_coverage(ReferenceSurface.of(block()), snapshot, report, top)
    assert found.share == pytest.approx(0.5, abs=0.08)
    assert len(found.untouched) == 1
    assert found.untouched[0].centroid_mm[1] > 0.7 * SIDE_MM


def test_a_mesh_inside_out_is_turned_and_an_open_one_is_refused() -> None:
    snapshot, report = scanned()
    right = reference_coverage(ReferenceSurface.of(block()), snapshot, report, Requirement())
    turned = reference_coverage(ReferenceSurface.of(block()[:, ::-1].copy()), snapshot, report, Requirement())
    assert turned.share == pytest.approx(right.share, abs=1e-9)
    with pytest.raises(ReferenceOpen, match="not watertight"):
        ReferenceSurface.of(block()[1:])
    one_turned = block()
    one_turned[0] = one_turned[0, ::-1]
    with pytest.raises(ReferenceOpen):
        ReferenceSurface.of(one_turned)


@pytest.mark.parametrize(("scale", "says"), [(1e-3, "metres"), (1 / 25.4, "inches"), (25.4, "millimetres")])
def test_a_mesh_in_another_unit_is_refused_with_the_unit_it_seems_to_have(scale: float, says: str) -> None:
    middle, flat = block().mean(axis=(0, 1)), np.arange(0.05, SIDE_MM, 0.5)
    few = snapshot_of(straight_down(lambda x, y: np.zeros_like(x), flat, flat, 0.5))
    with pytest.raises(ReferenceUnits, match=says):
        check_place(ReferenceSurface.of((block() - middle) * scale + middle), few)


def test_a_mesh_far_from_the_scan_is_refused_and_few_points_tell_nothing() -> None:
    with pytest.raises(ReferenceApart, match="register"):
        check_place(ReferenceSurface.of(block() + np.array([0.0, 0.0, 40.0])), scanned()[0])
    few = snapshot_of(straight_down(lambda x, y: np.zeros_like(x), np.arange(0, 2, 0.2), np.arange(0, 2, 0.3), 0.3))
    assert not check_place(ReferenceSurface.of(block() + np.array([0.0, 0.0, 40.0])), few)


def test_stl_and_obj_are_read_alike_and_damage_is_refused(tmp_path: Path) -> None:
    corners = block()
    binary, text, obj = tmp_path / "b.stl", tmp_path / "t.stl", tmp_path / "o.obj"
    rows = b"".join(struct.pack("<12fH", 0, 0, 0, *triangle.ravel(), 0) for triangle in corners)
    binary.write_bytes(b"\0" * 80 + struct.pack("<I", len(corners)) + rows)
    facets = "".join(
        "facet normal 0 0 0\nouter loop\n"
        + "".join(f"vertex {x} {y} {z}\n" for x, y, z in triangle)
        + "endloop\nendfacet\n"
        for triangle in corners.tolist()
    )
    text.write_text(f"solid block\n{facets}endsolid\n")
    obj.write_text(
        "".join(f"v {x} {y} {z}\n" for x, y, z in corners.reshape(-1, 3).tolist())
        + "".join(f"f {3 * k + 1} {3 * k + 2}/1 {3 * k + 3}//2\n" for k in range(len(corners)))
    )
    for path in (binary, text, obj):
        np.testing.assert_allclose(read_mesh(path).corners_mm, corners)
        np.testing.assert_allclose(read_mesh(path, "inch").corners_mm, 25.4 * corners)
    data = binary.read_bytes()
    for wreck in (data[:-7], data[:80] + struct.pack("<I", 2**31) + data[84:], b""):
        binary.write_bytes(wreck)
        with pytest.raises(FormatError):
            read_mesh(binary)
    for wreck in ("v 1 2\nf 1 1 1\n", "v 0 0 0\nf 1 2 3\n", "v 0 0 nan\nv 0 1 0\nv 1 0 0\nf 1 2 3\n", "# empty\n"):
        obj.write_text(wreck)
        with pytest.raises(FormatError):
            read_mesh(obj)
