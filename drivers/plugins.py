"""Drivers that other packages add: found by their entry points, loaded only when asked for by name.

A package that offers one says, in its pyproject.toml,

    [project.entry-points."scanner_service.scanners"]
    acme = "acme_scanner:ACME"

where `ACME` is a `drivers.scanners.known.KnownScanner`; stages likewise under `scanner_service.stages` with a
`drivers.stages.known.KnownStage`. A driver of this project is never replaced by an added one of the same name.
"""

from importlib.metadata import EntryPoint, entry_points
from typing import TypeVar

from drivers.errors import DriverUnknown

SCANNERS_GROUP = "scanner_service.scanners"
STAGES_GROUP = "scanner_service.stages"

T = TypeVar("T")


def added(group: str) -> dict[str, EntryPoint]:
    """Return the entry points of a group by name; of two with one name the first, by package name, is taken."""
    found: dict[str, EntryPoint] = {}
    for point in sorted(entry_points(group=group), key=lambda point: (point.name, point.value)):
        found.setdefault(point.name, point)
    return found


def find_added(group: str, name: str, kind: type[T]) -> T | None:
    """Return what the entry point of that name leads to, None when there is none.

    Raises
    ------
    DriverUnknown : it cannot be imported, or is not of `kind`.
    """
    point = added(group).get(name)
    if point is None:
        return None
    try:
        loaded = point.load()
    except (ImportError, AttributeError) as error:
        raise DriverUnknown(f"the driver {name} ({point.value}) cannot be loaded: {error}; reinstall it") from error
    if not isinstance(loaded, kind):
        raise DriverUnknown(
            f"the driver {name} ({point.value}) is a {type(loaded).__name__}, not a {kind.__name__}; "
            "its author must mend it"
        )
    return loaded
