"""The native protocol's bytes: every vector whole, byte by byte and with garbage around; no byte is unaccounted for."""

import re
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.protocols.framing import MAX_BODY_BYTES, MAX_FRAME_BYTES, Damage, DamageReason, frame
from drivers.protocols.native import MAX_POINTS_PER_CHUNK, Decoder, encode
from drivers.protocols.native_messages import Chunk, Message, OtherVersion
from tests.singles import apart
from tests.vectors.native import FROM_DEVICE, FROM_HOST, WHOLE_FRAMES, crc32_bit_by_bit, frame_by_hand

VECTORS = [(name, message, bytes.fromhex(body), False) for name, (message, body) in FROM_DEVICE.items()]
VECTORS += [(name, message, bytes.fromhex(body), True) for name, (message, body) in FROM_HOST.items()]
DEVICE_FRAMES = [frame_by_hand(bytes.fromhex(body)) for _, body in FROM_DEVICE.values()]
DEVICE_MESSAGES = [message for message, _ in FROM_DEVICE.values()]
SPECIFICATION = Path(__file__).resolve().parents[3] / "docs" / "protocol.md"


def same(a: Message | Damage, b: Message | Damage) -> bool:
    """Equality that looks into arrays; their dtype is that of the wire on one side only."""
    if isinstance(a, Chunk) and isinstance(b, Chunk):
        named = [field.name for field in fields(Chunk) if field.name != "points"]
        return all(getattr(a, name) == getattr(b, name) for name in named) and np.array_equal(a.points, b.points)
    return repr(a) == repr(b)


def all_same(found: list[Message | Damage], expected: list[Message | Damage]) -> bool:
    found, expected = apart(found), apart(expected)
    return len(found) == len(expected) and all(map(same, found, expected))


def accounted_bytes(decoder: Decoder, found: list[Message | Damage]) -> int:
    damaged = sum(item.n_bytes for item in found if isinstance(item, Damage))
    return decoder.accepted_bytes + damaged + decoder.padding_bytes + decoder.pending_bytes


@pytest.mark.parametrize(("name", "message", "body", "from_host"), VECTORS, ids=[vector[0] for vector in VECTORS])
def test_every_message_is_written_as_the_hand_written_bytes(
    name: str, message: Message, body: bytes, from_host: bool
) -> None:
    assert encode(message).hex(" ") == frame_by_hand(body).hex(" ")


@pytest.mark.parametrize(("name", "message", "body", "from_host"), VECTORS, ids=[vector[0] for vector in VECTORS])
@pytest.mark.parametrize("garbage", [b"", b"\x55" * 7, b"\0\0\0", bytes(range(1, 256)) * 3])
def test_every_vector_is_read_whole_and_byte_by_byte_with_garbage_around(
    name: str, message: Message, body: bytes, from_host: bool, garbage: bytes
) -> None:
    stream = garbage + frame_by_hand(body) + garbage + frame_by_hand(body) + b"\0"
    whole, single = Decoder(from_host=from_host), Decoder(from_host=from_host)
    found = whole.receive(stream)
    assert all_same([item for item in found if not isinstance(item, Damage)], [message, message])
    byte_by_byte = [item for at in range(len(stream)) for item in single.receive(stream[at : at + 1])]
    assert all_same(found, byte_by_byte)
    assert accounted_bytes(whole, found) == accounted_bytes(single, byte_by_byte) == len(stream)


def test_whole_frames_written_by_hand_are_what_is_sent() -> None:
    for name, literal in WHOLE_FRAMES.items():
        assert encode(FROM_HOST[name][0]) == bytes.fromhex(literal)


def test_the_worked_examples_of_the_specification_are_right() -> None:
    text = SPECIFICATION.read_text(encoding="utf-8")
    frames = [bytes.fromhex(block) for block in re.findall(r"```frame\n(.*?)```", text, re.DOTALL)]
    bodies = [bytes.fromhex(block) for block in re.findall(r"```body\n(.*?)```", text, re.DOTALL)]
    assert frames == [
        encode(FROM_HOST["keepalive"][0]),
        encode(FROM_HOST["laser on"][0]),
        encode(FROM_DEVICE["chunk"][0]),
    ]
    assert frames[2] == frame_by_hand(bodies[0])
    assert f"{crc32_bit_by_bit(bodies[0]):08X}" in text
    assert f"{len(frames[2])} bytes" in text
    assert f"at most {MAX_POINTS_PER_CHUNK} points" in text


@given(st.binary(min_size=1, max_size=MAX_BODY_BYTES))
def test_a_frame_of_any_body_is_the_one_by_hand_and_fits_512_bytes(body: bytes) -> None:
    assert frame(body) == frame_by_hand(body)
    assert len(frame(body)) <= MAX_FRAME_BYTES


def test_the_longest_body_fits_512_bytes_whatever_it_holds() -> None:
    for filling in (b"\0", b"\x01", b"\xff"):
        assert len(frame(filling * MAX_BODY_BYTES)) <= MAX_FRAME_BYTES
    for length in (0, MAX_BODY_BYTES + 1):
        with pytest.raises(ValueError, match="body has 1 to 503 bytes"):
            frame(bytes(length))


