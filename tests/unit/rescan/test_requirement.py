"""What may be required, and what is refused."""

import json

import numpy as np
import pytest

from scanner_service.rescan.presets import PRESETS, preset_of, requirement_of
from scanner_service.rescan.requirement import Interest, Requirement, RequirementUnusable
from scanner_service.sessions.settings import SessionSettings


def test_by_default_half_of_the_nominal_density_is_required() -> None:
    required = Requirement().per_mm2(np.array([0.2, 0.5]), np.array([0.1, np.nan]))
    np.testing.assert_allclose(required, [25.0, np.nan])


def test_a_stated_density_is_required_everywhere() -> None:
    required = Requirement(density_per_mm2=12.0).per_mm2(np.array([0.2, 0.5]), np.array([0.1, np.nan]))
    np.testing.assert_allclose(required, [12.0, 12.0])


@pytest.mark.parametrize(
    ("stated", "radius_mm", "least"), [(None, 0.2, 1.0), (None, 1.0, np.pi), (0.3, 1.0, 0.3), (0.0, 1.0, 0.0)]
)
def test_the_least_area_is_the_one_stated_or_one_square_millimetre_or_the_disc_of_a_neighbourhood(
    stated: float | None, radius_mm: float, least: float
) -> None:
    assert Requirement(region_area_mm2=stated).least_area_mm2(radius_mm) == pytest.approx(least)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("density_per_mm2", 0.0),
        ("density_per_mm2", -1.0),
        ("density_per_mm2", float("nan")),
        ("density_per_mm2", float("inf")),
        ("density_share", 0.0),
        ("density_share", 1.5),
        ("radius_constant_mm", 0.0),
        ("noise_factor", 0.5),
        ("region_points", 0),
        ("region_area_mm2", -0.1),
        ("region_area_mm2", float("nan")),
        ("region_angle_deg", 0.0),
        ("search_mm", -2.0),
    ],
)
def test_an_unusable_requirement_is_refused_by_name(field: str, value: float) -> None:
    with pytest.raises(RequirementUnusable, match=field):
        Requirement(**{field: value})


@pytest.mark.parametrize(
    ("asked", "says"),
    [
        ({"line_spacing_mm": 0.04}, "finest_line_spacing_mm"),
        ({"chord_error_mm": 0.01, "noise_mm": 0.02}, "chord error"),
        ({"incidence_rad": 2.0}, "incidence"),
        ({"coverage_share": 1.5}, "coverage_share"),
        ({"chord_error_mm": float("nan")}, "chord_error_mm"),
        ({"region_area_mm2": 50.0, "interest": Interest((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))}, "region of interest"),
        ({"preset": "finest"}, "presets are"),
    ],
)
def test_requirements_that_contradict_themselves_are_refused_with_the_reason(asked: dict, says: str) -> None:
    with pytest.raises(RequirementUnusable, match=says):
        requirement_of(**asked)


def test_a_requirement_below_the_scanner_s_own_noise_is_refused_and_an_empty_box_too() -> None:
    with pytest.raises(RequirementUnusable, match="own noise"):
        SessionSettings(noise_mm=0.05, target=Requirement(noise_mm=0.02))
    with pytest.raises(RequirementUnusable, match="empty"):
        Interest((0.0, 0.0, 0.0), (1.0, 0.0, 1.0))


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_presets_survive_the_record(name: str) -> None:
    asked = requirement_of(name, interest=Interest((0.0, 0.0, 0.0), (1.0, 2.0, 3.0)))
    settings = SessionSettings(target=asked, noise_mm=0.001)
    kept = json.loads(json.dumps(settings.to_dict(), allow_nan=False))
    assert SessionSettings.from_dict(kept) == settings
    assert settings.requirement().coverage_share == PRESETS[name].coverage_share


def test_a_density_that_an_older_record_has_beside_the_target_is_asked_for_still() -> None:
    kept = SessionSettings().to_dict()
    assert SessionSettings.from_dict({**kept, "density_per_mm2": 8.0}).requirement().density_per_mm2 == 8.0
    assert SessionSettings.from_dict({**kept, "density_per_mm2": None}) == SessionSettings()


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_a_preset_is_known_by_what_it_asks_for(name: str) -> None:
    assert preset_of(PRESETS[name]) == preset_of(SessionSettings(target=PRESETS[name], noise_mm=0.0).requirement())
    assert preset_of(PRESETS[name]) == name
    assert preset_of(requirement_of(name, coverage_share=0.5)) is None
