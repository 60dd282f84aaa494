"""A line encoded and decoded is the same line, bit for bit, and no other bytes are taken for one."""

import struct
from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from scanner_service.analysis.intake import StoredLine
from scanner_service.storage.encoding import PACKED, PLAIN, decode_line, encode_line
from scanner_service.storage.errors import LineDamaged, NotStorable
from scanner_service.storage.packing import pack, unpack

INT64 = st.integers(-(2**63), 2**63 - 1)
ANY_FLOAT = st.integers(0, 2**64 - 1).map(lambda bits: struct.unpack("<d", struct.pack("<Q", bits))[0])
ANY_VECTOR = hnp.arrays(np.uint64, 3).map(lambda bits: bits.view(np.float64))
TEXT = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=20)
RUNS = st.lists(st.tuples(st.integers(0, 50), st.integers(1, 30)), max_size=6).map(
    lambda runs: np.concatenate([np.arange(a, a + n) for a, n in runs] or [np.zeros(0)]).astype(np.int32)
)
FORMATS = st.sampled_from([PLAIN, PACKED])
INDEX = st.one_of(RUNS, hnp.arrays(np.int32, st.integers(0, 40)))


@st.composite
def stored_lines(draw: st.DrawFn) -> StoredLine:
    index = draw(INDEX)
    return StoredLine(
        device_id=draw(TEXT),
        boot_id=draw(INT64),
        pass_index=draw(INT64),
        line_index=draw(INT64),
        device_time_s=draw(ANY_FLOAT),
        xyz_q=draw(hnp.arrays(np.int32, (len(index), 3))),
        index=index,
        point_count=draw(st.integers(0, 2**32 - 1)),
        laser_mm=draw(ANY_VECTOR),
        plane_normal=draw(ANY_VECTOR),
        travel=draw(ANY_VECTOR),
        position_mm=draw(ANY_FLOAT),
        line_spacing_mm=draw(ANY_FLOAT),
        step_mm=draw(ANY_FLOAT),
        dropped=draw(st.dictionaries(TEXT, st.integers(0, 2**64 - 1), max_size=4)),
    )