@given(st.lists(st.sampled_from(DEVICE_FRAMES) | st.binary(max_size=40), max_size=12), st.data())
def test_chunking_does_not_matter_and_no_byte_is_lost(pieces: list[bytes], data: st.DataObject) -> None:
    stream = b"".join(pieces)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=20)))
    whole, cut = Decoder(), Decoder()
    found = whole.receive(stream)
    found_cut = []
    for start, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        found_cut += cut.receive(stream[start:end])
        assert cut.pending_bytes <= len(stream)
    assert all_same(found, found_cut)
    assert accounted_bytes(whole, found) == accounted_bytes(cut, found_cut) == len(stream)
    assert sum(damage.n_bytes for damage in cut.reset()) + accounted_bytes(cut, found_cut) == len(stream)


@given(st.integers(0, len(DEVICE_FRAMES) - 1), st.data())
def test_a_damaged_frame_is_never_accepted_and_its_neighbours_are_kept(which: int, data: st.DataObject) -> None:
    good = DEVICE_FRAMES[which]
    bad = bytearray(good)
    kind = data.draw(st.sampled_from(["flip", "drop", "double", "burst", "truncate"]))
    at = data.draw(st.integers(1, len(good) - 2))
    if kind == "flip":
        for place in data.draw(st.sets(st.integers(0, 8 * len(good) - 1), min_size=1, max_size=4)):
            bad[place // 8] ^= 1 << place % 8
    elif kind == "drop":
        del bad[at]
    elif kind == "double":
        bad[at:at] = bytes([bad[at] ^ data.draw(st.integers(0, 255))])
    elif kind == "burst":
        bad[at : at + 8] = data.draw(st.binary(min_size=8, max_size=8).filter(lambda burst: burst != good[at : at + 8]))
    else:
        del bad[at:]
    decoder = Decoder()
    stream = DEVICE_FRAMES[1] + bytes(bad) + DEVICE_FRAMES[2]
    found = decoder.receive(stream)
    messages = [item for item in found if not isinstance(item, Damage)]
    neighbours = [DEVICE_MESSAGES[1], DEVICE_MESSAGES[2]]
    if bytes(bad[1:-1]) == good[1:-1]:  # only its zeros were hit: what is between them may still be read
        assert all(any(same(message, sent) for sent in [*neighbours, DEVICE_MESSAGES[which]]) for message in messages)
    else:
        strangers = [m for m in apart(messages) if not any(same(m, sent) for sent in neighbours)]
        assert strangers == []
    if bad[:1] == bad[-1:] == b"\0":  # intact neighbours, both zeros included, are kept
        assert all_same([messages[0], messages[-1]], neighbours)
    assert accounted_bytes(decoder, found) == len(stream)


def test_a_hit_delimiter_costs_no_more_than_the_frame_it_belongs_to() -> None:
    first, second, third = DEVICE_FRAMES[1:4]
    wrecked = first[:-1] + b"\x77" + second + third
    messages = [item for item in Decoder().receive(wrecked) if not isinstance(item, Damage)]
    assert all_same(messages, DEVICE_MESSAGES[2:4])
    wrecked = first + b"\x77" + second[1:] + third
    messages = [item for item in Decoder().receive(wrecked) if not isinstance(item, Damage)]
    assert all_same(messages, [DEVICE_MESSAGES[1], DEVICE_MESSAGES[3]])


def test_endless_garbage_without_a_zero_is_counted_not_kept() -> None:
    decoder = Decoder()
    for _ in range(1000):
        assert decoder.receive(b"\xaa" * 1000) == []
    assert decoder.pending_bytes == 1_000_000
    assert len(decoder._frames._coded) <= MAX_FRAME_BYTES
    assert decoder.receive(b"\0") == [Damage(DamageReason.DEBRIS, 1_000_001)]


@pytest.mark.parametrize(
    ("stream", "reason"),
    [
        (b"\0" + b"\xaa" * 600 + b"\0", DamageReason.TOO_LONG),
        (b"\0\x09\x01\0", DamageReason.BAD_COBS),
        (b"\0\x02\x01\0", DamageReason.TOO_SHORT),
        (b"\0\x03\x85\x01\x05\x38\x31\xa4\x02\0", DamageReason.BAD_CRC),
        (frame_by_hand(b"\x77abc"), DamageReason.UNKNOWN_TYPE),
        (frame_by_hand(b"\x85\x01\x00"), DamageReason.UNKNOWN_TYPE),  # a host's command, echoed by the adapter
        (frame_by_hand(b"\x04\x00"), DamageReason.BAD_LAYOUT),
        (frame_by_hand(b"\x01"), DamageReason.BAD_LAYOUT),
        (b"\x55\x55\0", DamageReason.DEBRIS),
    ],
)
def test_every_damage_has_its_reason_and_its_bytes(stream: bytes, reason: DamageReason) -> None:
    assert Decoder().receive(stream) == [Damage(reason, len(stream))]


@pytest.mark.parametrize("name", FROM_DEVICE)
def test_an_intact_frame_with_another_layout_is_damage(name: str) -> None:
    body = bytes.fromhex(FROM_DEVICE[name][1])
    for wrong in (body[:-1], body + b"\x01"):
        found = Decoder().receive(frame_by_hand(wrong))
        assert found == [Damage(DamageReason.BAD_LAYOUT, len(frame_by_hand(wrong)))]


def test_of_a_hello_in_another_version_only_the_version_is_read() -> None:
    assert Decoder().receive(frame_by_hand(b"\x01\x02whatever")) == [OtherVersion(2)]
