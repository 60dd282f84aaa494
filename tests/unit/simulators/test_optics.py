"""Laws of the laser-line scanner: where it sees, where it cannot, and how well."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from drivers.scanline import Pose
from simulators.optics import LaserLineScanner, Return, demo_scanner, dropout_probability
from simulators.shapes import Difference, Sphere, Union, box, half_space

PLATE = half_space((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
SPACING_MM = 0.1


def clean(**changes: object) -> LaserLineScanner:
    """The demo's scanner without noise and dropout."""
    return replace(demo_scanner(), **({"noise_mm": 0.0, "dropout_exponent": np.inf} | changes))  # type: ignore[arg-type]


def at(y_mm: float, z_mm: float = 0.0) -> Pose:
    return Pose(np.eye(3), np.array([0.0, y_mm, z_mm]))


def any_rng() -> np.random.Generator:
    return np.random.default_rng(7)


def tilted(angle_rad: float) -> Pose:
    """A sensor turned about its x axis around its own origin."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return Pose(np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]]), np.zeros(3))


def runs(flags: npt.NDArray[np.bool_]) -> int:
    """How many separate runs of True there are."""
    return int((np.diff(flags.astype(int), prepend=0) == 1).sum())


def test_the_demo_scanner_is_the_one_that_was_asked_for() -> None:
    scanner = demo_scanner()
    assert 0.12 <= scanner.point_spacing_mm <= 0.15
    assert np.degrees(scanner.camera_angle_rad) == pytest.approx(27.0)
    geometry = scanner.geometry()
    assert geometry.range_mm == (-30.0, 30.0)
    assert geometry.noise_mm == 0.01
    np.testing.assert_array_equal(geometry.laser_mm, [0.0, 0.0, 150.0])


def test_on_a_plate_at_zero_the_points_are_evenly_spaced_over_the_field_of_view() -> None:
    x_mm, z_mm = clean().expose(PLATE, at(0.0), any_rng())
    np.testing.assert_allclose(x_mm, np.linspace(-25.0, 25.0, 400), atol=1e-9)
    np.testing.assert_allclose(z_mm, 0.0, atol=1e-9)


def test_moving_sensor_and_part_together_changes_nothing() -> None:
    turn = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    moved = Pose(turn, np.array([40.0, -30.0, 20.0]))
    normal = moved.rotate(np.array([0.0, 0.6, 0.8]))
    still = clean().expose(half_space((0.0, 0.0, 5.0), (0.0, 0.6, 0.8)), at(3.0), any_rng())
    turned = clean().expose(
        half_space(tuple(moved.apply(np.array([0.0, 0.0, 5.0]))), tuple(normal)), moved @ at(3.0), any_rng()
    )
    np.testing.assert_allclose(turned, still, atol=1e-9)


def test_a_step_throws_a_camera_shadow_of_height_times_the_tangent_of_the_camera_angle() -> None:
    height = 8.0
    scanner = clean()
    wall = Union(PLATE, box((-60.0, 0.0, -1.0), (60.0, 50.0, height)))
    positions = np.arange(-10.0, -SPACING_MM / 2, SPACING_MM)
    hidden = np.array([scanner.trace(wall, at(y), any_rng()).outcome[200] == Return.CAMERA_SHADOW for y in positions])
    width = height * np.tan(scanner.camera_angle_rad)
    assert runs(hidden) == 1
    assert hidden[-1]
    assert hidden.sum() * SPACING_MM == pytest.approx(width, abs=SPACING_MM)


def test_the_side_away_from_the_camera_is_hidden_and_the_side_towards_it_is_not() -> None:
    ridge = Union(PLATE, box((-60.0, 0.0, -1.0), (60.0, 2.0, 8.0)))
    before = clean().trace(ridge, at(-1.0), any_rng()).outcome
    behind = clean().trace(ridge, at(3.0), any_rng()).outcome
    assert (before == Return.CAMERA_SHADOW).all()
    assert (behind == Return.SEEN).all()


def test_the_fan_throws_a_laser_shadow_that_grows_with_the_distance_from_its_middle() -> None:
    height, edge = 10.0, 12.0
    scanner = clean()
    block = Union(PLATE, box((5.0, -80.0, -1.0), (edge, 80.0, height)))
    x_mm, z_mm = scanner.expose(block, at(0.0), any_rng())
    floor = x_mm[(np.abs(z_mm) < 1e-6) & (x_mm > edge)]
    shadow = edge * height / (scanner.laser_mm[2] - height)
    assert floor.min() - edge == pytest.approx(shadow, abs=scanner.point_spacing_mm)
    near_side = x_mm[(np.abs(z_mm) < 1e-6) & (x_mm < 5.0)]
    assert near_side.max() == pytest.approx(5.0, abs=scanner.point_spacing_mm), "the side to the middle is lit"


def test_the_pocket_of_both_shadows_is_seen_only_where_both_have_their_line_of_sight() -> None:
    scanner = clean()
    depth, y_high = 12.0, 10.0
    part = Difference(PLATE, box((8.0, 0.0, -depth), (20.0, y_high, 1.0)))
    laser, camera = scanner.laser_mm, scanner.camera_mm
    for y in np.arange(0.55, 9.9, 0.5):
        exposure = scanner.trace(part, at(float(y)), any_rng())
        floor = np.abs(exposure.truth_mm[:, 2] + depth) < 1e-6
        # On the way from (x, y, -depth) to the camera at (0, y + c, h) the ray passes z = 0 at this share of it.
        share = depth / (camera[2] + depth)
        passes_y = y + share * camera[1]
        passes_x = exposure.truth_mm[floor, 0] * (1.0 - share)
        visible = (passes_y < y_high) & (passes_x > 8.0) & (passes_x < 20.0)
        np.testing.assert_array_equal(exposure.outcome[floor] == Return.SEEN, visible)
        lit = exposure.truth_mm[floor, 0]
        assert lit.min() == pytest.approx(8.0 * (laser[2] + depth) / laser[2], abs=scanner.point_spacing_mm * 1.1)


@pytest.mark.parametrize("z_mm", [-29.9, 29.9])
def test_inside_the_range_everything_returns(z_mm: float) -> None:
    x, z = clean().expose(half_space((0.0, 0.0, z_mm), (0.0, 0.0, 1.0)), at(0.0), any_rng())
    np.testing.assert_allclose(z, z_mm, atol=1e-9)
    assert np.isfinite(x).all()


@pytest.mark.parametrize("z_mm", [-30.1, 30.1])
def test_outside_the_range_nothing_returns_and_the_reason_is_told(z_mm: float) -> None:
    exposure = clean().trace(half_space((0.0, 0.0, z_mm), (0.0, 0.0, 1.0)), at(0.0), any_rng())
    assert np.isnan(exposure.x_mm).all()
    assert (exposure.outcome == Return.OUT_OF_RANGE).all()


def test_with_noise_nothing_outside_range_or_fan_is_reported_either() -> None:
    scanner = replace(demo_scanner(), noise_mm=3.0)
    rng = any_rng()
    for z in (-30.0, -28.0, 28.0, 30.0):
        x_mm, z_mm = scanner.expose(half_space((0.0, 0.0, z), (0.0, 0.0, 1.0)), at(0.0), rng)
        seen = np.isfinite(z_mm)
        assert seen.any()
        assert ((z_mm[seen] >= -30.0) & (z_mm[seen] <= 30.0)).all()
        assert (np.abs(x_mm[seen]) <= 25.0 * (150.0 - z_mm[seen]) / 150.0 + 1e-9).all()


def test_every_ray_has_exactly_one_outcome_and_only_the_seen_have_coordinates() -> None:
    part = Union(box((-20.0, -20.0, -40.0), (20.0, 20.0, -35.0)), Sphere((0.0, 0.0, 0.0), 12.0))
    exposure = demo_scanner().trace(part, at(-11.0), any_rng())
    seen = exposure.outcome == Return.SEEN
    np.testing.assert_array_equal(np.isfinite(exposure.x_mm), seen)
    np.testing.assert_array_equal(np.isfinite(exposure.z_mm), seen)
    np.testing.assert_array_equal(np.isnan(exposure.truth_mm[:, 0]), exposure.outcome == Return.NO_SURFACE)
    assert {Return.NO_SURFACE, Return.CAMERA_SHADOW, Return.OUT_OF_RANGE} <= set(exposure.outcome.tolist())


def test_an_open_sheet_is_not_seen_through_by_a_camera_on_its_other_side() -> None:
    # Steeper than the camera's line of sight and leaning away from it: the laser lights it, the camera sees its back.
    lean = np.radians(70.0)
    outcome = clean().trace(half_space((0.0, 0.0, 0.0), (0.0, -np.sin(lean), np.cos(lean))), at(0.0), any_rng()).outcome
    assert (outcome == Return.CAMERA_SHADOW).all()


def test_noise_has_the_stated_deviation_along_the_laser_ray_and_no_bias() -> None:
    scanner = clean(noise_mm=0.01)
    rng = np.random.default_rng(11)
    along = []
    for _ in range(100):
        exposure = scanner.trace(PLATE, at(0.0), rng)
        reported = np.column_stack([exposure.x_mm, np.zeros(400), exposure.z_mm])
        rays = exposure.truth_mm - scanner.laser_mm
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        offset = reported - exposure.truth_mm
        along.append(np.einsum("ij,ij->i", offset, rays))
        np.testing.assert_allclose(offset - along[-1][:, None] * rays, 0.0, atol=1e-9)
    noise = np.concatenate(along)
    assert np.std(noise) == pytest.approx(0.01, rel=0.02)
    assert abs(np.mean(noise)) < 4 * 0.01 / np.sqrt(noise.size)


def test_dropout_is_impossible_head_on_certain_at_grazing_and_grows_in_between() -> None:
    angles = np.linspace(0.0, np.pi / 2, 91)
    chance = dropout_probability(angles, 4.0)
    assert chance[0] == 0.0
    assert chance[-1] == pytest.approx(1.0)
    assert (np.diff(chance) > 0).all()


def test_dropout_happens_as_often_as_stated() -> None:
    scanner = clean(dropout_exponent=4.0)
    rng = np.random.default_rng(12)
    shares = []
    for angle in np.radians([0.0, 40.0, 60.0, 75.0]):
        plane = half_space((0.0, 0.0, 0.0), (0.0, np.sin(angle), np.cos(angle)))
        exposures = [scanner.trace(plane, at(0.0), rng) for _ in range(50)]
        lost = np.concatenate([exposure.outcome == Return.DROPOUT for exposure in exposures])
        stated = np.mean([dropout_probability(exposure.incidence_rad, 4.0).mean() for exposure in exposures])
        assert lost.mean() == pytest.approx(stated, abs=4 * np.sqrt(stated / lost.size) + 1e-12)
        shares.append(lost.mean())
    assert shares[0] < 1e-3
    assert shares == sorted(shares)


def test_the_incidence_is_the_tilt_of_the_surface() -> None:
    angle = np.radians(50.0)
    exposure = clean(points_per_line=401).trace(PLATE, tilted(angle), any_rng())
    assert exposure.incidence_rad[200] == pytest.approx(angle)


def test_the_same_seed_gives_the_same_line() -> None:
    part = Sphere((0.0, 0.0, 0.0), 12.0)
    first = demo_scanner().expose(part, at(1.0), np.random.default_rng(3))
    second = demo_scanner().expose(part, at(1.0), np.random.default_rng(3))
    np.testing.assert_array_equal(first, second)


def test_impossible_scanners_are_refused() -> None:
    with pytest.raises(ValueError, match="own plane"):
        clean(laser_mm=np.array([0.0, 1.0, 150.0]))
    with pytest.raises(ValueError, match="measurement range"):
        clean(range_mm=(-30.0, 200.0))
    with pytest.raises(ValueError, match="two points"):
        clean(points_per_line=1)
