"""Profiles and stage positions: interpolated where they should be, never further off than stated, none gone."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.pairing import MAX_WAITING, ClockOffset, StageTrack, TimePairing
from drivers.pass_accounts import PassAccounts
from drivers.rig_description import PairBy, Pairing
from drivers.scanline import Profile
from drivers.stages.face import StageReading


def profile(line: int, device_time_s: float, arrival_s: float) -> Profile:
    empty = np.zeros(0)
    missing = np.zeros(0, dtype=bool)
    laser = np.array([0.0, 0.0, 100.0])
    return Profile(
        "S", 1, 1, line, device_time_s, arrival_s, empty, empty, missing, laser, math.nan, math.nan, math.nan
    )


def reading(at_s: float, position_mm: float, half_s: float = 0.0, uncertainty_mm: float = 0.0) -> StageReading:
    return StageReading(position_mm, at_s - half_s, at_s + half_s, True, uncertainty_mm)


def test_between_two_readings_the_position_is_interpolated_and_outside_there_is_none() -> None:
    track = StageTrack()
    track.add([reading(0.0, 0.0), reading(1.0, 10.0), reading(2.0, 20.0)])
    at = track.at(0.25, 0.0)
    assert at is not None
    assert (at.position_mm, at.uncertainty_mm) == (2.5, 0.0)
    assert track.at(-0.1, 0.0) is None
    assert track.at(2.1, 0.0) is None
    assert track.covers(1.0, with_next=True)
    assert not track.covers(1.5, with_next=True)
    assert track.covers(1.5, with_next=False)


def test_the_uncertainty_is_speed_times_time_and_the_corner_and_the_reading_s_own() -> None:
    track = StageTrack()
    track.add([reading(0.0, 0.0), reading(1.0, 10.0, 0.01), reading(2.0, 20.0, uncertainty_mm=0.05)])
    at = track.at(1.5, 0.02)
    assert at is not None
    assert at.uncertainty_mm == pytest.approx(0.05 + 10.0 / 0.98 * (2 * 0.01 + 0.02))
    bent = StageTrack()
    bent.add([reading(0.0, 0.0), reading(1.0, 0.0), reading(2.0, 4.0), reading(3.0, 12.0)])
    at = bent.at(1.5, 0.0)
    assert at is not None
    assert at.uncertainty_mm == pytest.approx(8.0 * 1.0 / 4.0)  # speeds 0, 4 and 8 around it


@settings(max_examples=200, deadline=None)
@given(
    st.floats(0.5, 40.0),
    st.floats(0.0, 1.0),
    st.floats(0.0, 0.05),
    st.floats(0.0, 0.01),
    st.integers(0, 2**32 - 1),
)
def test_a_stage_that_starts_moves_and_stops_is_never_further_off_than_stated(
    speed: float, corner: float, half_s: float, clock_s: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    start_s, end_s = 1.0 + 0.2 * corner, 3.0 + 0.2 * corner

    def truth(at_s: float) -> float:
        return speed * (min(max(at_s, start_s), end_s) - start_s)

    track = StageTrack()
    for middle_s in np.arange(0.0, 5.0, 0.2):
        taken_s = middle_s + rng.uniform(-half_s, half_s)
        track.add([StageReading(truth(taken_s), middle_s - half_s, middle_s + half_s, True)])
    for at_s in rng.uniform(0.2, 4.6, 50):
        found = track.at(at_s, clock_s)
        assert found is not None
        true_mm = truth(at_s + rng.uniform(-clock_s, clock_s))
        assert abs(found.position_mm - true_mm) <= found.uncertainty_mm + 1e-9


@given(st.lists(st.tuples(st.floats(0.001, 0.1), st.floats(0.0, 0.05)), min_size=2, max_size=60), st.floats(-1e6, 1e6))
def test_the_offset_of_the_clocks_is_that_of_the_quickest_profile(
    steps: list[tuple[float, float]], offset_s: float
) -> None:
    clock, at_s = ClockOffset(), 0.0
    delays = []
    for step_s, delay_s in steps:
        at_s += step_s
        delays.append(delay_s)
        clock.enter(at_s, at_s + offset_s + delay_s)
        least = min(delays)
        found = clock.offset_s(at_s + offset_s + delay_s) - offset_s
        assert least - 1e-6 <= found <= least + 1e-4 * at_s + 1e-5
    assert clock.jumps == 0


def test_a_clock_that_was_set_anew_is_noticed_and_counted() -> None:
    clock = ClockOffset()
    for k in range(50):
        clock.enter(0.1 * k, 0.1 * k + 5.0)
    for k in range(50, 100):
        clock.enter(0.1 * k - 4.0, 0.1 * k + 5.0)
    assert clock.jumps == 1
    assert clock.offset_s(15.0) == pytest.approx(9.0, abs=0.01)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.sampled_from(["profile", "reading", "due", "gap"]), max_size=120), st.integers(0, 2**31))
def test_every_profile_is_paired_or_waits_or_is_left_out_for_a_reason(steps: list[str], seed: int) -> None:
    rng = np.random.default_rng(seed)
    pairing = TimePairing(Pairing(PairBy.TIME, 0.0, 0.001))
    at_s, line, order = 0.0, 0, []
    for step in [*steps, "end"]:
        at_s += 5.0 if step == "gap" else float(rng.uniform(0.0, 0.1))
        if step == "profile":
            pairing.enter(profile(line, at_s, at_s + 0.01))
            line += 1
        elif step == "reading":
            pairing.track.add([reading(at_s, 10.0 * at_s)])
        for paired in pairing.due(no_more_readings=step == "end"):
            order.append(paired.profile.line_index)
            assert paired.at.position_mm == pytest.approx(10.0 * pairing.exposure_s(paired.profile), abs=0.02)
        assert pairing.received == pairing.paired + pairing.waiting + sum(pairing.left_out.values())
    assert pairing.waiting == 0
    assert order == sorted(order)
    assert pairing.received == line


def test_profiles_that_wait_for_a_stage_that_says_nothing_do_not_fill_the_memory() -> None:
    pairing = TimePairing(Pairing(PairBy.TIME))
    for line in range(MAX_WAITING + 10):
        pairing.enter(profile(line, 0.001 * line, 0.001 * line))
    assert pairing.waiting == MAX_WAITING
    assert pairing.left_out == {"queue_full": 10}


@given(st.lists(st.floats(-100, 100), min_size=1, max_size=50), st.booleans())
def test_measured_steps_and_the_nominal_spacing_are_kept_apart(positions: list[float], forwards: bool) -> None:
    accounts = PassAccounts(0.25)
    steps = [accounts.place(position, 0.01) for position in positions]
    assert math.isnan(steps[0])
    np.testing.assert_array_equal(steps[1:], np.diff(positions))
    report = accounts.report(1.0 if forwards else -1.0)
    assert (report.lines, report.nominal_spacing_mm, report.largest_uncertainty_mm) == (len(positions), 0.25, 0.01)
    if len(positions) > 1:
        differences = np.diff(positions)
        assert report.median_step_mm == np.median(differences)
        assert report.reversed_steps == ((differences < 0) if forwards else (differences > 0)).sum()
    else:
        assert report.to_dict()["median_step_mm"] is None
