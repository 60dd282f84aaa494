"""A client that keeps what it is told of regions knows them all, as they are."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scanner_service.api.live_regions import RegionsTold
from scanner_service.rescan.judgement import Reason
from scanner_service.rescan.region import RegionMoment, RegionStatus, RescanRegion


def region(region_id: int, area_mm2: float = 1.0, side_mm: float = 1.0) -> RescanRegion:
    ring = side_mm * np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0]])
    return RescanRegion(
        1, Reason.STEEP, (ring,), area_mm2, np.zeros(3), np.full(3, np.nan), 1.0, 2.0, 0.1, 0.5, 3, "turn it",
        np.arange(3), region_id=region_id,
    )  # fmt: skip


REPORTS = st.lists(
    st.dictionaries(st.integers(1, 6), st.tuples(st.sampled_from([1.0, 2.0]), st.sampled_from([1.0, 3.0])), max_size=6),
    max_size=6,
)


@given(REPORTS)
def test_what_was_told_adds_up_to_the_list(reports: list[dict[int, tuple[float, float]]]) -> None:
    told, known = RegionsTold(), {}
    for report in reports:
        regions = [
            replace(region(number, *look), number=at) for at, (number, look) in enumerate(report.items(), start=1)
        ]
        news = told.news(regions)
        known |= {one["id"]: one for one in news["regions"]}
        known = {number: known[number] for number in news["order"]}
        listed = [one.to_dict() | {"number": None} for one in regions]
        assert [one | {"number": None} for one in known.values()] == listed


def test_what_has_not_changed_is_not_told_again_even_in_another_place() -> None:
    told = RegionsTold()
    assert len(told.news([region(1), region(2)])["regions"]) == 2
    news = told.news([replace(region(2), number=2), region(1)])
    assert news == {"order": [2, 1], "regions": []}
    news = told.news([region(1, side_mm=2.0)])
    assert (news["order"], [one["id"] for one in news["regions"]]) == ([1], [1])


@pytest.mark.parametrize(
    "change",
    [
        {"normal": np.array([0.0, 0.0, 1.0])},
        {"line_spacing_mm": 0.3},
        {"counting_error_per_mm2": 0.2},
        {"remedy": "scan it again"},
        {"status": RegionStatus.RESCANNED},
        {"history": (RegionMoment(3, RegionStatus.OPEN, 1.0, 0.5, "found"),)},
    ],
)
def test_whatever_is_told_of_a_region_is_told_when_it_changes(change: dict[str, Any]) -> None:
    told = RegionsTold()
    told.news([region(1)])
    assert told.news([region(1)])["regions"] == []
    [news] = told.news([replace(region(1), **change)])["regions"]
    assert news == replace(region(1), **change).to_dict()
