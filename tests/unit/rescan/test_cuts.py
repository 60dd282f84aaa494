"""Chains of points across a gap: their widest steps, whatever the radius, and the rays through them."""

import numpy as np
import pytest
from numba import typeof

from scanner_service.rescan import cuts, unseen
from scanner_service.rescan.cuts import STEPS, compile_cuts, find_crossed, find_steps
from scanner_service.rescan.regions import find_regions
from tests.unit.rescan.synthetic_scan import snapshot_of, straight_down


def in_one_column(places: np.ndarray) -> tuple:
    return places, np.array([0, len(places)]), np.full(2, -1e3), 2e3, 1, 1


def steps_of(
    places: np.ndarray, borders: np.ndarray, start: list[float], end: list[float], reach: float,
    normals: np.ndarray | None = None, by_own: np.ndarray | None = None,
) -> np.ndarray:  # fmt: skip
    """The steps, as rows of the places, of which the last two are the start and the end; y is normal to the cut.

    Where nobody else shows anything all steps are the gap itself. Normals are not known, and no place is by the gap's
    own pass, unless told.
    """
    normals = np.full_like(places, np.nan) if normals is None else normals
    groups = np.ones(len(places), dtype=np.int64) if by_own is None else np.where(by_own, 0, 1)
    places, normals = np.vstack([places, start, end]), np.vstack([normals, np.full((2, 3), np.nan)])
    n = len(places)
    starts, ends = places[[n - 2]], places[[n - 1]]
    way = (ends - starts) / np.linalg.norm(ends - starts)
    found, alone = np.full((1, STEPS, 2), (n - 2, n - 1)), np.zeros(1, dtype=bool)
    find_steps(
        in_one_column(places), np.arange(n), np.append(groups, [0, 0]), normals, np.append(borders, [True, True]),
        starts, ends, way, np.array([[0.0, 1.0, 0.0]]), np.zeros(1, dtype=np.int64), np.array([reach]), found, alone,
    )  # fmt: skip
    assert not alone[0] or (found[0] == [n - 2, n - 1]).all()
    return found[0]


def corner(height: float, width: float, spacing: float) -> np.ndarray:
    """A wall from the top down to the floor, and the floor on from there."""
    z, x = np.arange(0.0, height, spacing), np.arange(0.0, width, spacing)
    wall = np.column_stack([0 * z, 0 * z, -z])
    return np.vstack([wall, np.column_stack([x, 0 * x, np.full_like(x, -height)])])


@pytest.mark.parametrize("longer", [10, 67, 100, 150, 400])
@pytest.mark.parametrize("reach", [0.02, 0.3, 5.0])
def test_a_gap_of_any_length_whose_wall_and_floor_are_seen_has_nothing_left(longer: int, reach: float) -> None:
    length = longer * reach
    height, width = 0.8 * length, 0.6 * length
    seen = corner(height, width, 0.7 * reach)
    steps = steps_of(seen, np.ones(len(seen), dtype=bool), [0.0, 0.0, 0.0], [width, 0.0, -height], reach)
    assert (steps < 0).all()


@pytest.mark.parametrize("longer", [10, 67, 150, 400])
def test_what_is_missing_of_the_floor_is_the_step(longer: int) -> None:
    reach = 0.3
    height, width = 0.8 * longer * reach, 0.6 * longer * reach
    seen = corner(height, width, 0.7 * reach)
    on_floor = seen[:, 2] <= -height
    seen = seen[~(on_floor & (seen[:, 0] > 0.3 * width) & (seen[:, 0] < 0.7 * width))]
    steps = steps_of(seen, np.ones(len(seen), dtype=bool), [0.0, 0.0, 0.0], [width, 0.0, -height], reach)
    assert (steps[1:] < 0).all()
    ends = np.sort(seen[steps[0], 0])
    assert ends == pytest.approx([0.3 * width, 0.7 * width], abs=0.01 * longer * reach + reach)


