"""One answer for every method on clouds without scanlines: normals, curvatures, reasons; knows no file and no job."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np

from drivers.scanline import Float64Array, read_only
from scanner_service.analysis.errors import MethodRefused, MethodUnknown
from scanner_service.analysis.normals.estimating import METHODS, estimate_normals
from scanner_service.analysis.normals.field import Int64Array, NormalOptions, NormalReason, Tell, tell_nobody
from scanner_service.analysis.orientation import Orientation, orient_normals
from scanner_service.analysis.orientation.telling import summarise_orientation, tell_orientation
from scanner_service.analysis.quadrics.field import QuadricKind, QuadricReason
from scanner_service.analysis.quadrics.local import NEEDED, SPARE_POINTS, local_quadrics
from scanner_service.analysis.snapshot import UInt8Array

QUADRICS: dict[str, QuadricKind] = {"bivariate_quadric": "bivariate", "general_quadric": "general"}
METHOD_NAMES = (*METHODS, *QUADRICS)


@dataclass(frozen=True, slots=True)
class MethodAnswer:
    """What a method says of n points.

    `normals` (n, 3), NaN where `reason` (n,), a number of `reasons`, is not 0. `scalars` are further values (n,) by
    name with their unit, `vectors` (n, 3) further directions. `notes` say what was decided on the way. `orientation`
    is there when the normals were turned to one side of the surface.
    """

    method: str
    normals: Float64Array
    reason: UInt8Array
    reasons: tuple[str, ...]
    neighbours: Int64Array
    scalars: Mapping[str, Float64Array]
    vectors: Mapping[str, Float64Array]
    notes: tuple[str, ...]
    orientation: Orientation | None = None

    def __post_init__(self) -> None:
        for values in (self.normals, *self.scalars.values(), *self.vectors.values()):
            read_only(values)
        read_only(self.reason)
        read_only(self.neighbours)

    def __len__(self) -> int:
        return len(self.reason)

    @property
    def counts(self) -> dict[str, int]:
        """Points by reason; those that have an answer under `given`."""
        return {name: int((self.reason == number).sum()) for number, name in enumerate(self.reasons)}


def analyse_by_method(
    points_mm: Float64Array,
    method: str,
    options: NormalOptions | None = None,
    *,
    towards_mm: Float64Array | None = None,
    orient: bool = False,
    tell: Tell = tell_nobody,
) -> MethodAnswer:
    """Run a method of METHOD_NAMES on points (n, 3), and turn its normals towards a place, or to one side.

    `towards_mm` is (3,) for all or (n, 3), one a point, such as the laser position of its scanline; without it normals
    are turned to +z. With `orient` they are turned to the outside of the surface instead (`orient_normals`), and the
    scalars say the component of each point and whether its side is known. Where curvatures are given their signs turn
    with the normal: positive bends towards it.

    Raises
    ------
    MethodUnknown, MethodRefused : as `estimate_normals` has them; quadrics read no other option than `radius_mm`.
    """
    options = options or NormalOptions()
    if method not in METHOD_NAMES:
        raise MethodUnknown(f"there is no method {method}; the methods are {', '.join(METHOD_NAMES)}")
    points = np.asarray(points_mm, dtype=np.float64).reshape(-1, 3)
    check_options(method, options)
    answer = _quadrics(points, method, options, tell) if method in QUADRICS else _normals(points, method, options, tell)
    if orient:
        return _oriented(answer, points)
    towards = np.array([0.0, 0.0, 1.0]) if towards_mm is None else towards_mm - points
    return _turned(answer, towards, towards_mm is None)


def check_options(method: str, options: NormalOptions) -> None:
    """Raise MethodRefused when an option is stated that a method of METHOD_NAMES does not read."""
    if method in METHODS:
        METHODS[method].check(options)
    elif options.given() - {"radius_mm"}:
        raise MethodRefused(f"{method} takes radius_mm alone: leave the other options out")


def _normals(points: Float64Array, method: str, options: NormalOptions, tell: Tell) -> MethodAnswer:
    field = estimate_normals(points, method, options, tell)
    scalars = {"normal_error_rad": field.error_rad, "radius_mm": field.radius_mm, **field.extra}
    return MethodAnswer(
        method, field.normals, field.reason, _names(NormalReason), field.neighbours, scalars, {}, field.notes
    )


def _quadrics(points: Float64Array, method: str, options: NormalOptions, tell: Tell) -> MethodAnswer:
    kind = QUADRICS[method]
    needed = NEEDED[kind]
    if int(np.isfinite(points).all(axis=1).sum()) < needed + SPARE_POINTS:
        raise MethodRefused(f"{method} needs {needed + SPARE_POINTS} points or more with finite coordinates")
    stated = None if options.radius_mm is None else np.full(len(points), options.radius_mm)
    field = local_quadrics(points, kind, radius_mm=stated, tell=tell)
    scalars = {
        "curvature_1_per_mm": field.curvature_per_mm[:, 0],
        "curvature_2_per_mm": field.curvature_per_mm[:, 1],
        "distance_mm": field.distance_mm,
        "residual_mm": field.residual_mm,
        "radius_mm": field.radius_mm,
    }
    vectors = {"direction_1": field.direction[:, 0], "direction_2": field.direction[:, 1]}
    return MethodAnswer(
        method, field.normals, field.reason, _names(QuadricReason), field.neighbours, scalars, vectors, ()
    )


def _names(reasons: type[IntEnum]) -> tuple[str, ...]:
    return tuple(reason.name.lower() for reason in reasons)


def _oriented(answer: MethodAnswer, points: Float64Array) -> MethodAnswer:
    """The answer with its normals on one side of the surface; points without a normal have no component."""
    if not (answer.reason == 0).any():
        raise MethodRefused(
            f"{answer.method} gives no point a normal, so there is nothing to orient: allow a larger error or radius"
        )
    found = orient_normals(points, answer.normals)
    turned = _turned(answer, np.nan_to_num(found.normals), upwards=False)
    has = found.component >= 0
    told = {"component": np.where(has, found.component, np.nan), "sure": np.where(has, found.sure, np.nan)}
    notes = (*turned.notes, *tell_orientation(found))
    return replace(turned, scalars={**turned.scalars, **told}, notes=notes, orientation=found)


def _turned(answer: MethodAnswer, towards: Float64Array, upwards: bool) -> MethodAnswer:
    """The answer with its normals towards `towards`, (3,) or (n, 3)."""
    flip = (answer.normals * towards).sum(axis=1) < 0.0
    scalars, vectors = dict(answer.scalars), dict(answer.vectors)
    if "curvature_1_per_mm" in scalars:
        first, second = scalars["curvature_1_per_mm"], scalars["curvature_2_per_mm"]
        scalars["curvature_1_per_mm"] = np.where(flip, -second, first)
        scalars["curvature_2_per_mm"] = np.where(flip, -first, second)
        one, two = vectors["direction_1"], vectors["direction_2"]
        vectors["direction_1"] = np.where(flip[:, None], two, one)
        vectors["direction_2"] = np.where(flip[:, None], one, two)
    notes = answer.notes
    if upwards:
        notes += ("nothing tells where the cloud was seen from: normals are turned upwards (+z)",)
    return MethodAnswer(
        answer.method,
        np.where(flip[:, None], -answer.normals, answer.normals),
        answer.reason,
        answer.reasons,
        answer.neighbours,
        scalars,
        vectors,
        notes,
    )


def summarise_answer(answer: MethodAnswer) -> dict[str, object]:
    """Counts, notes, and smallest, median and largest of every scalar that is known somewhere."""
    spread: dict[str, object] = {}
    for name, values in answer.scalars.items():
        finite = values[np.isfinite(values)]
        if len(finite):
            spread[name] = {
                "min": float(finite.min()),
                "median": float(np.median(finite)),
                "max": float(finite.max()),
            }
        else:
            spread[name] = None
    return {
        "method": answer.method,
        "points": len(answer),
        "reasons": answer.counts,
        "notes": list(answer.notes),
        **spread,
        **({} if answer.orientation is None else {"orientation": summarise_orientation(answer.orientation)}),
    }
