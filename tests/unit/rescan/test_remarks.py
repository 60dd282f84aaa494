"""What is said of a requirement that a scan cannot meet, or that lies beside it; and nothing of any other."""

import numpy as np
import pytest

from scanner_service.rescan.remarks import remarks_on
from scanner_service.rescan.requirement import Interest, Requirement
from tests.unit.rescan.synthetic_scan import Scan, snapshot_of, straight_down

X, Y = np.arange(-4, 4, 0.2), np.arange(0, 14, 0.3)


@pytest.fixture(scope="module")
def plate() -> Scan:
    return straight_down(lambda x, y: 0.0 * x, X, Y, 0.3)


@pytest.mark.parametrize(
    ("density_per_mm2", "is_told"), [(None, False), (16.0, False), (99.0, False), (101.0, True), (1e5, True)]
)
def test_a_density_is_remarked_where_one_pass_cannot_give_it(
    plate: Scan, density_per_mm2: float | None, is_told: bool
) -> None:
    said = remarks_on(Requirement(density_per_mm2=density_per_mm2), snapshot_of(plate))  # 0.2 mm by 0.05 mm: 100
    assert bool(said) == is_told and all(
        "0.2 mm apart on lines 0.05 mm apart are 100 points/mm²" in one for one in said
    )


def test_a_region_of_interest_without_a_point_is_remarked_once_the_pass_is_over(plate: Scan) -> None:
    aside = Requirement(interest=Interest((100.0, 0.0, -1.0), (110.0, 10.0, 1.0)))
    (said,) = remarks_on(aside, snapshot_of(plate))
    assert "no point" in said and "x -4.0 to 3.8" in said
    assert remarks_on(aside, snapshot_of(plate, unsettled=lambda points: points[:, 1] > 13.0)) == ()  # it goes on yet
    assert remarks_on(Requirement(interest=Interest((3.0, 0.0, -1.0), (110.0, 10.0, 1.0))), snapshot_of(plate)) == ()


def test_densities_below_one_are_told_as_what_they_are() -> None:
    coarse = straight_down(lambda x, y: 0.0 * x, np.arange(-40, 40, 2.5), np.arange(0, 40, 1.0), 1.0)
    wanted = Requirement(density_per_mm2=0.6, finest_line_spacing_mm=1.0)
    (said,) = remarks_on(wanted, snapshot_of(coarse))
    assert "a density of 0.6 points/mm² is more" in said and "are 0.4 points/mm²" in said
