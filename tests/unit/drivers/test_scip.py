"""SCIP 2.0's bytes: characters, sums, replies; every vector whole, byte by byte and with noise around."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.protocols.framing import Damage, DamageReason
from drivers.protocols.scip import (
    MAX_REPLY_BYTES,
    Reply,
    ReplyDecoder,
    StreamEcho,
    check_character,
    data_lines,
    decode_values,
    encode_value,
    info_fields,
    n_steps,
    reply,
    scan_of,
    stream_echo,
)
from tests.vectors import scip as vectors

REPLIES = {
    name: value for name, value in vars(vectors).items() if isinstance(value, bytes) and not name.startswith("_")
}


def read(data: bytes) -> list[Reply | Damage]:
    return ReplyDecoder().receive(data)


@pytest.mark.parametrize("name", REPLIES)
@pytest.mark.parametrize("noise", [b"", b"\n\n\n", b"AT+CGMM\r\r\n\n", bytes(range(1, 256)) * 3 + b"\n\n"])
def test_every_reply_is_read_whole_and_byte_by_byte_with_noise_around(name: str, noise: bytes) -> None:
    stream = noise + REPLIES[name] + noise + REPLIES[name]
    whole = read(stream)
    single = ReplyDecoder()
    assert [item for at in range(len(stream)) for item in single.receive(stream[at : at + 1])] == whole
    intact = [item for item in whole if isinstance(item, Reply) and item.n_bytes == len(REPLIES[name])]
    assert len(intact) == 2


@pytest.mark.parametrize(("value", "text"), [(1234, b"CB"), (5432, b"1Dh"), (16_000_000, b"m2@0")])
def test_values_are_written_in_groups_of_six_bits(value: int, text: bytes) -> None:
    assert encode_value(value, len(text)) == text
    assert decode_values(text, len(text)).tolist() == [value]


@given(st.lists(st.integers(0, (1 << 18) - 1), max_size=200))
def test_what_is_encoded_is_decoded(values: list[int]) -> None:
    assert decode_values(b"".join(encode_value(value, 3) for value in values), 3).tolist() == values


def test_values_beyond_their_characters_and_stray_characters_are_refused() -> None:
    with pytest.raises(ValueError, match="does not fit"):
        encode_value(1 << 12, 2)
    for characters in (b"0", b"0p", b"0/"):
        with pytest.raises(ValueError, match=r"none of the 64|no whole number"):
            decode_values(characters, 2)


def test_information_is_read_and_its_sums_are_checked() -> None:
    [version] = read(vectors.VERSION)
    assert info_fields(version.lines) == (vectors.VERSION_FIELDS, 0)
    assert version.status == "00"
    wrong = vectors.VERSION.replace(b"X7;l", b"X7;?")
    assert info_fields(read(wrong)[0].lines) == (vectors.VERSION_FIELDS, 1)  # told, not refused
    with_semicolon = bytes([check_character(b"SERI:X7;")])
    assert info_fields((b"SERI:X7;" + with_semicolon,)) == ({"SERI": "X7"}, 0)


def test_a_scan_is_read_and_its_echo_says_what_it_is() -> None:
    [answer] = read(vectors.SCAN)
    assert stream_echo(answer.echo) == StreamEcho("MS", 0, 39, 1, 0, 5)
    scan = scan_of(answer, 2, 40)
    assert scan.timestamp == vectors.SCAN_MILLISECONDS
    assert scan.values.tolist() == vectors.SCAN_DISTANCES_MM
    assert not scan.damaged.any()
    assert scan_of(answer, 2, 41).damaged[32:].all()  # its second block is too short for them
    assert scan_of(answer, 2, 65) is None
    assert stream_echo("MS0000003901005;tag 7") == stream_echo("MS0000003901005")
    assert stream_echo("VV") is None


def test_what_is_written_is_the_vector() -> None:
    characters = b"".join(encode_value(value, 2) for value in vectors.SCAN_DISTANCES_MM)
    assert reply("MS0000003901005", "99", data_lines(vectors.SCAN_MILLISECONDS, characters)) == vectors.SCAN
    assert reply("QT", "00") == vectors.STOPPED


def test_a_damaged_block_costs_its_own_values_only() -> None:
    at = vectors.SCAN.index(b"545;")
    [answer] = read(vectors.SCAN[:at] + b"9" + vectors.SCAN[at + 1 :])
    scan = scan_of(answer, 2, 40)
    assert scan.damaged.tolist() == [False] * 32 + [True] * 8
    assert scan.values[:32].tolist() == vectors.SCAN_DISTANCES_MM[:32]
    shorter = scan_of(read(vectors.SCAN[:at] + vectors.SCAN[at + 1 :])[0], 2, 40)
    assert shorter.damaged.tolist() == scan.damaged.tolist()


def test_a_value_across_the_border_of_two_blocks_is_lost_with_either() -> None:
    values = np.arange(1000, 1043)
    characters = b"".join(encode_value(int(value), 3) for value in values)
    lines = data_lines(7, characters).split(b"\n")[:-1]
    assert scan_of(Reply("", "", tuple(lines), 0), 3, 43).values.tolist() == values.tolist()
    for block, first, last in ((1, 0, 21), (2, 21, 42)):  # value 21 has its first character in block 1
        wrong = list(lines)
        wrong[block] = bytes([wrong[block][0] ^ 1]) + wrong[block][1:]
        assert np.flatnonzero(scan_of(Reply("", "", tuple(wrong), 0), 3, 43).damaged).tolist() == list(
            range(first, last + 1)
        )


def test_every_single_flipped_bit_of_a_scan_is_noticed() -> None:
    """The sum keeps six bits; the two others are caught because no character of the 64 becomes another by them."""
    good = scan_of(read(vectors.SCAN)[0], 2, 40)
    first = vectors.SCAN.index(b"4SAF")
    for bit in range(8 * first, 8 * len(vectors.SCAN)):
        damaged = bytearray(vectors.SCAN)
        damaged[bit // 8] ^= 1 << bit % 8
        for item in read(bytes(damaged)):
            scan = scan_of(item, 2, 40) if isinstance(item, Reply) else None
            if scan is not None:
                assert scan.timestamp == good.timestamp
                np.testing.assert_array_equal(scan.values[~scan.damaged], good.values[~scan.damaged])


def test_a_wrong_status_sum_is_damage_and_an_endless_reply_is_bounded() -> None:
    assert read(b"QT\n00Q\n\n") == [Damage(DamageReason.BAD_SUM, 8)]
    decoder = ReplyDecoder()
    for _ in range(2000):
        assert decoder.receive(b"x" * 1000) == []
        assert len(decoder._buffer) <= MAX_REPLY_BYTES + 1000
    assert decoder.receive(b"\n\n") == [Damage(DamageReason.TOO_LONG, 2_000_002)]
    assert decoder.receive(vectors.STOPPED)[0].echo == "QT"


def test_the_number_of_values_counts_the_last_short_cluster() -> None:
    assert n_steps(44, 725, 1) == 682
    assert n_steps(0, 9, 3) == 4
    assert n_steps(0, 8, 3) == 3
