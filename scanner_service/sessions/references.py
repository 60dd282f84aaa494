"""From a reference mesh that a session names to the surface it is measured against; knows one folder and no route."""

from dataclasses import dataclass, replace
from pathlib import Path

from scanner_service.rescan.reference import ReferenceSurface, ReferenceUnusable
from scanner_service.sessions.errors import SourceUnusable
from scanner_service.storage.formats.errors import FormatError
from scanner_service.storage.formats.reference_mesh import ReferenceSpec, read_mesh


@dataclass(frozen=True, slots=True)
class Nominal:
    """The nominal part of a session: its surface, or one sentence why there is none although the session names one."""

    surface: ReferenceSurface | None = None
    refused: str | None = None


NO_NOMINAL = Nominal()


def nominal_of(spec: ReferenceSpec | None, folder: Path | None) -> Nominal:
    """The nominal part that a session of the record names; `folder` is where meshes lie, None when nowhere."""
    if spec is None:
        return NO_NOMINAL
    try:
        if folder is None or not folder.is_dir():
            raise SourceUnusable(f"there is no folder in which {spec.file} could lie")
        return Nominal(open_reference(spec, folder)[0])
    except (FormatError, ReferenceUnusable, SourceUnusable, OSError) as error:
        return Nominal(refused=f"judged without the reference mesh, so coverage is of the surface seen: {error}")


def open_reference(spec: ReferenceSpec, folder: Path) -> tuple[ReferenceSurface, ReferenceSpec]:
    """The surface of the mesh file of that bare name in a folder; and the spec with the file's SHA-256.

    Raises
    ------
    SourceUnusable : the folder holds no such file, or it is not the one whose SHA-256 the spec has.
    FormatError : the file cannot be read.
    ReferenceUnusable : the mesh is not watertight, or has no surface.
    """
    if spec.file not in {item.name for item in folder.iterdir()}:
        raise SourceUnusable(f"there is no file {spec.file} in the folder {folder}: put the reference mesh there")
    found = read_mesh(folder / spec.file, spec.units)
    if spec.sha256 not in (None, found.sha256):
        raise SourceUnusable(f"{spec.file} is not the mesh that this session was measured against: its content changed")
    return ReferenceSurface.of(found.corners_mm), replace(spec, sha256=found.sha256)
