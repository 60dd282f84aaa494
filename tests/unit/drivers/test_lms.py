"""The LMS2xx's telegrams: its own CRC, framing, values; every vector whole, byte by byte and with noise around."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.protocols.framing import Damage, DamageReason
from drivers.protocols.lms import (
    ACK,
    NAK,
    Control,
    Mode,
    Reply,
    Telegram,
    TelegramDecoder,
    Values,
    crc,
    distances_of,
    first_angle_deg,
    mode_request,
    read_status,
    read_values,
    telegram,
    values_data,
    variant_request,
)
from tests.vectors import lms as vectors

REPLIES = {name: getattr(vectors, name) for name in ("MODE_REPLY", "TYPE_REPLY", "VALUES", "PARTIAL_VALUES")}
NOISE = [b"", b"\x55" * 40, b"\x02", b"\x02\x80\x26\x03\xb0" * 3, b"\x02\x80\x00\x00", bytes(range(0x16, 0x80))]


@given(st.binary(max_size=900))
def test_the_check_is_the_one_of_its_definition(data: bytes) -> None:
    assert crc(data) == vectors.crc_on_bits(data)


@pytest.mark.parametrize("name", REPLIES)
@pytest.mark.parametrize("noise", NOISE)
def test_every_reply_is_read_whole_and_byte_by_byte_with_noise_around(name: str, noise: bytes) -> None:
    rest = b"\x55" * 1000  # a false beginning may ask for as much before it is known to be false
    stream = noise + REPLIES[name] + noise + REPLIES[name] + rest
    whole, single = TelegramDecoder(), TelegramDecoder()
    found = whole.receive(stream)
    assert [item for at in range(len(stream)) for item in single.receive(stream[at : at + 1])] == found
    telegrams = [item for item in found if isinstance(item, Telegram)]
    assert [item.n_bytes for item in telegrams] == [len(REPLIES[name])] * 2
    damaged = sum(item.n_bytes for item in found if isinstance(item, Damage))
    assert whole.accepted_bytes + damaged + whole.pending_bytes == len(stream)


def test_requests_are_written_and_heard_with_their_acknowledgements() -> None:
    assert telegram(5, 0x20, b"\x24") == vectors.STREAM_REQUEST_TO_5
    assert variant_request(100, 25) == vectors.VARIANT_REQUEST
    [heard] = TelegramDecoder(from_host=True).receive(vectors.STREAM_REQUEST_TO_5)
    assert heard == Telegram(5, 0x20, bytes([Mode.STREAM]), None, 8)
    assert TelegramDecoder().receive(vectors.STREAM_REQUEST_TO_5) == []  # a request is no reply: an echo is passed over
    found = TelegramDecoder().receive(bytes([ACK]) + vectors.MODE_REPLY + bytes([NAK]))
    assert found == [Control(ACK), Telegram(0x85, 0xA0, b"\0", 0x10, 9), Control(NAK)]
    assert mode_request(Mode.RATE_38400)[4:6] == b"\x20\x40"
    with pytest.raises(ValueError, match="at most 814 bytes"):
        telegram(0, 0x77, bytes(900))


def test_values_are_read_with_flags_codes_unit_and_indices() -> None:
    [item] = TelegramDecoder().receive(vectors.VALUES)
    assert item.command == Reply.VALUES
    values = read_values(item.data)
    assert (values.unit_mm, values.partial_deg, values.scan_index, values.telegram_index) == (1.0, None, 200, 17)
    distance_mm, reasons = distances_of(values, measuring_mode=0)
    assert distance_mm[:2].tolist() == [1000, 1001]
    assert {name: np.flatnonzero(holds).tolist() for name, holds in reasons.items() if holds.any()} == {
        "nothing_came_back": [2],
        "beyond_range": [3],
        "other_code": [2, 3],
    }
    assert values_data(values) == item.data
    wide, none = distances_of(values, measuring_mode=5)  # 15 bits: 1FFFh is a distance then, and 4000h no flag
    assert wide.tolist() == [1000, 1001 + 0x4000, 0x1FFF, 0x1FF7]
    assert not any(holds.any() for holds in none.values())


def test_partial_scans_say_by_how_much_they_are_moved() -> None:
    [item] = TelegramDecoder().receive(vectors.PARTIAL_VALUES)
    values = read_values(item.data)
    assert (values.partial_deg, values.scan_index) == (0.25, None)
    assert distances_of(values, 0)[0].tolist() == [1000, 2000]
    assert values_data(values) == item.data


@given(st.data())
def test_what_is_said_of_values_is_read_again(data: st.DataObject) -> None:
    raw = np.array(data.draw(st.lists(st.integers(0, 0xFFFF), max_size=401)), dtype=np.int64)
    indices = data.draw(st.none() | st.tuples(st.integers(0, 255), st.integers(0, 255)))
    said = Values(
        raw,
        data.draw(st.sampled_from([1.0, 10.0])),
        data.draw(st.sampled_from([None, 0.0, 0.25, 0.5, 0.75])),
        *(indices or (None, None)),
    )
    heard = read_values(values_data(said))
    np.testing.assert_array_equal(heard.raw, said.raw)
    assert (heard.unit_mm, heard.partial_deg, heard.scan_index, heard.telegram_index) == (
        said.unit_mm,
        said.partial_deg,
        said.scan_index,
        said.telegram_index,
    )


@pytest.mark.parametrize("data", [b"", b"\x04", b"\x04\x00\x01", b"\x01\x00\x01\x00\x07", b"\x00\xc0"])
def test_values_whose_length_or_unit_is_wrong_are_refused(data: bytes) -> None:
    with pytest.raises(Exception, match=r"do not hold|requires a buffer"):
        read_values(data)


def test_a_status_is_read_at_its_offsets() -> None:
    data = bytearray(151)
    data[0:7] = b"V02.30 "
    data[7], data[8], data[101], data[121] = 0x25, 1, 4, 1
    data[106:110] = bytes([180, 0, 50, 0])
    status = read_status(bytes(data))
    assert status.software == "V02.30"
    assert (status.mode, status.has_fault, status.measuring_mode, status.unit) == (0x25, True, 4, 1)
    assert (status.angle_deg, status.resolution_hundredths) == (180, 50)
    with pytest.raises(ValueError, match="122 bytes"):
        read_status(bytes(50))


def accepts(*flipped: int) -> bool:
    damaged = bytearray(vectors.VALUES)
    for bit in flipped:
        damaged[bit // 8] ^= 1 << bit % 8
    return any(isinstance(item, Telegram) for item in TelegramDecoder().receive(bytes(damaged) + bytes(900)))


def test_every_single_flipped_bit_is_noticed_and_some_pairs_are_not() -> None:
    """The register moves by one bit a byte, not by eight: a bit and the next lower one of the byte behind cancel."""
    n_bits = 8 * len(vectors.VALUES)
    assert not any(accepts(bit) for bit in range(n_bits))
    assert accepts(8 * 8 + 2, 8 * 9 + 3)
    rng = np.random.default_rng(2)
    pairs = [rng.choice(n_bits, size=2, replace=False) for _ in range(3000)]
    assert sum(accepts(*map(int, pair)) for pair in pairs) < 0.05 * len(pairs)


def test_a_damaged_telegram_costs_itself_only() -> None:
    damaged = bytearray(vectors.VALUES)
    damaged[7] ^= 1
    found = TelegramDecoder().receive(bytes(damaged) + vectors.MODE_REPLY)
    assert found[0] == Damage(DamageReason.BAD_CRC, len(vectors.VALUES))
    assert isinstance(found[1], Telegram)


def test_a_hundred_degrees_begin_at_forty() -> None:
    assert first_angle_deg(100) == 40
    assert first_angle_deg(180) == 0


def test_a_telegram_that_was_interrupted_does_not_hide_the_reply_behind_it() -> None:
    decoder = TelegramDecoder()
    assert decoder.receive(vectors.VALUES[:6] + bytes([ACK]) + vectors.MODE_REPLY) == []  # it may still be values
    found = decoder.break_off()
    assert [type(item) for item in found] == [Damage, Telegram]
    assert found[0].n_bytes == 7
    assert decoder.pending_bytes == 0
    assert decoder.break_off() == []
