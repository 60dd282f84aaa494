"""Triangle meshes as surfaces: read from a file, placed in the part frame, hit by rays; knows no optics.

Embree finds the triangle in single precision; where the ray meets it is then computed again in double precision.
"""

import struct
from pathlib import Path

import numpy as np
import numpy.typing as npt
import trimesh
from embreex import rtcore_scene
from embreex.mesh_construction import TriangleMesh as EmbreeTriangles

from drivers.scanline import Float64Array, Pose

MESH_SUFFIXES = (".obj", ".ply", ".stl")
# What the readers of trimesh raise on damaged files; ImportError is its wish for a package that guesses encodings.
_DAMAGE = (
    ArithmeticError,
    AttributeError,
    EOFError,
    ImportError,
    LookupError,
    MemoryError,
    OSError,
    TypeError,
    ValueError,
    struct.error,
)


class MeshError(Exception):
    """A mesh that cannot be scanned.

    MeshError
    +-- MeshUnreadable    the file is absent, of another kind, or damaged
    +-- MeshEmpty         nothing in it has an area
    +-- MeshNotFinite     a coordinate is NaN or infinite, or the scale is not a positive number
    """


class MeshUnreadable(MeshError):
    """The file is absent, of another kind, or damaged."""


class MeshEmpty(MeshError):
    """Nothing in the mesh has an area."""


class MeshNotFinite(MeshError):
    """A coordinate is NaN or infinite, or the scale is not a positive number."""


