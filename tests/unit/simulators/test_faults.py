"""Laws of the bad wire: what it says it did is what it did."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simulators.faults import FaultCounts, Faults, FaultyWire, misread
from simulators.pacing import Pacer

rates = st.sampled_from([0.0, 0.01, 0.3, 1.0])
pieces = st.none() | st.tuples(st.integers(1, 5), st.integers(5, 40))
portions = st.lists(st.binary(max_size=300), max_size=8)


def carry_all(faults: Faults, sent: list[bytes], seed: int = 1) -> tuple[list[bytes], FaultCounts]:
    wire = FaultyWire(faults, np.random.default_rng(seed))
    arrived = [piece for portion in sent for piece in wire.carry(portion)]
    return arrived + wire.release(), wire.counts


@given(rates, rates, rates, rates, rates, pieces, portions, st.integers(0, 2**32))
def test_every_byte_is_accounted_for(
    flip: float,
    loss: float,
    twice: float,
    late: float,
    garbage: float,
    cut: tuple[int, int] | None,
    sent: list[bytes],
    seed: int,
) -> None:
    faults = Faults(flip, loss, twice, late, garbage, garbage_bytes=9, piece_bytes=cut)
    wire = FaultyWire(faults, np.random.default_rng(seed))
    arrived = 0
    for portion in sent:
        arrived += sum(map(len, wire.carry(portion)))
        c = wire.counts
        assert c.bytes_out == arrived
        assert c.bytes_in + c.duplicated_bytes + c.garbage_bytes == c.bytes_out + c.lost_bytes + c.held_bytes
    arrived += sum(map(len, wire.release()))
    assert wire.counts.bytes_out == arrived
    assert wire.counts.held_bytes == 0
    assert wire.counts.bytes_in == sum(map(len, sent))


@given(pieces, portions)
def test_a_good_wire_changes_nothing_whatever_its_pieces(cut: tuple[int, int] | None, sent: list[bytes]) -> None:
    arrived, counts = carry_all(Faults(piece_bytes=cut), sent)
    assert b"".join(arrived) == b"".join(sent)
    assert all(arrived)
    assert cut is None or all(len(piece) <= cut[1] for piece in arrived)
    assert counts == FaultCounts(bytes_in=counts.bytes_in, bytes_out=counts.bytes_in, pieces=counts.pieces)


def test_the_flipped_bits_counted_are_the_bits_that_differ_and_as_many_as_the_rate_says() -> None:
    sent = np.random.default_rng(2).bytes(200_000)
    arrived, counts = carry_all(Faults(bit_error_rate=1e-3), [sent])
    difference = np.frombuffer(sent, np.uint8) ^ np.frombuffer(b"".join(arrived), np.uint8)
    assert int(np.unpackbits(difference).sum()) == counts.flipped_bits
    assert counts.flipped_bits == pytest.approx(1600, abs=4 * 40)


def test_lost_bytes_are_as_many_as_the_rate_says_and_the_rest_keeps_its_order() -> None:
    sent = bytes(range(256)) * 400
    arrived, counts = carry_all(Faults(byte_loss_rate=0.01), [sent])
    rest = iter(sent)
    assert all(byte in rest for byte in b"".join(arrived))
    assert counts.lost_bytes == len(sent) - len(b"".join(arrived))
    assert counts.lost_bytes == pytest.approx(1024, abs=4 * 32)


def test_a_duplicated_piece_comes_twice_in_a_row() -> None:
    assert carry_all(Faults(duplicate_rate=1.0), [b"ab", b"cd"])[0] == [b"ab", b"ab", b"cd", b"cd"]


def test_a_delayed_piece_comes_behind_its_follower() -> None:
    assert carry_all(Faults(delay_rate=1.0), [b"ab", b"cd", b"ef"])[0] == [b"cd", b"ab", b"ef"]


def test_garbage_comes_in_front_and_the_piece_survives() -> None:
    arrived, counts = carry_all(Faults(garbage_rate=1.0, garbage_bytes=5), [b"ab", b"cd"])
    assert arrived[1::2] == [b"ab", b"cd"]
    assert len(arrived[0]) + len(arrived[2]) == counts.garbage_bytes
    assert counts.garbage_bursts == 2


def test_the_same_seed_makes_the_same_faults() -> None:
    faults = Faults(0.01, 0.01, 0.1, 0.1, 0.1, piece_bytes=(1, 20))
    sent = [bytes(range(256))] * 4
    assert carry_all(faults, sent, seed=5) == carry_all(faults, sent, seed=5)
    assert carry_all(faults, sent, seed=5) != carry_all(faults, sent, seed=6)


def test_impossible_faults_are_refused() -> None:
    with pytest.raises(ValueError, match="bit_error_rate is a chance"):
        Faults(bit_error_rate=1.5)
    with pytest.raises(ValueError, match="piece_bytes"):
        Faults(piece_bytes=(5, 2))
    with pytest.raises(ValueError, match="garbage_bytes"):
        Faults(garbage_bytes=0)


def test_at_the_right_rate_nothing_is_misread_and_at_the_wrong_one_next_to_nothing_is_read() -> None:
    sent = bytes(range(256)) * 4
    rng = np.random.default_rng(1)
    assert misread(sent, 115200, 115200, rng) == sent
    read = misread(sent, 115200, 57600, rng)
    assert len(read) == len(sent) // 2
    assert sum(a == b for a, b in zip(sent, read, strict=False)) < 30
    assert misread(b"", 115200, 57600, rng) == b""


@given(st.integers(300, 4_000_000), st.lists(st.floats(0.0, 0.2), max_size=60), st.floats(0.1, 1.0))
def test_a_wire_never_carries_more_than_a_tenth_of_its_baud_rate(baud: int, waits: list[float], greed: float) -> None:
    pacer, now, sent = Pacer(baud, 5.0), 5.0, 0
    for wait in waits:
        now += wait
        taken = int(pacer.room_bytes(now) * greed)
        pacer.spend(taken)
        sent += taken
        assert sent <= baud / 10 * (now - 5.0) * (1 + 1e-12)


@given(st.integers(9600, 4_000_000), st.lists(st.floats(0.0, 0.01), min_size=1, max_size=60))
def test_a_busy_wire_asked_often_enough_carries_all_of_it(baud: int, waits: list[float]) -> None:
    pacer, now, sent = Pacer(baud, 0.0), 0.0, 0
    for wait in waits:
        now += wait
        taken = pacer.room_bytes(now)
        pacer.spend(taken)
        sent += taken
    assert sent >= baud / 10 * now - 1.001


def test_an_idle_wire_saves_up_no_more_than_its_slack_and_time_going_back_earns_nothing() -> None:
    pacer = Pacer(1_000_000, 0.0)
    assert pacer.room_bytes(3600.0) == 5000
    pacer.spend(5000)
    assert pacer.room_bytes(3599.0) == 0
    assert pacer.room_bytes(3600.0) == 0