def test_behind_a_wider_step_without_a_border_the_missing_floor_is_told() -> None:
    """Two bodies in the cut, 5 mm apart and seen on all sides, and 3 mm of floor that nobody saw."""
    x = np.concatenate([np.arange(0.0, 3.0, 0.2), np.arange(8.0, 11.0, 0.2), np.arange(14.0, 16.0, 0.2)])
    places = np.column_stack([x, 0 * x, 0 * x])
    borders = (np.abs(x - 10.8) < 0.05) | (np.abs(x - 14.0) < 0.05)
    steps = steps_of(places, borders, [0.0, 0.0, 0.0], [16.0, 0.0, 0.0], 0.3)
    assert x[steps[0]] == pytest.approx([10.8, 14.0])
    assert (steps[1:] < 0).all()
    whole = steps_of(places, np.ones(len(x), dtype=bool), [0.0, 0.0, 0.0], [16.0, 0.0, 0.0], 0.3)
    assert x[whole[0]] == pytest.approx([2.8, 8.0]) and x[whole[1]] == pytest.approx([10.8, 14.0])


def thin_wall(height: float, thickness: float) -> tuple[np.ndarray, np.ndarray]:
    """The back of a thin wall, with normals away from the front at x = 0, which is what the gap hides."""
    z = np.arange(0.2, height - 1.0, 0.2)
    back = np.column_stack([np.full_like(z, -thickness), 0 * z, -z])
    return back, np.tile([-1.0, 0.0, 0.0], (len(z), 1))


def test_no_step_leads_through_a_body_to_its_other_side() -> None:
    back, away = thin_wall(10.0, 1.0)
    asked = (np.ones(len(back), dtype=bool), [0.0, 0.0, 0.0], [2.0, 0.0, -10.0], 0.3)
    steps = steps_of(back, *asked, away)
    assert steps[0].tolist() == [len(back), len(back) + 1] and (steps[1:] < 0).all()
    unknown = steps_of(back, *asked)
    assert (unknown[0] < len(back)).any()
    to_the_front = steps_of(back, *asked, -away)
    assert (to_the_front[0] < len(back)).any()


@pytest.mark.parametrize("off", [0.0, 0.05, 0.2])
def test_surface_that_the_gap_s_own_pass_has_shows_nothing_new(off: float) -> None:
    """A ledge below the rim: the same pass sees it at other places of its surface, and another pass beside it."""
    reach, x = 0.3, np.arange(0.5, 2.0, 0.2)
    own = np.column_stack([x, 0 * x, np.full_like(x, -3.0)])
    another = own + np.array([0.1, 0.05, off])
    up = np.tile([0.0, 0.0, 1.0], (2 * len(x), 1))
    by_own = np.arange(2 * len(x)) < len(x)
    steps = steps_of(
        np.vstack([own, another]), np.ones(2 * len(x), dtype=bool), [0.0, 0.0, 0.0], [2.0, 0.0, -8.0], reach, up, by_own
    )
    is_a_stone = bool((steps[0] < 2 * len(x)).any())
    assert is_a_stone == (off > reach / 2)


@pytest.mark.parametrize("longer", [1.2, 1.8, 2.5, 6.0])
def test_where_another_pass_shows_nothing_new_a_gap_of_any_length_stays_as_it_is(longer: float) -> None:
    reach = 0.3
    end = [0.3 * longer * reach, 0.0, -0.95 * longer * reach]
    x = np.arange(0.0, 1.0, 0.1)
    top = np.column_stack([-x, 0 * x, 0 * x])
    foot = np.column_stack([end[0] + x, 0 * x, np.full_like(x, end[2])])
    own, up = np.vstack([top, foot]), np.tile([0.0, 0.0, 1.0], (4 * len(x), 1))
    both, by_own = np.vstack([own, own + np.array([0.05, 0.02, 0.0])]), np.arange(4 * len(x)) < 2 * len(x)
    steps = steps_of(both, np.zeros(len(both), dtype=bool), [0.0, 0.0, 0.0], end, reach, up, by_own)
    assert (steps == [len(both), len(both) + 1]).all()


