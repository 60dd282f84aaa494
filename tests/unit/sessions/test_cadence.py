"""Runs take no more than their share of a core, whatever they take, and are no further apart than that asks for."""

from hypothesis import given
from hypothesis import strategies as st

from scanner_service.sessions.cadence import Cadence


@given(
    runs=st.lists(st.tuples(st.floats(0.0, 20.0), st.floats(1.0, 4.0)), min_size=1, max_size=30),
    share=st.floats(0.05, 0.5),
    lines_wait=st.booleans(),
)
def test_runs_and_their_rests_keep_to_the_share_whatever_a_run_takes(
    runs: list[tuple[float, float]], share: float, lines_wait: bool
) -> None:
    cadence = Cadence(hurried=share) if lines_wait else Cadence(share=share)
    now_s, busy_s, tick_s = 0.0, 0.0, 0.25
    for core_s, waited in runs:  # a run takes its work on the clock, or longer where it had to wait
        while not cadence.is_due(now_s):
            now_s += tick_s
        begun_s = now_s
        now_s += core_s * waited
        busy_s += core_s
        cadence.ran(begun_s, now_s, core_s, lines_wait=lines_wait)
        rested_s = 0.0
        while not cadence.is_due(now_s + rested_s):
            rested_s += tick_s
        assert busy_s <= share * (now_s + rested_s) + 1e-6
        assert rested_s <= max(1.0, core_s * (1.0 / share - 1.0)) + tick_s
