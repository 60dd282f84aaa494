"""What an orientation says in words and plain values: how sure it is, in all and component by component."""

from typing import Any

from scanner_service.analysis.orientation.result import Orientation

TOLD = 20
"""Components that a summary tells one by one, the largest."""


def summarise_orientation(found: Orientation) -> dict[str, Any]:
    """How sure the sides are, in all and component by component."""
    table = found.components
    given = found.component >= 0
    return {
        "points": int(given.sum()),
        "sure_points": int(found.sure.sum()),
        "left_out": found.left_out,
        "components": len(table),
        "largest_components": [
            {
                "number": number,
                "points": int(table.points[number]),
                "confidence": float(table.confidence[number]),
                "openness": float(table.openness[number]),
                "fullness": float(table.fullness[number]),
                "turned_by_volume": bool(table.turned[number]),
                "contradicting_links": int(table.disagreeing[number]),
                "warning": table.warning(number) or None,
            }
            for number in range(min(len(table), TOLD))
        ],
        "points_in_others": int(table.points[TOLD:].sum()),
    }


def tell_orientation(found: Orientation) -> list[str]:
    """A sentence on the whole, and one for each of the largest components that is a guess."""
    table = found.components
    given = int((found.component >= 0).sum())
    notes = [
        f"normals oriented over the Riemannian graph: the side of {int(found.sure.sum())} of {given} points is known, "
        f"in {len(table)} component{'s' if len(table) != 1 else ''}"
    ]
    for number in range(min(len(table), 3)):
        if warning := table.warning(number):
            notes.append(f"component {number} ({table.points[number]} points): {warning}")
    doubtful = int((table.doubt[3:] != 0).sum())
    if doubtful:
        notes.append(f"{doubtful} smaller components are guesses too, in whole or in part: see summary.json")
    return notes
