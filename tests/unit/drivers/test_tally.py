"""The accounts balance and are exact, whatever the wire does."""

from collections import Counter
from dataclasses import dataclass

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.boot_ledger import BootLedger, Kind
from drivers.protocols.framing import Damage, DamageReason
from drivers.protocols.native import Decoder, encode
from drivers.protocols.native_messages import Chunk, EndReason, Hello, PositionKind, Status
from drivers.protocols.native_stream import ProfileStream
from drivers.protocols.unwrap import increase_u32, unwrap_u32
from drivers.scanline import DeviceInfo, Profile, SensorGeometry
from drivers.tally import OTHER_PASSES, PassTally, Tally

U32 = 2**32
GEOMETRY = SensorGeometry(np.zeros(3), np.zeros(3), (-1.0, 1.0), 0.001)


LINES_A_PASS = 4


def pass_of(line: int, first: int) -> int:
    """The pass of a line: a new one every few lines."""
    return 1 + (line - first) // LINES_A_PASS


def hello(boot_id: int, status: Status) -> Hello:
    return Hello(0, DeviceInfo("S", "M", "F", "C", boot_id, 3, GEOMETRY), 0.0, 0.5, status)


def status(
    boot_id: int, sequence: int, line: int, chunks: int, lines: int, pass_index: int = 1, runs: bool = True
) -> Status:
    return Status(
        boot_id, True, runs, EndReason.NONE, pass_index, sequence % U32, line % U32, chunks % U32, lines % U32
    )


@dataclass(frozen=True)
class Sent:
    """A chunk the device measured, and what became of it."""

    boot_id: int
    number: int
    line: int
    place: int
    fate: str
    chunk: Chunk


def device(draw: st.DrawFn, boot_id: int, first: int, n_lines: int, chunks_a_line: int) -> list[Sent]:
    """All chunks of one boot; drops by the device are counted in the headers that follow, as the wire demands."""
    fates = st.sampled_from(["arrives"] * 8 + ["device", "missing", "damaged", "twice"])
    sent, dropped_chunks, dropped_lines, number = [], first, first, first
    for line in range(first, first + n_lines):
        in_line = []
        line_fate = draw(st.sampled_from(["", "", "", "", "device", "missing"]))
        for place in range(chunks_a_line):
            fate = line_fate or draw(fates)
            chunk = Chunk(
                boot_id,
                number % U32,
                pass_of(line, first),
                line % U32,
                0,
                PositionKind.STAGE_NM,
                line,
                (0, 0, 0),
                1,
                1,
                dropped_chunks % U32,
                dropped_lines % U32,
                chunks_a_line,
                place,
                np.array([[number % 1000, 1]], dtype=np.int32),
            )
            in_line.append(Sent(boot_id, number, line, place, fate, chunk))
            dropped_chunks += fate == "device"
            number += 1
        dropped_lines += all(item.fate == "device" for item in in_line)
        sent += in_line
    return sent


@st.composite
def schedules(draw: st.DrawFn) -> tuple[list[list[Sent]], int, int]:
    first = draw(st.sampled_from([0, 5, U32 - 7, 2**31 - 3, U32 - 1]))
    chunks_a_line = draw(st.integers(1, 3))
    boots = [
        device(draw, 100 + boot, first if boot == 0 else 0, draw(st.integers(0, 12)), chunks_a_line)
        for boot in range(draw(st.integers(1, 3)))
    ]
    return boots, first, chunks_a_line


def totals_after(sent: list[Sent], boot_id: int, first: int, pass_index: int, runs: bool = True) -> Status:
    number, line = (sent[-1].number + 1, sent[-1].line + 1) if sent else (first, first)
    dropped = first + sum(item.fate == "device" for item in sent)
    lines: dict[int, bool] = {}
    for item in sent:
        lines[item.line] = lines.get(item.line, True) and item.fate == "device"
    return status(boot_id, number, line, dropped, first + sum(lines.values()), pass_index, runs)


