"""Lines that a rig leaves out leave the stored ones of their pass for the lost ones, and no balance breaks."""

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from drivers.passes.left_out import LeftOut, without
from drivers.protocols.profile_account import ProfileAccount
from drivers.scanline import Profile
from drivers.tally import MAX_PASSES

REASONS = ("outside_pass", "between_stops", "no_position")


def profile(boot_id: int, pass_index: int, line: int, *, whole: bool) -> Profile:
    missing = np.array([not whole, False])
    laser = np.array([0.0, 0.0, 100.0])
    nan = math.nan
    x_mm = np.array([nan if not whole else 0.0, 1.0])
    return Profile("S", boot_id, pass_index, line, 0.0, 0.0, x_mm, x_mm.copy(), missing, laser, nan, nan, nan)


@given(
    st.lists(
        st.one_of(
            st.tuples(st.just("line"), st.booleans(), st.sampled_from((None, *REASONS))),
            st.tuples(st.just("lost"), st.integers(1, 5)),
            st.tuples(st.just("dropped"), st.integers(1, 3)),
            st.tuples(st.just("overflow")),
            st.tuples(st.just("pass")),
            st.tuples(st.just("unplug")),
        ),
        max_size=60,
    )
)
def test_every_pass_balances_and_what_is_left_out_is_lost_on_its_own_pass(steps: list[tuple]) -> None:
    account, left_out = ProfileAccount(boot_id=7), LeftOut()
    account.begin_pass()
    stored: dict[int, int] = {}
    gone: dict[int, dict[str, int]] = {}
    dropped = 0
    for step in steps:
        index = account.pass_index
        match step:
            case "line", whole, reason:
                account.enter(dropped)
                account.handed_on({}, whole=whole)
                stored[index] = stored.get(index, 0) + 1
                if reason is not None:
                    left_out.enter(profile(7, index, account.latest_line, whole=whole), reason)
                    stored[index] -= 1
                    reasons = gone.setdefault(index, {})
                    reasons[reason] = reasons.get(reason, 0) + 1
            case "lost", n:
                account.lost(n)
            case "dropped", n:
                account.lost(n)
                dropped += n
            case ("overflow",):
                account.enter(dropped)
                account.not_taken()
            case ("pass",):
                account.end_pass()
                account.begin_pass()
            case ("unplug",):
                account.link_lost()
        passes = without(account.tally().passes, left_out.counts())
        assert all(told.lines.balances and told.chunks.balances for told in passes.values())
        assert {key[1]: told.lines.stored for key, told in passes.items() if told.lines.stored} == {
            index: count for index, count in stored.items() if count
        }
        for key, told in passes.items():
            found = {reason: count for reason, count in told.lines.lost.items() if reason in REASONS}
            assert found == gone.get(key[1], {})
    account.end_pass()
    whole = account.tally()
    assert sum(told.lines.sent for told in whole.passes.values()) == whole.lines.sent == account.latest_line + 1


@given(st.integers(1, 9), st.integers(0, 9), st.integers(1, 9))
def test_lines_lost_at_the_end_of_a_pass_are_that_pass_s_and_those_before_the_next_one_s(
    at_the_end: int, before_the_next: int, taken: int
) -> None:
    account = ProfileAccount(boot_id=1)
    for index in (1, 2):
        account.begin_pass()
        if index == 2:
            account.lost(before_the_next)
        for _ in range(taken):
            account.enter()
            account.handed_on({}, whole=True)
        if index == 1:
            account.lost(at_the_end)
        account.end_pass()
    passes = account.tally().passes
    assert passes[1, 1].lines.lost == {"missing": at_the_end}
    assert sum(passes[1, 2].lines.lost.values()) == before_the_next
    assert (passes[1, 1].lines.stored, passes[1, 2].lines.stored) == (taken, taken)


def test_what_was_left_out_of_a_pass_that_the_scanner_tells_nothing_of_is_told_as_lost() -> None:
    left_out = LeftOut()
    for line, whole in enumerate((True, True, False)):
        left_out.enter(profile(3, 1, line, whole=whole), "outside_pass")
    told = without({}, left_out.counts())
    assert told[3, 1].lines.balances
    assert (told[3, 1].lines.sent, told[3, 1].lines.lost) == (3, {"outside_pass": 3})


def test_passes_beyond_those_that_the_scanner_keeps_apart_share_one_account_and_still_balance() -> None:
    account, left_out = ProfileAccount(boot_id=7), LeftOut()
    for _ in range(MAX_PASSES + 50):
        account.begin_pass()
        account.enter()
        account.handed_on({}, whole=True)
        left_out.enter(profile(7, account.pass_index, account.latest_line, whole=True), "outside_pass")
        account.end_pass()
    assert len(left_out.counts()) == MAX_PASSES + 1
    passes = without(account.tally().passes, left_out.counts())
    assert all(told.lines.balances and told.lines.stored == 0 for told in passes.values())
    assert sum(told.lines.lost["outside_pass"] for told in passes.values()) == MAX_PASSES + 50
