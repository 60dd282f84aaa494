"""What must hold for any bytes whatever: one function a parser, for Hypothesis and for the fuzzer alike.

A target takes bytes and raises when a law is broken: the pieces in which bytes come do not matter, every byte is
accounted for, memory is bounded, and good frames are understood again afterwards.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from drivers.protocols import lms, ls100, native, rplidar, scip
from drivers.protocols.framing import Damage
from drivers.protocols.lms_host import LmsHost
from drivers.protocols.ls100_host import Ls100Host
from drivers.protocols.rplidar_host import RplidarHost
from drivers.protocols.rplidar_ultra import UltraCapsule
from drivers.protocols.scip_host import ScipHost
from drivers.protocols.scip_plan import ScipOptions
from simulators.devices.lms import LmsDevice
from simulators.devices.ls100 import Ls100Device
from simulators.devices.rplidar import RplidarDevice
from simulators.devices.scip import ScipDevice
from tests.unit.drivers.conversation_bench import ConversationBench, flat_scene
from tests.vectors import lms as lms_vectors
from tests.vectors import ls100 as ls100_vectors
from tests.vectors import native as native_vectors
from tests.vectors import rplidar as rplidar_vectors
from tests.vectors import scip as scip_vectors

Target = Callable[[bytes], None]


def pieces(data: bytes) -> list[bytes]:
    """The bytes in pieces whose lengths are made of the bytes themselves, so that a fuzzer can choose them."""
    cut, at, step = [], 0, 1
    while at < len(data):
        step = 1 + data[at] % 7 * (1 + step % 5)
        cut.append(data[at : at + step])
        at += step
    return cut


def same(found: list[Any], expected: list[Any]) -> bool:
    """Equality that looks into arrays."""
    return list(map(repr, found)) == list(map(repr, expected))


def parser(
    make: Callable[[], Any],
    good: bytes,
    wanted: Callable[[list[Any]], bool],
    bound: int,
    *,
    asks_for: int | None = None,
) -> Target:
    """The laws of a decoder; `good` is understood after anything, by `wanted`; at most `bound` bytes are kept."""

    def target(data: bytes) -> None:
        whole, cut = make(), make()
        before = whole.accepted_bytes
        found = whole.receive(data)
        again = [item for piece in pieces(data) for item in cut.receive(piece)]
        assert same(found, again), (found, again)
        damaged = sum(item.n_bytes for item in found if isinstance(item, Damage))
        padding = getattr(whole, "padding_bytes", 0)
        assert whole.accepted_bytes - before + damaged + padding + whole.pending_bytes == len(data)
        kept = [value for value in vars(whole).values() if isinstance(value, bytearray)]
        assert sum(map(len, kept)) <= bound
        if asks_for is not None:
            whole.expect(asks_for)
        assert wanted(whole.receive(good)), "good frames are not understood any more"

    return target


def in_stream(descriptor: bytes) -> rplidar.AnswerDecoder:
    """An RPLIDAR's decoder in the middle of a stream."""
    decoder = rplidar.AnswerDecoder()
    decoder.receive(descriptor)
    return decoder


def has(kind: type, count: int = 1) -> Callable[[list[Any]], bool]:
    """True when so many of a kind were understood."""
    return lambda found: sum(isinstance(item, kind) for item in found) >= count


_SAMPLES = b"".join(rplidar.sample_bytes(rplidar.Sample(k == 0, 17 + k % 9, k * 115, 4000 + 37 * k)) for k in range(60))

