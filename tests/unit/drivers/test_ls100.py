"""The Profiler 2's and LS-100's frames: sums, reads, profiles; whole, byte by byte and with noise around."""

import numpy as np
import pytest

from drivers.protocols.framing import Damage
from drivers.protocols.ls100 import (
    PROFILE_ADDRESS,
    Frame,
    FrameDecoder,
    frame,
    header_data,
    read_header,
    read_points,
    read_request,
    reads_of_profile,
)
from tests.vectors import ls100 as vectors

FRAMES = {name: value for name, value in vars(vectors).items() if isinstance(value, bytes) and not name.startswith("_")}


@pytest.mark.parametrize("name", FRAMES)
@pytest.mark.parametrize("noise", [b"", b"\x02", b"\x02\xff\x02\x10", b"\x03" * 9, bytes(range(3, 100))])
def test_every_frame_is_read_whole_and_byte_by_byte_with_noise_around(name: str, noise: bytes) -> None:
    stream = noise + FRAMES[name] + noise + FRAMES[name] + b"\x55" * 600
    whole, single = FrameDecoder(), FrameDecoder()
    found = whole.receive(stream)
    assert [item for at in range(len(stream)) for item in single.receive(stream[at : at + 1])] == found
    assert [item.whole for item in found if isinstance(item, Frame)] == [FRAMES[name]] * 2
    damaged = sum(item.n_bytes for item in found if isinstance(item, Damage))
    assert whole.accepted_bytes + damaged + whole.pending_bytes == len(stream)


def test_requests_are_written() -> None:
    assert frame(PROFILE_ADDRESS) == vectors.ASK_ADDRESS
    assert read_request(0x12345678, 1, 1) == vectors.ASK_SIZE
    assert read_request(0x1234567C, 3, 2) == vectors.ASK_POINTS
    with pytest.raises(ValueError, match="cannot be read at once"):
        read_request(0, 127, 2)
    with pytest.raises(ValueError, match="0 to 255 words"):
        frame(2, b"\x01")


def test_both_readings_of_the_size_are_read_and_a_switch_decides_between_them() -> None:
    [plain], [timed] = (FrameDecoder().receive(data) for data in (vectors.SIZE_REPLY, vectors.SIZE_REPLY_WITH_TIME))
    for has_time in (None, False):
        assert read_header(plain.data, has_time=has_time) == (3, None)
    for has_time in (None, True):
        assert read_header(timed.data, has_time=has_time) == (3, 258)
    for data, has_time in ((plain.data, True), (timed.data, False), (plain.data[:4], None)):
        with pytest.raises(ValueError, match="not the form"):
            read_header(data, has_time=has_time)
    assert header_data(0x12345678, 3, 258) == timed.data


def test_points_are_read_and_what_was_not_measured_is_no_number() -> None:
    [reply] = FrameDecoder().receive(vectors.POINTS_REPLY)
    x_mm, z_mm, nothing = read_points(reply.data, 3)
    np.testing.assert_allclose(x_mm, [-0.1, np.nan, 0.1])
    np.testing.assert_allclose(z_mm, [1.0, np.nan, -1.0])
    assert nothing.tolist() == [False, True, False]
    assert read_points(reply.data + b"\0\0", 3)[0].tolist()[0] == -0.1  # the manual's example is a word longer
    for n_points in (2, 4):
        with pytest.raises(ValueError, match="do not hold"):
            read_points(reply.data, n_points)


def test_a_profile_is_read_in_pieces_that_cover_it_once() -> None:
    reads = reads_of_profile(0x03062000, 832)
    assert reads[0] == (0x03062004, 126)
    assert reads[1][0] - reads[0][0] == 252
    assert sum(n for _, n in reads) == 832
    assert len(reads) == 7
    thinned = reads_of_profile(0x03062000, 832, 3)
    assert sum(n for _, n in thinned) == 278
    assert thinned[1][0] - thinned[0][0] == 252 * 3


def test_every_single_flipped_bit_is_noticed() -> None:
    for bit in range(8 * len(vectors.POINTS_REPLY)):
        damaged = bytearray(vectors.POINTS_REPLY)
        damaged[bit // 8] ^= 1 << bit % 8
        assert not any(isinstance(item, Frame) for item in FrameDecoder().receive(bytes(damaged) + b"\x55" * 600))
