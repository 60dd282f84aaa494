"""What a local quadric fit says of each point of a cloud; knows no fit."""

from dataclasses import dataclass
from enum import IntEnum
from typing import Literal

import numpy as np

from drivers.scanline import BoolArray, Float64Array, read_only
from scanner_service.analysis.normals.field import Int64Array
from scanner_service.analysis.snapshot import UInt8Array

QuadricKind = Literal["bivariate", "general"]


class QuadricReason(IntEnum):
    """Why a point has no quadric."""

    GIVEN = 0
    NOT_FINITE = 1
    """The point has a coordinate that is NaN or infinite."""
    TOO_FEW = 2
    """The whole cloud, or the ball of the largest radius, holds too few points."""
    UNDETERMINED = 3
    """The points do not determine the coefficients: they lie on a line or a curve, or in one place."""


@dataclass(frozen=True, slots=True)
class QuadricField:
    """Local quadrics of n points.

    `curvature_per_mm` (n, 2) are the principal curvatures at the foot of the point on its quadric, the larger first,
    positive where the surface bends towards the normal; `direction` (n, 2, 3) their unit directions. `normals` (n, 3)
    are those of the quadric at the foot, their sign without meaning (turned, they turn the curvatures' signs with
    them). `distance_mm` (n,) is how far the point lies from the quadric, `residual_mm` (n,) the root of the fit's mean
    squared residual per degree of freedom. `radius_mm` and `neighbours` (n,) describe the neighbourhood. NaN where
    `reason` (n,) is not GIVEN.
    """

    kind: QuadricKind
    curvature_per_mm: Float64Array
    direction: Float64Array
    normals: Float64Array
    distance_mm: Float64Array
    residual_mm: Float64Array
    radius_mm: Float64Array
    neighbours: Int64Array
    reason: UInt8Array

    def __post_init__(self) -> None:
        for name in (
            *("curvature_per_mm", "direction", "normals", "distance_mm"),
            *("residual_mm", "radius_mm", "neighbours", "reason"),
        ):
            read_only(getattr(self, name))

    def __len__(self) -> int:
        return len(self.reason)

    @property
    def given(self) -> BoolArray:
        """True where there is a quadric."""
        return np.asarray(self.reason == QuadricReason.GIVEN)

    def reasons(self) -> dict[str, int]:
        """Points by reason; those with a quadric under `given`."""
        return {reason.name.lower(): int((self.reason == reason).sum()) for reason in QuadricReason}