def bits(value: object) -> object:
    """What a field is, down to the payload of a NaN."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    return struct.pack("<d", value) if isinstance(value, float) else value


def a_line(**changes: object) -> StoredLine:
    given: dict[str, object] = {
        "device_id": "s1",
        "boot_id": 1,
        "pass_index": 0,
        "line_index": 5,
        "device_time_s": 0.5,
        "xyz_q": np.arange(12, dtype=np.int32).reshape(4, 3),
        "index": np.arange(7, 11, dtype=np.int32),
        "point_count": 11,
        "laser_mm": np.array([0.0, 0.0, 300.0]),
        "plane_normal": np.full(3, np.nan),
        "travel": np.full(3, np.nan),
        "position_mm": float("nan"),
        "line_spacing_mm": 0.2,
        "step_mm": -0.1,
        "dropped": {"dropout": 7},
    }
    return StoredLine(**(given | changes))  # type: ignore[arg-type]


@given(stored_lines(), FORMATS)
def test_decoding_gives_back_every_bit(line: StoredLine, version: int) -> None:
    back = decode_line(encode_line(line, version))
    for field in fields(StoredLine):
        assert bits(getattr(back, field.name)) == bits(getattr(line, field.name)), field.name
    assert list(back.dropped) == list(line.dropped)


@given(stored_lines(), FORMATS, st.data())
def test_a_line_cut_short_or_lengthened_is_never_taken_for_one(
    line: StoredLine, version: int, data: st.DataObject
) -> None:
    encoded = encode_line(line, version)
    with pytest.raises(LineDamaged):
        decode_line(encoded[: data.draw(st.integers(0, len(encoded) - 1))])
    with pytest.raises(LineDamaged):
        decode_line(encoded + data.draw(st.binary(min_size=1, max_size=20)))


@given(st.binary(max_size=400), FORMATS)
def test_any_bytes_are_refused_or_decoded_but_never_crash(noise: bytes, version: int) -> None:
    encoded = encode_line(a_line(), version)
    for attempt in (noise, encoded[:4] + noise, encoded[: len(encoded) - len(noise)] + noise):
        try:
            line = decode_line(attempt)
        except LineDamaged:
            continue
        assert len(line.index) == len(line.xyz_q)


def test_the_bytes_are_the_documented_ones() -> None:
    encoded = encode_line(a_line(), PLAIN)
    nan = bytes.fromhex("000000000000f87f")
    expected = b"SL\x01\x01" + struct.pack("<qqq", 1, 0, 5) + struct.pack("<d", 0.5) + nan
    expected += struct.pack("<dd", 0.2, -0.1) + struct.pack("<ddd", 0, 0, 300) + 6 * nan
    expected += struct.pack("<IIIHH", 11, 4, 2, 1, 2) + b"s1" + struct.pack("<HQ", 7, 7) + b"dropout"
    expected += struct.pack("<ii", 7, 4) + struct.pack("<12i", *range(12))
    assert encoded == expected
    packed = encode_line(a_line())
    assert packed[:2] + packed[3:-39] == expected[:2] + expected[3:-48]
    columns = b"".join(struct.pack("<iiBBH", first, 3, width, 0, 0) for first, width in ((0, 0), (1, 0), (2, 1)))
    assert packed[2:3] + packed[-39:] == bytes([PACKED]) + columns + bytes(3)


@st.composite
def columns_with_edges(draw: st.DrawFn) -> np.ndarray[tuple[int, int], np.dtype[np.int32]]:
    """Three columns of small steps with edges of any height between them; they go round where 32 bits end."""
    count = draw(st.integers(0, 60))
    small = draw(st.sampled_from([0, 1, 127, 300, 32_767, 40_000]))
    step = st.one_of(
        st.integers(-small, small), st.integers(-(2**31), 2**31 - 1) if draw(st.booleans()) else st.just(7)
    )
    steps = np.array(draw(st.lists(st.lists(step, min_size=3, max_size=3), min_size=count, max_size=count)), np.int64)
    return np.cumsum(steps.reshape(count, 3), axis=0).astype(np.int32)


@given(columns_with_edges())
def test_packed_coordinates_come_back_and_take_no_more_than_plain_ones_and_three_heads(
    xyz_q: np.ndarray[tuple[int, int], np.dtype[np.int32]],
) -> None:
    packed = pack(xyz_q)
    assert len(packed) <= 12 * len(xyz_q) + 36
    assert np.array_equal(unpack(packed, len(xyz_q)), xyz_q)
    for count in {len(xyz_q) + 1, max(len(xyz_q) - 1, 0), 2**32 - 1} - {len(xyz_q)}:
        with pytest.raises(LineDamaged):
            unpack(packed, count)


def test_a_full_line_costs_its_coordinates_and_a_small_header() -> None:
    line = a_line(xyz_q=np.ones((1280, 3), np.int32), index=np.arange(1280, dtype=np.int32), point_count=1280)
    assert len(encode_line(line, PLAIN)) <= 1280 * 12 + 200


def test_a_line_over_a_smooth_part_with_noise_and_edges_takes_less_than_half_when_packed() -> None:
    rng = np.random.default_rng(5)
    x_mm = 0.15 * np.arange(1280) + rng.normal(0, 0.005, 1280)
    z_mm = 3 * np.sin(x_mm / 9) + rng.normal(0, 0.01, 1280) + np.where(x_mm > 60, 25.0, 0.0)
    xyz_mm = np.column_stack([x_mm, np.full(1280, 12.2), z_mm])
    line = a_line(
        xyz_q=np.rint(xyz_mm * 8192).astype(np.int32), index=np.arange(1280, dtype=np.int32), point_count=1280
    )
    assert len(encode_line(line)) < 0.5 * len(encode_line(line, PLAIN))


@pytest.mark.parametrize(
    "changes",
    [
        {"boot_id": 2**63},
        {"line_index": -(2**63) - 1},
        {"point_count": -1},
        {"device_id": "\ud800"},
        {"device_id": "x" * 70_000},
        {"xyz_q": np.zeros((4, 3), np.int64)},
        {"xyz_q": np.zeros((3, 3), np.int32)},
        {"laser_mm": np.zeros(2)},
        {"laser_mm": np.zeros(3, np.float32)},
        {"dropped": {"dropout": -1}},
        {"dropped": {"dropout": 2**64}},
    ],
)
def test_what_would_not_come_back_the_same_is_refused(changes: dict[str, object]) -> None:
    with pytest.raises(NotStorable):
        encode_line(a_line(**changes))
