"""The RPLIDAR's bytes: requests, descriptors, samples, capsules; whole, byte by byte and with noise around."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.protocols.framing import Damage
from drivers.protocols.rplidar import (
    Answer,
    AnswerDecoder,
    Capsule,
    Command,
    Conf,
    Descriptor,
    Packet,
    RequestDecoder,
    Sample,
    capsule_bytes,
    conf_request,
    descriptor,
    is_capsule,
    is_sample,
    read_capsule,
    read_sample,
    request,
    sample_bytes,
)
from drivers.protocols.rplidar_turns import Turn, TurnCollector
from drivers.protocols.rplidar_ultra import coded, decoded, read_ultra, ultra_bytes
from tests.vectors import rplidar as vectors

SINGLE = {
    "INFO": (Answer.INFO, vectors.INFO),
    "HEALTH": (Answer.HEALTH, vectors.HEALTH),
    "SAMPLERATE": (Answer.SAMPLERATE, vectors.SAMPLERATE),
    "CONF": (Answer.CONF, vectors.CONF_TYPICAL_MODE_IS_1),
}
NOISE = [b"", b"\xa5" * 5, b"RP LIDAR System.\r\n", b"\xa5\x5a\xff\xff\xff\xff\x04" * 2]


@pytest.mark.parametrize("name", SINGLE)
@pytest.mark.parametrize("noise", NOISE)
def test_every_single_answer_is_read_whole_and_byte_by_byte_with_noise_around(name: str, noise: bytes) -> None:
    kind, data = SINGLE[name]
    stream = noise + data + noise + data
    whole, single = AnswerDecoder(), AnswerDecoder()
    found = whole.receive(stream)
    assert [item for at in range(len(stream)) for item in single.receive(stream[at : at + 1])] == found
    packets = [item for item in found if isinstance(item, Packet)]
    assert packets == [Packet(kind, data[7:])] * 2
    damaged = sum(item.n_bytes for item in found if isinstance(item, Damage))
    assert whole.accepted_bytes + damaged + whole.pending_bytes == len(stream)


def test_requests_are_written_and_heard() -> None:
    assert request(Command.GET_INFO) == vectors.INFO_REQUEST
    assert request(Command.EXPRESS_SCAN, bytes(5)) == vectors.EXPRESS_REQUEST
    assert request(Command.SET_MOTOR_PWM, (660).to_bytes(2, "little")) == vectors.PWM_REQUEST
    heard = RequestDecoder()
    stream = b"AT\r" + vectors.INFO_REQUEST + vectors.PWM_REQUEST[:-1] + b"\0" + vectors.EXPRESS_REQUEST
    assert [item for at in range(len(stream)) for item in heard.receive(stream[at : at + 1])] == [
        (Command.GET_INFO, b""),
        (Command.EXPRESS_SCAN, bytes(5)),
    ]
    assert conf_request(Conf.US_PER_SAMPLE, 1) == bytes.fromhex("a5 84 06 71 00 00 00 01 00 57")


def test_a_sample_is_read_and_written() -> None:
    expected = Sample(True, 15, round(90.5 * 64), round(1234.25 * 4))
    assert read_sample(vectors.SAMPLE) == expected
    assert sample_bytes(expected) == vectors.SAMPLE
    assert read_sample(vectors.SAMPLE_NOTHING) == Sample(False, 0, round(90.5 * 64), 0)
    assert not is_sample(b"\x03" + vectors.SAMPLE[1:])
    assert not is_sample(vectors.SAMPLE[:1] + b"\x40" + vectors.SAMPLE[2:])


def test_a_capsule_is_read_and_written_and_its_angles_follow_from_the_next() -> None:
    assert is_capsule(vectors.CAPSULE)
    capsule = read_capsule(vectors.CAPSULE, Answer.EXPRESS)
    assert capsule.start_q6 == 5 * 64
    assert capsule.is_first
    assert capsule.distance_mm.reshape(16, 2).tolist() == [[1000 + k, 2000 + k] for k in range(16)]
    assert capsule.offset_q3.tolist() == [5, 0x21] * 16
    signed = read_capsule(vectors.CAPSULE, Answer.EXPRESS, signed_offsets=True)
    assert signed.offset_q3.tolist() == [5, -1] * 16
    assert capsule_bytes(capsule) == vectors.CAPSULE
    angles, distances, _ = capsule.samples(replace(capsule, start_q6=13 * 64))  # a quarter of a degree a sample
    np.testing.assert_array_equal(distances, capsule.distance_mm)
    np.testing.assert_allclose(angles, 5 + np.arange(32) / 4 - np.tile([5, 33], 16) / 8)
    over_zero = Capsule(Answer.EXPRESS, 359 * 64, False, np.zeros(32), np.zeros(32, dtype=int))
    angles, _, _ = over_zero.samples(replace(over_zero, start_q6=3 * 64))
    np.testing.assert_allclose(angles[[0, 8, 31]], [359, 0, 2.875])


def test_an_ultra_capsule_made_by_hand_says_what_it_should() -> None:
    assert is_capsule(vectors.ULTRA)
    capsule = read_ultra(vectors.ULTRA)
    assert (capsule.start_q6, capsule.is_first) == (5 * 64, True)
    angles, distances, turned = capsule.samples(replace(capsule, start_q6=29 * 64))
    np.testing.assert_allclose(turned, 5 + np.arange(96) / 4)
    # 800 mm is code 656, beyond 512 a code counts two; the steps from it and from the next, which is 0, are 3 and 5
    assert distances[:4].tolist() == [800, 806, 5, 0]
    assert distances[-3:].tolist() == [0, 800, 800]  # the last cabin's steps are none from the next capsule's first
    aside = np.degrees(np.radians(8) - (98_361 // 3200 * 64) / (1 << 16))
    np.testing.assert_allclose((turned[0] - angles[0]) % 360, aside, atol=1e-3)
    np.testing.assert_allclose((turned[3] - angles[3]) % 360, 7.5, atol=1e-3)


def test_twelve_bits_hold_28_metres_the_coarser_the_farther() -> None:
    codes = np.arange(4096)
    distance_mm, level = decoded(codes)
    assert (np.diff(distance_mm) == 1 << level[:-1]).all()
    np.testing.assert_array_equal(coded(distance_mm)[0], codes)
    assert (distance_mm[0], distance_mm[-1]) == (0, 28_656)
    every = np.arange(28_657)
    back, level = decoded(coded(every)[0])
    assert ((every - back >= 0) & (every - back < 1 << level)).all()


@given(st.integers(0, 360 * 64 - 1), st.lists(st.integers(0, 28_000), min_size=33, max_size=33), st.data())
def test_what_an_ultra_capsule_says_is_read_again(start_q6: int, majors: list[int], data: st.DataObject) -> None:
    near = st.integers(-400, 400)
    rest = np.array(data.draw(st.lists(near, min_size=64, max_size=64))).reshape(32, 2)
    said = np.column_stack([majors[:-1], np.add(majors[:-1], rest[:, 0]), np.add(majors[1:], rest[:, 1])])
    said = np.where(said > 0, said, 0).astype(float)
    said[::7, 1] = 0
    wire = ultra_bytes(start_q6, said.reshape(-1), float(majors[-1]), is_first=False)
    assert is_capsule(wire)
    following = read_ultra(ultra_bytes(start_q6, np.full(96, float(majors[-1])), 0.0, is_first=False))
    _, heard, _ = read_ultra(wire).samples(following)
    said = said.reshape(-1)
    np.testing.assert_array_equal(heard[said == 0] == 0, True)
    there = (said > 0) & (heard > 0)
    _, level = coded(np.repeat(np.maximum(majors[:-1], majors[1:]), 3))
    assert (np.abs(heard - said)[there] <= (1 << level)[there]).all()
    told_from = np.column_stack([majors[:-1], np.where(majors[:-1], majors[:-1], majors[1:]), majors[1:]]).reshape(-1)
    lost = (said > 0) & (heard == 0)  # too far from the one that it is told from, or the grain is as coarse as that
    assert ((np.abs(said - told_from) > 500 << level) | (said < 1 << level))[lost].all()


@given(st.data())
def test_what_a_capsule_says_is_read_again(data: st.DataObject) -> None:
    kind = data.draw(st.sampled_from([Answer.EXPRESS, Answer.DENSE]))
    n, top = (32, 1 << 14) if kind is Answer.EXPRESS else (40, 1 << 16)
    distances = np.array(data.draw(st.lists(st.integers(0, top - 1), min_size=n, max_size=n)), dtype=float)
    offsets = data.draw(st.lists(st.integers(0, 63), min_size=n, max_size=n))
    said = Capsule(
        kind,
        data.draw(st.integers(0, 360 * 64 - 1)),
        data.draw(st.booleans()),
        distances,
        np.array(offsets if kind is Answer.EXPRESS else [0] * n),
    )
    heard = read_capsule(capsule_bytes(said), kind)
    assert (heard.start_q6, heard.is_first) == (said.start_q6, said.is_first)
    np.testing.assert_array_equal(heard.distance_mm, said.distance_mm)
    np.testing.assert_array_equal(heard.offset_q3, said.offset_q3)


def test_every_single_flipped_bit_of_a_capsule_is_noticed() -> None:
    for bit in range(8 * len(vectors.CAPSULE)):
        damaged = bytearray(vectors.CAPSULE)
        damaged[bit // 8] ^= 1 << bit % 8
        assert not is_capsule(damaged)


def test_a_stream_of_samples_is_found_again_after_lost_bytes() -> None:
    rng = np.random.default_rng(4)
    samples = [Sample(k % 100 == 0, 20, int(k % 100 * 230.4), int(rng.integers(1, 9000))) for k in range(400)]
    wire = b"".join(map(sample_bytes, samples))
    decoder = AnswerDecoder()
    decoder.receive(vectors.STANDARD_DESCRIPTOR)
    found = decoder.receive(wire[:777] + wire[784:1500] + b"\x17\x17\x17" + wire[1500:])
    read = [item for item in found if isinstance(item, Sample)]
    wrong = [sample for sample in read if sample not in samples]
    assert len(read) >= 390
    assert len(wrong) <= 2  # at each of the two places one sample may still look like one
    assert read[-100:] == samples[-100:]
    assert decoder.accepted_bytes + sum(i.n_bytes for i in found if isinstance(i, Damage)) == 7 + len(wire) - 4


def test_a_stream_of_capsules_is_found_again_after_lost_bytes() -> None:
    capsules = [
        Capsule(Answer.EXPRESS, (k * 11 % 360) * 64, False, np.full(32, 1000.0 + k), np.zeros(32, dtype=int))
        for k in range(30)
    ]
    wire = b"".join(map(capsule_bytes, capsules))
    decoder = AnswerDecoder()
    [begin] = decoder.receive(vectors.EXPRESS_DESCRIPTOR)
    assert begin == Descriptor(Answer.EXPRESS, 84, True)
    found = decoder.receive(wire[:1000] + wire[1003:])
    read = [int(item.distance_mm[0]) - 1000 for item in found if isinstance(item, Capsule)]
    assert read == [k for k in range(30) if k != 1000 // 84]
    assert [item.n_bytes for item in found if isinstance(item, Damage)] == [81]


def test_a_request_ends_a_stream_and_no_length_is_trusted() -> None:
    decoder = AnswerDecoder()
    decoder.receive(vectors.STANDARD_DESCRIPTOR + vectors.SAMPLE)
    decoder.expect(Answer.HEALTH)
    assert [type(item) for item in decoder.receive(vectors.SAMPLE + vectors.HEALTH)] == [Damage, Descriptor, Packet]
    for lie in (descriptor(Answer.INFO, 1 << 29, many=False), descriptor(Answer.INFO, 20, many=True)):
        assert AnswerDecoder().receive(lie + vectors.HEALTH)[-1] == Packet(Answer.HEALTH, vectors.HEALTH[7:])
    assert AnswerDecoder().receive(descriptor(Answer.CONF, 513, many=False)) == []


# ---- turns ----------------------------------------------------------------------------------------------------------


def turns_of(collector: TurnCollector, items: list) -> list[Turn]:
    take = {Sample: collector.sample, Capsule: collector.capsule}
    return [turn for item in items if (turn := take[type(item)](item)) is not None]


def standard_turns(n_turns: int, per_turn: int = 200) -> list[Sample]:
    return [
        Sample(k % per_turn == 0, 20, int(k % per_turn * 360 * 64 / per_turn), 4 * (1000 + k // per_turn))
        for k in range(n_turns * per_turn)
    ]


def test_samples_become_whole_turns_and_what_came_before_the_first_belongs_to_none() -> None:
    turns = turns_of(TurnCollector(), standard_turns(5)[70:])
    assert [len(turn.angle_rad) for turn in turns] == [200] * 3
    assert [set(turn.range_mm.tolist()) for turn in turns] == [{1001.0}, {1002.0}, {1003.0}]
    for turn in turns:
        assert (np.diff(turn.angle_rad) > 0).all()
        assert not turn.missing.any()
    assert np.diff([turn.first_sample for turn in turns]).tolist() == [200, 200]


def test_a_lost_beginning_of_a_turn_is_found_by_the_angle() -> None:
    samples = standard_turns(5)
    del samples[400]
    assert len(turns_of(TurnCollector(), samples)) == 4


def test_an_angle_that_cannot_be_is_missing_and_not_believed() -> None:
    samples = standard_turns(3)
    samples[250] = samples[250]._replace(angle_q6=samples[250].angle_q6 ^ 1 << 14)
    collector = TurnCollector()
    turns = turns_of(collector, [*samples, samples[0]])
    assert collector.implausible == 1
    assert [int(turn.missing.sum()) for turn in turns] == [0, 1, 0]
    assert [len(turn.angle_rad) for turn in turns] == [200, 200, 200]


def express_turns(n_capsules: int) -> list[Capsule]:
    """Eleven degrees a capsule, so that a turn ends inside one."""
    return [
        Capsule(Answer.EXPRESS, (k * 11 % 360) * 64, k == 0, np.full(32, 500.0), np.zeros(32, dtype=int))
        for k in range(n_capsules)
    ]


def test_capsules_become_whole_turns() -> None:
    turns = turns_of(TurnCollector(), express_turns(140))
    assert len(turns) == 3
    for turn in turns:
        assert abs(len(turn.angle_rad) - 360 / 11 * 32) <= 1
        assert np.ptp(turn.angle_rad) > np.radians(359)


def test_a_lost_capsule_takes_the_one_before_and_both_are_missing() -> None:
    capsules = express_turns(140)
    collector = TurnCollector()
    turns = turns_of(collector, capsules[:60])
    collector.lost_bytes(84)
    turns += turns_of(collector, capsules[61:])
    assert [int(turn.missing.sum()) for turn in turns] == [64, 0, 0]
    assert abs(len(turns[0].angle_rad) - 360 / 11 * 32) <= 1
    assert np.diff([turn.first_sample for turn in turns])[0] == len(turns[0].angle_rad)


def test_a_turn_without_an_end_is_bounded() -> None:
    collector = TurnCollector()
    collector.sample(Sample(True, 1, 0, 4))
    for _ in range(70_000):
        assert collector.sample(Sample(False, 1, 64, 4)) is None
    assert collector._open is None
