"""What every method of normal estimation is asked, and what it answers; knows no method."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from enum import IntEnum

import numpy as np
import numpy.typing as npt

from drivers.scanline import BoolArray, Float64Array, read_only
from scanner_service.analysis.snapshot import UInt8Array

Int64Array = npt.NDArray[np.int64]
Tell = Callable[[float], None]
"""Is told the share of the work that is done, from 0 to 1; may raise an exception of its own to end the work."""


def tell_nobody(share: float) -> None:
    """For whoever wants no progress."""


MIN_NEIGHBOURS = 6
"""A plane needs at least this many points, the point itself counted, before its normal is given."""

MAX_NEIGHBOURS = 500
"""A neighbourhood that is chosen, and not stated, holds at most this many points."""


class NormalReason(IntEnum):
    """Why a point has no normal; the first that applies."""

    GIVEN = 0
    NOT_FINITE = 1
    """The point has a coordinate that is NaN or infinite."""
    TOO_FEW = 2
    """Fewer than MIN_NEIGHBOURS points in the neighbourhood."""
    UNDETERMINED = 3
    """The neighbourhood has no plane: its points lie in one place or on one line."""
    UNCERTAIN = 4
    """The predicted error is above the limit."""
    NO_CELL = 5
    """The point has no Voronoi cell of its own: it is doubled, or lost in rounding."""
    NO_BIG_BALL = 6
    """No big Delaunay ball touches the point or one of its neighbours."""


@dataclass(frozen=True, slots=True)
class NormalOptions:
    """What can be said to a method; None lets the method decide. Each method reads its own, and refuses others.

    Parameters
    ----------
    radius_mm : radius of the neighbourhood.
    neighbours : points of the neighbourhood, the point itself counted.
    noise_mm : standard deviation of the noise across the surface; None estimates it.
    floor_mm, ceiling_mm : bounds of a radius that adapts.
    ball_factor : a Delaunay ball is big when its radius is larger than so many times the nearest-neighbour scale.
    max_error_rad : a normal whose predicted error is larger is not given; infinity gives all that are determined.
    threads : how many work at once, where a method can share its work out; they change no result.

    Raises
    ------
    ValueError : for a value that cannot be meant.
    """

    radius_mm: float | None = None
    neighbours: int | None = None
    noise_mm: float | None = None
    floor_mm: float | None = None
    ceiling_mm: float | None = None
    ball_factor: float | None = None
    max_error_rad: float = math.radians(5.0)
    threads: int = 1

    def __post_init__(self) -> None:
        for name in ("radius_mm", "floor_mm", "ceiling_mm", "ball_factor"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} must be a number greater than 0, not {value}")
        if self.noise_mm is not None and not (math.isfinite(self.noise_mm) and self.noise_mm >= 0):
            raise ValueError(f"noise_mm must be 0 or more, not {self.noise_mm}")
        if self.neighbours is not None and self.neighbours < MIN_NEIGHBOURS:
            raise ValueError(f"a plane needs {MIN_NEIGHBOURS} neighbours or more, not {self.neighbours}")
        if self.radius_mm is not None and self.neighbours is not None:
            raise ValueError("a radius and a number of neighbours are both given: leave one of them out")
        if self.floor_mm is not None and self.ceiling_mm is not None and self.floor_mm > self.ceiling_mm:
            raise ValueError(f"the floor of {self.floor_mm:g} mm lies above the ceiling of {self.ceiling_mm:g} mm")
        if not self.max_error_rad > 0:
            raise ValueError(f"max_error_rad must be greater than 0, not {self.max_error_rad}")
        if self.threads < 1:
            raise ValueError(f"at least 1 thread is needed, not {self.threads}")

    def given(self) -> set[str]:
        """Names of the options that are stated, error limit and threads aside, which all methods may be told."""
        told = {"max_error_rad", "threads"}
        return {item.name for item in fields(self) if item.name not in told and getattr(self, item.name) is not None}


@dataclass(frozen=True, slots=True)
class NormalField:
    """Normals of a cloud of n points, and how far they can be trusted.

    `normals` (n, 3) are unit vectors without a meaningful sign, NaN where `reason` (n,) is not GIVEN. `error_rad` (n,)
    is the predicted standard error of the direction, NaN where it cannot be told. `radius_mm` and `neighbours` (n,)
    describe the neighbourhood that was used, the point itself counted; for methods on the Delaunay triangulation the
    radius is that of the ball, infinite where the ball is a half-space, and the neighbours are 0. `extra` has further
    values (n,) of the method by name, with their unit. `notes` are sentences: what was decided on the way.
    """

    method: str
    normals: Float64Array
    reason: UInt8Array
    error_rad: Float64Array
    radius_mm: Float64Array
    neighbours: Int64Array
    notes: tuple[str, ...] = ()
    extra: Mapping[str, Float64Array] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("normals", "reason", "error_rad", "radius_mm", "neighbours"):
            read_only(getattr(self, name))
        for values in self.extra.values():
            read_only(values)

    def __len__(self) -> int:
        return len(self.reason)

    @property
    def reliable(self) -> BoolArray:
        """True where a normal is given."""
        return np.asarray(self.reason == NormalReason.GIVEN)

    def reasons(self) -> dict[str, int]:
        """Points by reason; those with a normal under `given`."""
        return {reason.name.lower(): int((self.reason == reason).sum()) for reason in NormalReason}
