"""The pace of the live stream: updates are asked for at most 30 times a second, and never later than they need be."""

import pytest

from scanner_service.api.routes.live import UPDATE_PERIOD_S, rest_s


@pytest.mark.parametrize("took_s", [0.0, 0.01, 0.016])
def test_an_update_that_was_quick_is_followed_a_period_after_it_was_asked_for(took_s):
    assert took_s + rest_s(50.0, 50.0 + took_s) == pytest.approx(UPDATE_PERIOD_S)
    assert pytest.approx(1 / 30) == UPDATE_PERIOD_S


@pytest.mark.parametrize(("took_s", "rests_s"), [(0.02, 0.02), (0.03, 0.03), (0.2, 1 / 30), (5.0, 1 / 30)])
def test_an_update_that_took_long_leaves_as_much_time_to_others_but_no_more_than_a_period(took_s, rests_s):
    assert rest_s(50.0, 50.0 + took_s) == pytest.approx(rests_s)