@settings(max_examples=100, deadline=None)
@given(schedules(), st.data())
def test_sent_is_stored_and_lost_by_reason_over_drops_damage_wraps_and_reboots(
    schedule: tuple[list[list[Sent]], int, int], data: st.DataObject
) -> None:
    boots, first, chunks_a_line = schedule
    delivered: list[Profile] = []
    room = data.draw(st.sampled_from([3, 1000]))

    def deliver(profile: Profile) -> bool:
        if len(delivered) >= room:
            return False
        delivered.append(profile)
        return True

    start = status(100, first, first, first, first)
    stream = ProfileStream(hello(100, start), deliver)
    sent_of: Counter[tuple[int, int]] = Counter()
    truth: Counter[str] = Counter()
    n_damaged = 0
    for boot, sent in enumerate(boots):
        base = first if boot == 0 else 0
        stream.totals(status(100 + boot, base, base, base, base))
        known = {1}
        for at, item in enumerate(sent):
            truth[item.fate] += 1
            sent_of[item.boot_id, item.chunk.pass_index] += 1
            if at and item.chunk.pass_index != sent[at - 1].chunk.pass_index:  # END of one pass, or START of the next
                before = sent[at - 1].chunk.pass_index
                is_known = before in known or any(
                    item.fate in ("arrives", "twice") for item in sent[:at] if item.chunk.pass_index == before
                )
                ended = (
                    data.draw(st.booleans()) if is_known else True
                )  # of a pass that nobody heard of, its end at least
                known |= set() if ended else {item.chunk.pass_index}
                told = sent[at - 1].chunk.pass_index if ended else item.chunk.pass_index
                stream.totals(totals_after(sent[:at], 100 + boot, base, told, runs=not ended))
            if item.fate == "damaged":
                stream.damage(Damage(DamageReason.BAD_CRC, 97))
                n_damaged += 1
            for _ in range({"arrives": 1, "twice": 2}.get(item.fate, 0)):
                stream.chunk(item.chunk, 0.0)
            tally = stream.tally()
            assert tally.chunks.balances
            assert tally.lines.balances
            assert all(told.chunks.balances and told.lines.balances for told in tally.passes.values())
        stream.totals(totals_after(sent, 100 + boot, base, sent[-1].chunk.pass_index if sent else 1))
        stream.close_line()
    tally = stream.tally()
    n_lines = sum(len(sent) // chunks_a_line for sent in boots)
    lost = Counter(tally.chunks.lost)
    assert tally.chunks.balances
    assert tally.lines.balances
    assert tally.chunks.sent == sum(truth.values())
    assert tally.lines.sent == n_lines
    assert tally.lines.open == 0
    assert lost["device_dropped"] == truth["device"]
    assert lost["damaged"] + lost["missing"] == truth["damaged"] + truth["missing"]
    assert lost["damaged"] >= truth["damaged"]  # a gap with damage in it is explained as a whole
    assert (lost["damaged"] == 0) == (truth["damaged"] == 0)
    assert tally.duplicates == truth["twice"]
    assert tally.damage == ({"bad_crc": n_damaged} if n_damaged else {})
    assert tally.bytes_skipped == 97 * n_damaged
    assert tally.stale == tally.disagreements == 0
    arrived = truth["arrives"] + truth["twice"]
    assert tally.chunks.stored + lost["host_overflow"] == arrived
    assert tally.chunks.stored == sum(int((~profile.missing).sum()) for profile in delivered)
    assert tally.lines.whole == sum(profile.is_whole for profile in delivered)
    assert tally.lines.partial == sum(not profile.is_whole for profile in delivered)
    by_line = [sent[at : at + chunks_a_line] for sent in boots for at in range(0, len(sent), chunks_a_line)]
    dark = [line for line in by_line if not any(item.fate in ("arrives", "twice") for item in line)]
    lost_lines = Counter(tally.lines.lost)
    assert sum(lost_lines.values()) - lost_lines["host_overflow"] == len(dark)
    assert lost_lines["device_dropped"] == sum(all(item.fate == "device" for item in line) for line in dark)
    assert sum(tally.passes.values(), PassTally()) == PassTally(tally.chunks, tally.lines)
    assert {key: told.chunks.sent for key, told in tally.passes.items()} == dict(sent_of)
    of_pass = Counter((profile.boot_id, profile.pass_index) for profile in delivered)
    assert {key: told.lines.stored for key, told in tally.passes.items() if told.lines.stored} == dict(of_pass)
    numbers = [(profile.boot_id, profile.line_index) for profile in delivered]
    assert numbers == sorted(set(numbers))


@settings(max_examples=100, deadline=None)
@given(st.permutations(list(range(12))), st.sampled_from([0, U32 - 5]), st.integers(1, 3), st.data())
def test_chunks_out_of_order_are_stored_or_late_and_never_counted_twice(
    order: list[int], first: int, chunks_a_line: int, data: st.DataObject
) -> None:
    again = data.draw(st.lists(st.sampled_from(order), max_size=5))
    stream = ProfileStream(hello(1, status(1, first, first, 0, 0)), lambda _: True)
    for at in [*order, *again]:
        line, place = divmod(at, chunks_a_line)
        chunk = Chunk(
            1, (first + at) % U32, 1 + line // 3, (first + line) % U32, 0, PositionKind.NONE, 0, (0, 0, 0), 1, 1, 0, 0,
            chunks_a_line, place, np.array([[1, 1]], dtype=np.int32),
        )  # fmt: skip
        stream.chunk(chunk, 0.0)
        assert stream.tally().chunks.balances
        assert stream.tally().lines.balances
        assert all(told.chunks.balances and told.lines.balances for told in stream.tally().passes.values())
    tally = stream.tally()
    sent_of = Counter((1, 1 + at // chunks_a_line // 3) for at in order)
    assert {key: told.chunks.sent for key, told in tally.passes.items()} == dict(sent_of)  # all came in the end
    # What comes before the first number that was read is older than the account only where the account says so.
    assert tally.chunks.sent == 12
    assert tally.duplicates == len(again)
    assert set(tally.chunks.lost) <= {"late", "conflict"}
    assert tally.chunks.stored + sum(tally.chunks.lost.values()) == 12
    assert tally.disagreements == tally.stale == 0


@settings(max_examples=100, deadline=None)
@given(
    st.lists(st.integers(0, 23) | st.integers(0, 23).map(lambda at: slice(at, at + 8)), max_size=12),
    st.sampled_from([0, U32 - 5]),
    st.integers(1, 8),
    st.data(),
)
def test_how_many_chunks_are_read_in_one_go_changes_neither_accounts_nor_profiles(
    order: list[int | slice], first: int, chunks_a_line: int, data: st.DataObject
) -> None:
    frames = []
    for at in range(32):
        line, place = divmod(at, chunks_a_line)
        line -= data.draw(st.sampled_from([0] * 9 + [1]))  # a device that contradicts itself
        chunk = Chunk(
            1, (first + at) % U32, 1 + line // 3, (first + line) % U32, 0, PositionKind.NONE, 0, (0, 0, 0), 1, 1, 0, 0,
            chunks_a_line, place, np.array([[at, 1]]),
        )  # fmt: skip
        frames.append(encode(chunk) if line >= 0 else b"")
    arriving = [frame for at in order for frame in (frames[at] if isinstance(at, slice) else [frames[at]])]
    told = []
    for reads in (arriving, [b"".join(arriving)]):
        profiles: list[Profile] = []

        def deliver(profile: Profile, kept: list[Profile] = profiles) -> bool:
            kept.append(profile)
            return len(kept) < 9

        stream = ProfileStream(hello(1, status(1, first, first, 0, 0)), deliver)
        decoder = Decoder()
        for read in reads:
            for item in decoder.receive(read):
                assert isinstance(item, Chunk)
                stream.chunk(item, 0.0)
        stream.close_line()
        assert stream.tally().chunks.balances
        told.append((stream.tally(), [(p.line_index, p.missing.tolist(), p.x_mm.tobytes()) for p in profiles]))
    assert told[0] == told[1]


def test_lines_of_a_sorted_stream_hold_what_was_sent() -> None:
    profiles: list[Profile] = []
    stream = ProfileStream(hello(1, status(1, 0, 0, 0, 0)), lambda profile: profiles.append(profile) or True)
    no_return = -(2**31)
    for place, points in enumerate(([[-10_000, 12_345]], [[no_return, no_return]], [[10_000, -1]])):
        stream.chunk(
            Chunk(1, place, 4, 0, 2_500_000, PositionKind.STAGE_NM, 600_000, (0, 5, 15), 300_000, -(2**63), 0, 0, 3,
                  place, np.array(points, dtype=np.int32)),
            7.5,
        )  # fmt: skip
    (profile,) = profiles
    np.testing.assert_array_equal(profile.x_mm, [-1.0, np.nan, 1.0])
    np.testing.assert_array_equal(profile.z_mm, [1.2345, np.nan, -0.0001])
    assert (profile.position_mm, profile.line_spacing_mm, profile.device_time_s) == (0.6, 0.3, 2.5)
    assert np.isnan(profile.step_mm)
    assert profile.is_whole
    assert (profile.pass_index, profile.line_index, profile.arrival_s) == (4, 0, 7.5)
    np.testing.assert_array_equal(profile.laser_mm, [0.0, 0.0005, 0.0015])


def test_a_gap_across_a_lost_link_is_disconnected() -> None:
    ledger = BootLedger()
    ledger.chunk(0, 0, 0, 0)
    ledger.line_closed(whole=True)
    ledger.damage("cut_off", 40)
    ledger.link_lost()
    ledger.damage("debris", 9)
    ledger.chunk(6, 3, 2, 1)
    tally = ledger.tally()
    assert tally.chunks.lost == {"device_dropped": 2, "disconnected": 3}
    assert tally.lines.lost == {"device_dropped": 1, "disconnected": 1}
    assert tally.chunks.balances
    assert tally.lines.balances


def test_a_device_that_sends_what_it_counted_as_dropped_is_caught_disagreeing() -> None:
    ledger = BootLedger()
    ledger.chunk(2, 0, 2, 0)
    assert ledger.chunk(0, 0, 0, 0).kind is Kind.NEW
    assert ledger.tally().chunks.lost == {"device_dropped": 1}
    assert ledger.tally().disagreements == 1
    assert ledger.tally().chunks.balances


def test_chunks_older_than_the_account_are_counted_apart() -> None:
    ledger = BootLedger(sequence=10, line=4)
    assert ledger.chunk(9, 3, 0, 0).kind is Kind.STALE
    assert ledger.tally().chunks.sent == 0
    assert ledger.tally().stale == 1


def test_a_chunk_that_contradicts_its_line_is_lost_as_a_conflict() -> None:
    stream = ProfileStream(hello(1, status(1, 0, 0, 0, 0)), lambda _: True)
    for number in (0, 1):
        stream.chunk(
            Chunk(1, number, 1, 0, 0, PositionKind.NONE, 0, (0, 0, 0), 1, 1, 0, 0, 3, 0, np.array([[1, 1]])), 0.0
        )
    assert stream.tally().chunks.lost == {"conflict": 1}
    assert stream.tally().chunks.balances


def test_a_chunk_that_overlaps_another_in_part_is_a_conflict_and_nothing_of_it_is_taken() -> None:
    profiles: list[Profile] = []
    stream = ProfileStream(hello(1, status(1, 0, 0, 0, 0)), lambda profile: profiles.append(profile) or True)
    for number, (first, values) in enumerate([(0, [10, 20]), (1, [70, 80]), (2, [30])]):
        points = np.array([[value, value] for value in values], dtype=np.int32)
        stream.chunk(Chunk(1, number, 1, 0, 0, PositionKind.NONE, 0, (0, 0, 0), 1, 1, 0, 0, 3, first, points), 0.0)
    (profile,) = profiles
    np.testing.assert_array_equal(profile.x_mm, [0.001, 0.002, 0.003])
    assert profile.is_whole
    assert stream.tally().chunks.lost == {"conflict": 1}


def test_a_known_pass_keeps_its_account_when_there_is_no_room_for_new_ones() -> None:
    ledger = BootLedger(boot_id=9)
    for number in range(1_030):
        ledger.chunk(number, number, 0, 0, number)
    ledger.chunk(1_030, 1_030, 0, 0, 5)
    tally = ledger.tally()
    assert tally.passes[9, 5].chunks.sent == 2
    assert tally.passes[9, OTHER_PASSES].chunks.sent == 6
    assert tally.chunks.sent == 1_031


def test_tallies_of_boots_add_up_and_are_json() -> None:
    ledger = BootLedger()
    ledger.chunk(3, 1, 1, 1)
    ledger.damage("bad_crc", 5)
    ledger.no_return({"too_far": 3, "dazzled": 0})
    one = ledger.tally()
    two = one + one + Tally()
    assert two.chunks.balances
    assert two.lines.balances
    assert two.to_dict() == {
        "chunks": {"sent": 8, "stored": 2, "lost": {"device_dropped": 2, "missing": 4}},
        "lines": {"sent": 4, "stored": 0, "whole": 0, "partial": 0, "open": 2, "lost": {"device_dropped": 2}},
        "duplicates": 0,
        "stale": 0,
        "disagreements": 0,
        "damage": {"bad_crc": 2},
        "bytes_skipped": 10,
        "no_return": {"too_far": 6},
        "late_reads": 0,
        "largest_pause_s": 0.0,
    }


@given(st.integers(0, 2**70), st.integers(-(2**31), 2**31 - 1))
def test_unwrapping_undoes_the_wrap_of_any_counter_within_half_a_turn(reference: int, step: int) -> None:
    assert unwrap_u32(reference, (reference + step) % U32) == reference + step


@given(st.integers(0, 2**40), st.integers(0, U32 - 1))
def test_a_counter_grows_by_what_was_added_across_one_wrap(before: int, growth: int) -> None:
    assert increase_u32(before % U32, (before + growth) % U32) == growth
