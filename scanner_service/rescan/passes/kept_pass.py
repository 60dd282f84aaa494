"""A recommended pass as the record keeps it, and back again; believes no length that it has not counted."""

import base64
import binascii
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from drivers.scanline import Float64Array, Pose
from scanner_service.rescan.passes.motion import Motion, StraightMotion, TurningMotion
from scanner_service.rescan.passes.needs import FIRST_CHANCES, Evidence
from scanner_service.rescan.passes.promises import FIRST_BRINGS, FIRST_SPREADS, Experience
from scanner_service.rescan.passes.reach import PartTurn
from scanner_service.rescan.passes.recommendation import Promise, RecommendedPass, pose_dict

_COLUMNS = 11  # a place (3), where it faces (3), what is expected of it, its area, its region, its evidence, tried
_FORMER_COLUMNS = 10  # without the last
_FORMER_TRIED = 0.45  # then places of which less than this was left of what their kind brings passed for tried
_MOST_PLACES = 20_000


def keep_pass(one: RecommendedPass) -> dict[str, Any]:
    """Everything of a pass as JSON; the places it serves as base64 of float32 rows."""
    rows = np.column_stack(
        [
            one.places_mm, one.place_normals, one.place_mm2, one.place_area_mm2, one.place_regions, one.place_evidence,
            one.place_tried,
        ]
    )  # fmt: skip
    return {
        "number": one.number,
        "motion": keep_motion(one.motion),
        "start_mm": one.start_mm,
        "end_mm": one.end_mm,
        "line_spacing_mm": one.line_spacing_mm,
        "line_rate_hz": one.line_rate_hz,
        "duration_s": one.duration_s,
        "approach_s": one.approach_s,
        "promises": [
            [each.region, each.gain_mm2, each.density_per_mm2, each.incidence_rad, each.largest_incidence_rad]
            for each in one.promises
        ],
        "columns": _COLUMNS,
        "places": base64.b64encode(rows.astype("<f4").tobytes()).decode("ascii"),
        "turn": None
        if one.turn is None
        else [one.turn.about_vertical_rad, one.turn.tip_rad, *(one.turn.about_mm or ())],
        "chances": list(one.learned.chances),
        "spreads": list(one.learned.spreads),
        "brings": list(one.learned.brings),
    }


def kept_pass(kept: Mapping[str, Any]) -> RecommendedPass:
    """The pass that `keep_pass` kept.

    Raises
    ------
    KeyError, TypeError, ValueError : it was not kept so.
    """
    try:
        raw = base64.b64decode(kept["places"], validate=True)
    except binascii.Error as error:
        raise ValueError(f"the places of a kept pass cannot be read: {error}") from None
    columns = int(kept.get("columns", _FORMER_COLUMNS))
    if columns not in (_COLUMNS, _FORMER_COLUMNS):
        raise ValueError(f"the places of a kept pass are told in {columns} numbers each, which nobody knows to read")
    if len(raw) % (4 * columns) or len(raw) > 4 * columns * _MOST_PLACES:
        raise ValueError(f"the places of a kept pass have {len(raw)} bytes, which are no rows of {columns} numbers")
    rows = np.frombuffer(raw, dtype="<f4").reshape(-1, columns).astype(np.float64)
    numbers = {
        name: float(kept[name])
        for name in (
            "start_mm", "end_mm", "line_spacing_mm", "line_rate_hz", "duration_s", "approach_s",
        )
    }  # fmt: skip
    turn = kept["turn"]
    chances = _by_kind(kept["chances"], FIRST_CHANCES)
    brings = _by_kind(kept["brings"], FIRST_BRINGS) if "brings" in kept else chances  # once both were one
    learned = Experience(chances, _by_kind(kept.get("spreads", ()), FIRST_SPREADS), brings)
    mm2, area_mm2, evidence = rows[:, 6].copy(), rows[:, 7].copy(), rows[:, 9].copy()
    if not np.isin(evidence, list(Evidence)).all():
        raise ValueError("a kept pass has places of a kind of evidence that nobody knows")
    former = mm2 <= _FORMER_TRIED * area_mm2 * np.array(chances)[evidence.astype(np.int64)]
    return RecommendedPass(
        number=int(kept["number"]),
        motion=kept_motion(kept["motion"]),
        promises=tuple(Promise(int(region), *map(float, told)) for region, *told in kept["promises"]),
        places_mm=rows[:, :3].copy(),
        place_normals=rows[:, 3:6].copy(),
        place_mm2=mm2,
        place_area_mm2=area_mm2,
        place_regions=rows[:, 8].copy(),
        place_evidence=evidence,
        place_tried=rows[:, 10] > 0 if columns == _COLUMNS else former,
        turn=None if turn is None else _kept_turn([float(value) for value in turn]),
        learned=learned,
        **numbers,
    )


def _by_kind(kept: Sequence[Any], first: tuple[float, ...]) -> tuple[float, ...]:
    """A number for each kind of evidence; of a time when fewer kinds were told apart the first ones stand in."""
    if len(kept) > len(Evidence):
        raise ValueError(f"a kept pass tells of {len(kept)} kinds of evidence, and there are {len(Evidence)}")
    return (*map(float, kept), *first[len(kept) :])


def _kept_turn(turn: list[float]) -> PartTurn:
    if len(turn) not in (2, 5):
        raise ValueError(f"a turn of the part has two angles, and a point since that is kept, not {len(turn)} numbers")
    return PartTurn(turn[0], turn[1], None if len(turn) == 2 else (turn[2], turn[3], turn[4]))


def keep_motion(motion: Motion) -> dict[str, Any]:
    """A motion as JSON."""
    kept: dict[str, Any] = {"at_zero": pose_dict(motion.at_zero)}
    if isinstance(motion, StraightMotion):
        return kept | {"travel": motion.travel.tolist()}
    return kept | {"axis": motion.axis.tolist(), "radius_mm": motion.radius_mm}


def kept_motion(kept: Mapping[str, Any]) -> Motion:
    """The motion that `keep_motion` kept; raises KeyError, TypeError or ValueError when it was not kept so."""
    pose = kept["at_zero"]
    at_zero = Pose(_numbers(pose["rotation"], (3, 3)), _numbers(pose["translation_mm"], (3,)))
    if "travel" in kept:
        return StraightMotion(at_zero, _numbers(kept["travel"], (3,)))
    return TurningMotion(at_zero, _numbers(kept["axis"], (3,)), float(kept["radius_mm"]))


def _numbers(kept: Any, shape: tuple[int, ...]) -> Float64Array:
    found = np.array(kept, dtype=np.float64)
    if found.shape != shape or not np.isfinite(found).all():
        raise ValueError(f"{kept!r} is not {shape} finite numbers")
    return found