PARSERS: dict[str, Target] = {
    "native": parser(
        native.Decoder,
        b"\0\0" + native_vectors.frame_by_hand(bytes.fromhex(native_vectors.FROM_DEVICE["chunk"][1])) * 2,
        has(native.Chunk),
        600,
    ),
    "scip": parser(scip.ReplyDecoder, b"\n\n" + scip_vectors.STOPPED * 2, has(scip.Reply), scip.MAX_REPLY_BYTES + 1),
    "lms": parser(lms.TelegramDecoder, b"\x55" * 900 + lms_vectors.MODE_REPLY, has(lms.Telegram), 820),
    "lms_requests": parser(
        partial(lms.TelegramDecoder, from_host=True),
        b"\x55" * 900 + lms_vectors.VARIANT_REQUEST,
        has(lms.Telegram),
        820,
    ),
    "ls100": parser(ls100.FrameDecoder, b"\x55" * 600 + ls100_vectors.SIZE_REPLY, has(ls100.Frame), 520),
    "rplidar": parser(
        rplidar.AnswerDecoder, rplidar_vectors.HEALTH, has(rplidar.Packet), 520, asks_for=rplidar.Answer.HEALTH
    ),
    "rplidar_samples": parser(
        partial(in_stream, rplidar_vectors.STANDARD_DESCRIPTOR), _SAMPLES, has(rplidar.Sample, 40), 520
    ),
    "rplidar_capsules": parser(
        partial(in_stream, rplidar_vectors.EXPRESS_DESCRIPTOR), rplidar_vectors.CAPSULE * 3, has(rplidar.Capsule), 520
    ),
    "rplidar_ultra": parser(
        partial(in_stream, rplidar_vectors.ULTRA_DESCRIPTOR), rplidar_vectors.ULTRA * 3, has(UltraCapsule), 520
    ),
}


def profile(_elapsed_s: float) -> tuple[np.ndarray, np.ndarray]:
    return np.linspace(-5, 5, 40), np.zeros(40)


_BENCHES: dict[str, Callable[[], ConversationBench]] = {
    "scip_host": lambda: ConversationBench(
        partial(ScipHost, options=ScipOptions(field_of_view_rad=(-0.1, 0.1), work_rate=None)),
        ScipDevice(flat_scene(), baud_rate=115_200),
    ),
    "lms_host": lambda: ConversationBench(LmsHost, LmsDevice(flat_scene(), rng=np.random.default_rng(1))),
    "rplidar_host": lambda: ConversationBench(RplidarHost, RplidarDevice(flat_scene())),
    "ls100_host": lambda: ConversationBench(Ls100Host, Ls100Device(profile)),
}


def conversation(make: Callable[[], ConversationBench]) -> Target:
    """The laws of a driver's half that is measuring: any bytes, an account that balances, and it measures on."""

    def target(data: bytes) -> None:
        bench = make().meet()
        bench.start()
        bench.scan(1)
        for piece in pieces(data):
            bench.host.receive(piece, bench.now_s)
            bench.run(0.004)
        before = bench.host.tally().lines.stored
        assert bench.run(60.0, lambda: bench.host.tally().lines.stored > before + 1), bench.host.tally()
        tally = bench.host.tally()
        assert tally.lines.balances
        assert tally.chunks.balances
        for line in bench.lines:
            assert not np.isinf(line.x_mm).any()
            assert not np.isinf(line.z_mm).any()

    return target


def device(make: Callable[[], ConversationBench]) -> Target:
    """The law of a simulated device: any bytes from a host, and it can be met afterwards."""

    def target(data: bytes) -> None:
        bench = make()
        for piece in pieces(data):
            bench.device.receive(piece, bench.now_s)
            bench.run(0.004)
        assert len(bench.device.transmit(bench.now_s, 64)) <= 64

    return target


CONVERSATIONS: dict[str, Target] = {name: conversation(make) for name, make in _BENCHES.items()}
DEVICES: dict[str, Target] = {name.replace("host", "device"): device(make) for name, make in _BENCHES.items()}
TARGETS: dict[str, Target] = PARSERS | CONVERSATIONS | DEVICES


def seeds(name: str) -> list[bytes]:
    """Well-formed bytes to begin from: the hand-made vectors of the target's protocol."""
    vectors = {"scip": scip_vectors, "lms": lms_vectors, "ls100": ls100_vectors, "rplidar": rplidar_vectors}
    protocol = name.partition("_")[0]
    if protocol == "native":
        return [native_vectors.frame_by_hand(bytes.fromhex(body)) for _, body in native_vectors.FROM_DEVICE.values()]
    return [value for value in vars(vectors[protocol]).values() if isinstance(value, bytes)]
