"""The pace of the live stream: updates are asked for at most 30 times a second, and never later than they need be."""

import pytest

from scanner_service.api.routes.live import UPDATE_PERIOD_S, rest_s


@pytest.mark.parametrize("took_s", [0.0, 0.01, 0.03])
def test_an_update_that_was_quick_is_followed_a_period_after_it_was_asked_for(took_s):
    assert took_s + rest_s(50.0, 50.0 + took_s) == pytest.approx(UPDATE_PERIOD_S)
    assert pytest.approx(1 / 30) == UPDATE_PERIOD_S


def test_an_update_that_took_longer_than_a_period_is_followed_at_once():
    assert rest_s(50.0, 50.2) == 0.0
