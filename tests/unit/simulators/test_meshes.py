"""Laws of meshes under rays: they agree with the analytic shapes they stand for, wherever they stand."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from drivers.scanline import Pose
from simulators.meshes import MeshEmpty, MeshNotFinite, MeshUnreadable, TriangleMesh, load_mesh
from simulators.optics import Return, demo_scanner
from simulators.shapes import Sphere, box

SHARED = Path(__file__).resolve().parents[3].parent / "shared"
PLACE = Pose(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.array([100.0, 2000.0, -50.0]))


def box_mesh(pose: Pose) -> TriangleMesh:
    mesh = trimesh.creation.box(extents=(12.0, 10.0, 8.0))
    return TriangleMesh(np.asarray(mesh.vertices), np.asarray(mesh.faces), pose)


def rays(n: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    origins = rng.normal(size=(n, 3))
    origins *= 150.0 / np.linalg.norm(origins, axis=1, keepdims=True)
    directions = rng.uniform(-7.0, 7.0, size=(n, 3)) - origins
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.mark.parametrize("pose", [Pose.identity(), PLACE], ids=["at home", "moved and turned"])
def test_a_box_of_triangles_is_the_box(pose: Pose) -> None:
    origins, directions = rays(2000)
    expected, normals = box((-6.0, -5.0, -4.0), (6.0, 5.0, 4.0)).first_hit(origins, directions)
    found, found_normals = box_mesh(pose).first_hit(pose.apply(origins), pose.rotate(directions))
    # Single precision may decide a ray within a ten-thousandth of an edge the other way.
    corner = origins + np.where(np.isfinite(expected), expected, 0.0)[:, None] * directions
    near_edge = np.sort(np.abs(np.abs(corner) - (6.0, 5.0, 4.0)), axis=1)[:, 1] < 1e-4
    both = np.isfinite(expected) & np.isfinite(found) & ~near_edge
    assert both.sum() > 1000
    assert (np.isfinite(expected) == np.isfinite(found)).mean() > 0.999
    np.testing.assert_allclose(found[both], expected[both], atol=1e-9)
    np.testing.assert_allclose(found_normals[both], pose.rotate(normals[both]), atol=1e-9)


def test_a_ball_of_triangles_is_the_ball_to_within_its_facets() -> None:
    mesh = trimesh.creation.icosphere(subdivisions=5, radius=10.0)
    surface = TriangleMesh(np.asarray(mesh.vertices), np.asarray(mesh.faces), Pose.identity())
    edge = float(mesh.edges_unique_length.max())
    sag = edge**2 / (2 * 10.0)
    origins, directions = rays(2000)
    expected, normals = Sphere((0.0, 0.0, 0.0), 10.0).first_hit(origins, directions)
    found, found_normals = surface.first_hit(origins, directions)
    cosine = -np.einsum("ij,ij->i", normals, directions)
    both = np.isfinite(expected) & np.isfinite(found) & (cosine > 0.3)
    assert both.sum() > 1000
    depth = found[both] - expected[both]
    assert (depth >= -1e-9).all(), "facets lie inside the ball"
    assert (depth <= sag / 0.3 + 1e-9).all()
    assert np.einsum("ij,ij->i", normals[both], found_normals[both]).min() > np.cos(edge / 10.0)


def test_a_closed_mesh_that_is_inside_out_is_turned() -> None:
    mesh = trimesh.creation.box(extents=(2.0, 2.0, 2.0))
    flipped = TriangleMesh(np.asarray(mesh.vertices), np.asarray(mesh.faces)[:, ::-1], PLACE)
    above = PLACE.apply(np.array([[0.1, 0.2, 9.0]]))
    _, normals = flipped.first_hit(above, np.array([[0.0, 0.0, -1.0]]))
    np.testing.assert_allclose(normals, [[0.0, 0.0, 1.0]], atol=1e-12)


def test_triangles_without_area_are_left_out_and_counted() -> None:
    vertices = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    surface = TriangleMesh(vertices, np.array([[0, 0, 1], [0, 1, 2]]), Pose.identity())
    assert surface.dropped_triangles == 1
    distance, _ = surface.first_hit(np.array([[0.2, 0.2, 3.0]]), np.array([[0.0, 0.0, -1.0]]))
    assert distance[0] == pytest.approx(3.0)


def test_the_scanner_sees_a_mesh_as_it_sees_the_solid() -> None:
    pose = Pose(np.eye(3), np.array([0.0, 3.0, 0.0]))
    solid = demo_scanner().trace(box((-6.0, -5.0, -4.0), (6.0, 5.0, 4.0)), pose, np.random.default_rng(2))
    mesh = demo_scanner().trace(box_mesh(Pose.identity()), pose, np.random.default_rng(2))
    np.testing.assert_array_equal(mesh.outcome, solid.outcome)
    assert (mesh.outcome == Return.SEEN).sum() > 80
    np.testing.assert_allclose(mesh.z_mm, solid.z_mm, atol=1e-9)


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply"])
def test_a_file_is_read_and_scaled_to_millimetres(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"cube.{suffix}"
    trimesh.creation.box(extents=(1.0, 2.0, 3.0)).export(path)
    low, high = load_mesh(path, scale_to_mm=10.0, part_from_mesh=PLACE).bounds_mm
    np.testing.assert_allclose(high - low, [20.0, 10.0, 30.0], atol=1e-5)
    np.testing.assert_allclose((low + high) / 2, PLACE.translation_mm, atol=1e-5)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("short.ply", b"ply\nformat binary_little_endian 1.0\nelement vertex 4000000000\nproperty float x\n"
         b"property float y\nproperty float z\nend_header\n123"),
        ("long.stl", b"\0" * 80 + b"\xff\xff\xff\xff" + b"1" * 50),
        ("noise.ply", b"\x00\x01\x02"),
        ("beyond.obj", b"v 1 2 3\nv 2 2 3\nf 1 2 9\n"),
    ],
)  # fmt: skip
def test_a_damaged_file_is_refused_in_one_sentence(tmp_path: Path, name: str, content: bytes) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(MeshUnreadable, match="damaged"):
        load_mesh(path)


def test_what_is_no_mesh_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MeshUnreadable, match="no mesh file"):
        load_mesh(tmp_path / "absent.stl")
    (tmp_path / "part.step").write_bytes(b"ISO-10303-21;")
    with pytest.raises(MeshUnreadable, match=r"ending in \.stl"):
        load_mesh(tmp_path / "part.step")
    (tmp_path / "empty.obj").write_bytes(b"v 1 2 3\n")
    with pytest.raises(MeshEmpty):
        load_mesh(tmp_path / "empty.obj")
    with pytest.raises(MeshNotFinite, match="scale"):
        load_mesh(tmp_path / "absent.stl", scale_to_mm=0.0)
    with pytest.raises(MeshNotFinite, match="not a finite number"):
        TriangleMesh(np.array([[0.0, 0.0, np.nan], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]]), Pose.identity())


@pytest.mark.parametrize(("name", "scale"), [("fandisk.obj", 20.0), ("featuretype.STL", 10.0), ("gears.stl", 1.0)])
def test_real_parts_can_be_scanned(name: str, scale: float) -> None:
    path = SHARED / "data" / "meshes" / name
    if not path.is_file():
        pytest.skip(f"{name} is not beside the project")
    surface = load_mesh(path, scale)
    low, high = surface.bounds_mm
    pose = Pose(np.eye(3), np.array([*(low + high)[:2] / 2, high[2] - 10.0]))
    exposure = demo_scanner().trace(surface, pose, np.random.default_rng(1))
    assert (exposure.outcome == Return.SEEN).sum() > 50
