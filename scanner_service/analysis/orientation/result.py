"""What orientation answers: normals, and how sure it is of each component; computes next to nothing."""

from dataclasses import dataclass, fields
from enum import IntFlag

import numpy as np
import numpy.typing as npt

from drivers.scanline import BoolArray, Float64Array, read_only
from scanner_service.analysis.graphs.kd_tree import Int32Array


class Doubt(IntFlag):
    """Why the side of a component, or of some of its points, is a guess; 0 when nothing is."""

    NONE = 0
    SMALL = 1  # too few points to tell anything
    OPEN = 2  # an open surface: both sides are as good
    FLAT = 4  # closed, but it encloses too little to tell inside from outside
    LINKS = 8  # some points hang on a link that may be wrong
    CONTRADICTION = 16  # links along the surface contradict each other
    ENCLOSED = 32  # inside another component: a hollow, or a body in it


_SENTENCES = {
    Doubt.SMALL: "too few points to tell",
    Doubt.OPEN: "an open surface, which side is outside cannot be told from points: turned to +z at its top",
    Doubt.FLAT: "encloses too little to tell inside from outside",
    Doubt.LINKS: "{unsure} of {points} points hang on links that may leap to another sheet, or lie next to one that "
    "contradicts",
    Doubt.CONTRADICTION: "{disagreeing} of {links} links contradict the sides found",
    Doubt.ENCLOSED: "lies inside another component: normals point out of it, into the body if it is a hollow",
}


@dataclass(frozen=True, slots=True)
class ComponentTable:
    """The components of a cloud by falling number of points, one row each.

    `points` (C,) how many; `sure_points` (C,) those of the largest patch that no doubtful link holds together, less
    the ends of links that contradict. `start_row` (C,) the point of the largest z in it. `confidence` (C,) from 0.5, a
    toss of a coin, to 1, nothing was guessed: 0.5 + 0.5 * the share of points whose side is known. `openness` (C,) is
    |sum A n| / sum A, 0 for a closed surface and 1 for a flat sheet; `fullness` (C,) is sum A n·(p - c) / (R sum A)
    with R the rms distance from the centroid c: 1 for a sphere with normals outwards, -1 inwards, after orientation.
    `turned` (C,) True where the enclosed volume overruled the start. `links`, `disagreeing` (C,) count links along the
    surface, and those whose ends lie on different sides. `doubt` (C,) says why.
    """

    points: npt.NDArray[np.int64]
    sure_points: npt.NDArray[np.int64]
    start_row: npt.NDArray[np.int64]
    confidence: Float64Array
    openness: Float64Array
    fullness: Float64Array
    turned: BoolArray
    links: npt.NDArray[np.int64]
    disagreeing: npt.NDArray[np.int64]
    doubt: npt.NDArray[np.uint8]

    def __post_init__(self) -> None:
        for item in fields(self):
            read_only(getattr(self, item.name))

    def __len__(self) -> int:
        return len(self.points)

    def warning(self, number: int) -> str:
        """Why the side of this component is a guess, as one sentence; empty when it is none."""
        facts = {
            "points": int(self.points[number]),
            "unsure": int(self.points[number] - self.sure_points[number]),
            "links": int(self.links[number]),
            "disagreeing": int(self.disagreeing[number]),
        }
        reasons = [text.format(**facts) for doubt, text in _SENTENCES.items() if self.doubt[number] & doubt]
        return "; ".join(reasons)


@dataclass(frozen=True, slots=True)
class Orientation:
    """Normals on one side, and how sure that is.

    `normals` (n, 3) unit, NaN where none was given. `component` (n,) row in `components`, -1 where no normal was
    given. `sure` (n,) True where the side is known: the component's outside is, and no doubtful link lies on the way.
    `left_out` counts points by the reason why they take no part.
    """

    normals: Float64Array
    component: Int32Array
    sure: BoolArray
    components: ComponentTable
    left_out: dict[str, int]

    def __post_init__(self) -> None:
        for array in (self.normals, self.component, self.sure):
            read_only(array)