class TriangleMesh:
    """A mesh of triangles, wound counter-clockwise seen from outside, at rest in the part frame.

    Triangles without area are left out (`dropped_triangles` of them). A closed mesh that is inside out is turned; an
    open one is taken as it is wound.

    Parameters
    ----------
    vertices_mm : (v, 3) in the mesh's own frame.
    faces : (f, 3) indices into the vertices.
    part_from_mesh : where the mesh stands.

    Raises
    ------
    MeshEmpty, MeshNotFinite : when there is nothing to hit, or it is nowhere.
    """

    def __init__(self, vertices_mm: Float64Array, faces: npt.NDArray[np.integer], part_from_mesh: Pose) -> None:
        if not np.isfinite(vertices_mm).all():
            raise MeshNotFinite("the mesh has a coordinate that is not a finite number; repair it and try again")
        corners = part_from_mesh.apply(vertices_mm)[faces]
        edges_1, edges_2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        crosses = np.cross(edges_1, edges_2)
        doubled_areas = np.linalg.norm(crosses, axis=1)
        solid = doubled_areas > 0
        if not solid.any():
            raise MeshEmpty("the mesh has no triangle with an area; is it a point cloud?")
        self.dropped_triangles = int((~solid).sum())
        self._corners = corners[solid]
        self._edges_1, self._edges_2 = edges_1[solid], edges_2[solid]
        self._normals = crosses[solid] / doubled_areas[solid, None]
        volume = np.einsum("ij,ij->", corners[:, 0] - corners[0, 0], crosses)
        if volume < 0 and trimesh.Trimesh(vertices_mm, faces, process=True).is_watertight:
            self._normals *= -1.0
        # Single precision is spent around the middle of the mesh, not around a far origin.
        self._centre = 0.5 * (self._corners.min(axis=(0, 1)) + self._corners.max(axis=(0, 1)))
        self._scene = rtcore_scene.EmbreeScene()
        self._embree = EmbreeTriangles(self._scene, (self._corners - self._centre).astype(np.float32))

    @property
    def bounds_mm(self) -> tuple[Float64Array, Float64Array]:
        """The low and the high corner (3,) of the axis-parallel box around the mesh, part frame."""
        return self._corners.min(axis=(0, 1)), self._corners.max(axis=(0, 1))

    def first_hit(self, origins_mm: Float64Array, directions: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Distance (n,) along each ray, inf = no hit, and unit outward normals (n, 3), NaN = no hit."""
        distance = np.full(len(origins_mm), np.inf)
        normals = np.full((len(origins_mm), 3), np.nan)
        if not len(origins_mm):
            return distance, normals
        origins = (origins_mm - self._centre).astype(np.float32)
        triangle = self._scene.run(origins, directions.astype(np.float32))
        hit = np.flatnonzero(triangle >= 0)
        chosen = triangle[hit]
        distance[hit] = self._distance(chosen, origins_mm[hit], directions[hit])
        normals[hit] = self._normals[chosen]
        return distance, normals

    def _distance(
        self, triangle: npt.NDArray[np.integer], origins_mm: Float64Array, directions: Float64Array
    ) -> Float64Array:
        """Where the rays meet their triangles, in double precision (Moeller and Trumbore 1997).

        A ray that only grazes its triangle, or passes just beside it, meets the plane far from where it was found to
        hit; it is taken to the nearest place of the triangle in barycentric coordinates instead.
        """
        edges_1, edges_2 = self._edges_1[triangle], self._edges_2[triangle]
        to_origin = origins_mm - self._corners[triangle, 0]
        p, q = np.cross(directions, edges_2), np.cross(to_origin, edges_1)
        determinant = np.einsum("ij,ij->i", edges_1, p)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = np.einsum("ij,ij->i", to_origin, p) / determinant
            v = np.einsum("ij,ij->i", directions, q) / determinant
            distance: Float64Array = np.einsum("ij,ij->i", edges_2, q) / determinant
        inside = (u >= -1e-3) & (v >= -1e-3) & (u + v <= 1.0 + 1e-3)
        if not inside.all():
            beside = ~inside
            u, v = np.nan_to_num(np.clip(u[beside], 0.0, 1.0)), np.nan_to_num(np.clip(v[beside], 0.0, 1.0))
            over = np.maximum(u + v, 1.0)
            nearest = (u / over)[:, None] * edges_1[beside] + (v / over)[:, None] * edges_2[beside]
            distance[beside] = np.einsum("ij,ij->i", nearest - to_origin[beside], directions[beside])
        return distance


def load_mesh(path: Path, scale_to_mm: float = 1.0, part_from_mesh: Pose | None = None) -> TriangleMesh:
    """Read an STL, OBJ or PLY file.

    Parameters
    ----------
    path : the file; its suffix says its kind.
    scale_to_mm : millimetres in one unit of the file (these formats carry no unit).
    part_from_mesh : where the scaled mesh stands; as it is in the file when None.

    Raises
    ------
    MeshError : one of its kinds, saying what to do.
    """
    if not (np.isfinite(scale_to_mm) and scale_to_mm > 0):
        raise MeshNotFinite(f"the scale of a mesh must be a positive number of millimetres, not {scale_to_mm}")
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise MeshUnreadable(f"{path} is not a mesh this simulator reads; give a file ending in .stl, .obj or .ply")
    if not path.is_file():
        raise MeshUnreadable(f"there is no mesh file {path}")
    if path.suffix.lower() == ".stl" and not _stl_is_whole(path):
        raise MeshUnreadable(f"{path} is damaged: its length is not what its header says; write it anew and try again")
    try:
        # Unprocessed, so that no vertex is merged or moved.
        mesh = trimesh.load_mesh(path, process=False)
        vertices, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)
    except _DAMAGE as damage:
        raise MeshUnreadable(f"{path} is damaged or not a mesh; write it anew and try again") from damage
    if not len(faces):
        raise MeshEmpty(f"{path} holds no triangles; is it a point cloud?")
    return TriangleMesh(vertices * scale_to_mm, faces, Pose.identity() if part_from_mesh is None else part_from_mesh)


def _stl_is_whole(path: Path) -> bool:
    """False for a binary STL whose length contradicts its count; readers differ in what they make of such a wreck."""
    with path.open("rb") as file:
        head = file.read(84)
    if head.startswith(b"solid") or len(head) < 84:  # text, or left to the reader
        return True
    (triangles,) = struct.unpack_from("<I", head, 80)
    return bool(path.stat().st_size == 84 + 50 * triangles)
