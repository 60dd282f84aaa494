"""The nominal part out of an STL or OBJ file: triangles in millimetres; knows no scan and judges no mesh.

Declared sizes are checked against the file's before anything is allocated.
"""

import hashlib
import struct
from dataclasses import dataclass
from math import isfinite
from pathlib import Path

import numpy as np
import numpy.typing as npt

from drivers.scanline import Float64Array
from scanner_service.storage.formats.errors import (
    ContentDamaged,
    FileEmpty,
    FileNotReadable,
    FileTooLarge,
    FileTruncated,
    FormatUnknown,
    OptionRefused,
)
from scanner_service.storage.formats.recording import MM_PER_UNIT

MAX_BYTES = 256 * 2**20
_STL_HEAD, _STL_TRIANGLE = 84, 50
IntArray = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class ReferenceSpec:
    """Which mesh a session is measured against: the file's name, its length unit (mm, m or inch), its SHA-256.

    The mesh must be registered: it lies where the part lies in the part frame. `sha256` is None until it was read.

    Raises
    ------
    OptionRefused : a unit that is none.
    """

    file: str
    units: str = "mm"
    sha256: str | None = None

    def __post_init__(self) -> None:
        if self.units not in MM_PER_UNIT:
            raise OptionRefused(f"the unit of a reference mesh is {', '.join(MM_PER_UNIT)}, not {self.units!r}")


@dataclass(frozen=True, slots=True)
class MeshFile:
    """What a mesh file holds: corners of the triangles (t, 3, 3) in millimetres, and the SHA-256 of the file."""

    corners_mm: Float64Array
    sha256: str


def read_mesh(path: Path, units: str = "mm", max_bytes: int = MAX_BYTES) -> MeshFile:
    """Read the triangles of an STL (binary or text) or OBJ file.

    Raises
    ------
    FormatError : one of its kinds; the sentence says what to do.
    """
    spec = ReferenceSpec(path.name, units)
    try:
        size = path.stat().st_size
        if size > max_bytes:
            raise FileTooLarge(
                f"{path.name} has {size} bytes, more than the {max_bytes} that a reference mesh may have"
            )
        data = path.read_bytes()
    except OSError as error:
        raise FileNotReadable(f"the reference mesh {path.name} cannot be read: {error.strerror}") from error
    suffix = path.suffix.lower()
    if suffix == ".stl":
        corners = _stl(data, path.name)
    elif suffix == ".obj":
        corners = _obj(data, path.name)
    else:
        raise FormatUnknown(f"a reference mesh is an .stl or an .obj file, not {path.name}")
    if not len(corners):
        raise FileEmpty(f"{path.name} holds no triangle: is it a point cloud?")
    if not np.isfinite(corners).all():
        raise ContentDamaged(f"{path.name} has a corner that is not a finite number; repair the mesh and try again")
    return MeshFile(corners * MM_PER_UNIT[spec.units], hashlib.sha256(data).hexdigest())


def _stl(data: bytes, name: str) -> Float64Array:
    """(t, 3, 3) corners; a file that starts with `solid` is text only when its length fits no binary one."""
    if len(data) >= _STL_HEAD:
        (count,) = struct.unpack_from("<I", data, 80)
        if len(data) == _STL_HEAD + _STL_TRIANGLE * count:
            rows = np.frombuffer(data, dtype=np.uint8, offset=_STL_HEAD).reshape(count, _STL_TRIANGLE)
            return np.ascontiguousarray(rows[:, 12:48]).view("<f4").reshape(count, 3, 3).astype(np.float64)
    if not data.lstrip().startswith(b"solid"):
        raise FileTruncated(f"{name} is not as long as its header says: write it anew and try again")
    numbers = [line.split()[1:] for line in data.splitlines() if line.split()[:1] == [b"vertex"]]
    if len(numbers) % 3:
        raise ContentDamaged(f"{name} ends in the middle of a triangle: write it anew and try again")
    return np.array([_vector(parts, name) for parts in numbers]).reshape(-1, 3, 3)


def _obj(data: bytes, name: str) -> Float64Array:
    """(t, 3, 3) corners; polygons are split into fans."""
    vertices: list[list[float]] = []
    faces: list[tuple[int, int, int]] = []
    for number, line in enumerate(data.splitlines(), start=1):
        parts = line.split()
        if parts[:1] == [b"v"]:
            vertices.append(_vector(parts[1:4], name))
        elif parts[:1] == [b"f"]:
            try:
                named = [int(part.split(b"/")[0]) for part in parts[1:]]
            except ValueError:
                raise ContentDamaged(f"{name}: line {number} names a corner that is no number") from None
            corners = [index - 1 if index > 0 else len(vertices) + index for index in named]
            if len(corners) < 3 or min(corners) < 0 or max(corners) >= len(vertices):
                raise ContentDamaged(f"{name}: the face in line {number} names a corner that is not there")
            faces += [(corners[0], corners[at], corners[at + 1]) for at in range(1, len(corners) - 1)]
    return np.array(vertices).reshape(-1, 3)[np.array(faces, dtype=np.int64).reshape(-1, 3)]


def _vector(parts: list[bytes], name: str) -> list[float]:
    """Three numbers."""
    try:
        vector = [float(part) for part in parts[:3]]
    except ValueError:
        vector = []
    if len(vector) != 3 or not all(map(isfinite, vector)):
        raise ContentDamaged(f"{name} has a corner that is not three finite numbers: {b' '.join(parts)[:60]!r}")
    return vector