def test_steps_of_a_lattice_hang_on_no_order_of_its_points() -> None:
    """Where many distances are equal, as those of quantised points are."""
    rng = np.random.default_rng(6)
    for _ in range(40):
        u, v = (axis.ravel() for axis in np.meshgrid(np.arange(0.0, 6.0, 0.5), np.arange(0.0, 4.0, 0.5)))
        places = np.column_stack([u, 0 * u, -v])[rng.random(len(u)) < 0.3]
        n = len(places)
        ends = np.array([[0.0, 0.0, 0.0], [5.5, 0.0, -1.0]])
        told = []
        for order in (np.arange(n), rng.permutation(n)):
            found, alone = np.full((1, STEPS, 2), (n, n + 1)), np.zeros(1, dtype=bool)
            find_steps(
                in_one_column(np.vstack([places[order], ends])), np.append(order, [n, n + 1]),
                np.append(np.ones(n, dtype=np.int64), [0, 0]), np.full((n + 2, 3), np.nan), np.ones(n + 2, dtype=bool),
                ends[:1], ends[1:], (ends[1:] - ends[:1]) / np.linalg.norm(ends[1] - ends[0]),
                np.array([[0.0, 1.0, 0.0]]), np.zeros(1, dtype=np.int64), np.array([0.2]), found, alone,
            )  # fmt: skip
            told.append(found)
        assert (told[0] == told[1]).all()


@pytest.mark.parametrize(
    ("laser", "through"),
    [
        ([0.0, 0.0, 90.0], True),  # from above, onto a floor below the step
        ([90.0, 0.0, 0.0], False),  # along the step: it is looked past, not through
        ([0.0, 90.0, -2.5], False),  # all on one side of it
    ],
)
def test_rays_go_through_a_step_and_not_past_it(laser: list[float], through: bool) -> None:
    x = np.arange(-3.0, 3.0, 0.1)
    floor = np.column_stack([x, 0 * x, np.full_like(x, -2.0)])
    first, last = np.array([[-2.0, 0.0, 0.0]]), np.array([[2.0, 0.0, 0.0]])
    crossed = np.zeros(1, dtype=bool)
    find_crossed(
        in_one_column(floor), np.arange(len(x)), floor * [1.0, 1.0, 0.0] + laser, first, last,
        np.array([[0.0, 1.0, 0.0]]), np.array([0.3]), 0.5 * (first + last), np.array([5.0]), crossed,
    )  # fmt: skip
    assert crossed[0] == through


def test_fewer_rays_than_strays_may_be_go_through_nothing() -> None:
    floor = np.array([[-1.5, 0.0, -2.0], [-1.4, 0.0, -2.0], [1.5, 0.0, -2.0], [1.4, 0.0, -2.0], [0.0, 0.0, -2.0]])
    first, last, crossed = np.array([[-2.0, 0.0, 0.0]]), np.array([[2.0, 0.0, 0.0]]), np.zeros(1, dtype=bool)
    rest = (
        np.arange(5),
        floor * [1.0, 1.0, -45.0],
        first,
        last,
        np.array([[0.0, 1.0, 0.0]]),
        np.array([0.3]),
        first,
        np.array([9.0]),
    )
    find_crossed(in_one_column(floor), *rest, crossed)
    assert not crossed[0]


def test_what_is_compiled_before_a_scan_is_what_a_scan_calls(monkeypatch: pytest.MonkeyPatch) -> None:
    called: dict[str, list[object]] = {"find_steps": [], "find_crossed": []}
    for name, calls in called.items():
        kernel = getattr(cuts, name)

        def kept(*arguments, kernel=kernel, calls=calls):
            calls.append(tuple(typeof(one) for one in arguments))
            return kernel(*arguments)

        monkeypatch.setattr(cuts, name, kept)
        monkeypatch.setattr(unseen, name, kept)
    compile_cuts()
    cliff, x, y = (lambda x, y: np.where(y < 4.0, 0.0, 6.0)), np.arange(0.0, 6.0, 0.2), np.arange(0.0, 8.0, 0.3)
    scan = straight_down(cliff, x, y, 0.3).joined(straight_down(cliff, x, y + 0.15, 0.3, pass_number=2))
    find_regions(snapshot_of(scan))
    for calls in called.values():
        assert len(calls) >= 2
        other = [[at for at, one in enumerate(zip(calls[0], call, strict=True)) if one[0] != one[1]] for call in calls]
        assert not any(other), f"arguments of another type: {other}"
