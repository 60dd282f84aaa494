"""What each scanner protocol keeps and lets through on a bad wire: `python -m benchmarks.wires [--mutations N]`.

Two questions a protocol: at a bit error rate, which share of the frames that arrived intact (with the delimiters around
them) is understood; and of how many damaged frames the decoder believes one, taken alone, that says something else.
"""

import argparse
import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from drivers.protocols import lms, ls100, native, rplidar, scip
from drivers.protocols.native_messages import Chunk, PositionKind

RATES = (1e-6, 1e-5, 1e-4)
_DAMAGES = ("1 bit", "2 to 4 bits", "burst", "lost bytes", "doubled bytes", "swapped bytes")
BYTES_A_RATE = 4_000_000


@dataclass(frozen=True, slots=True)
class Wire:
    """A protocol's frames: how many kinds are made, what is heard of them, and what a frame says once heard.

    `frame(rng)` is one frame and what it must be heard as. `hear(data)` is everything that is believed of the bytes.
    """

    frame: Callable[[np.random.Generator], tuple[bytes, Any]]
    hear: Callable[[bytes], list[Any]]
    begins: bytes = b""


def _native_frame(rng: np.random.Generator) -> tuple[bytes, Any]:
    points = rng.integers(-(2**31), 2**31, (50, 2)).astype(np.int32)
    number = int(rng.integers(2**32))
    chunk = Chunk(7, number, 1, number, number, PositionKind.STAGE_NM, number, (0, 0, 0), 1, 1, 0, 0, 50, 0, points)
    return native.encode(chunk), (number, points.tobytes())


def _hear_native(data: bytes) -> list[Any]:
    return [
        (i.sequence, i.points.astype(np.int32).tobytes())
        for i in native.Decoder().receive(data)
        if isinstance(i, Chunk)
    ]


def _scip_frame(rng: np.random.Generator) -> tuple[bytes, Any]:
    values = rng.integers(20, 4000, 96)
    time = int(rng.integers(scip.CLOCK_SPAN))
    text = b"".join(scip.encode_value(int(value), 3) for value in values)
    return scip.reply("MD0000009501000", scip.SCANNING, scip.data_lines(time, text)), (time, tuple(values.tolist()))


def _hear_scip(data: bytes) -> list[Any]:
    """A scan with damaged blocks counts by its sound values; those are -1."""
    heard = []
    for item in scip.ReplyDecoder().receive(data):
        scan = scip.scan_of(item, 3, 96) if isinstance(item, scip.Reply) and item.status == scip.SCANNING else None
        if scan is not None:
            heard.append((scan.timestamp, tuple(np.where(scan.damaged, -1, scan.values).tolist())))
    return heard


def _lms_frame(rng: np.random.Generator) -> tuple[bytes, Any]:
    raw = rng.integers(0, 8000, 181)
    data = lms.values_data(lms.Values(raw, 1.0, None, 1, 2)) + b"\x10"
    return lms.telegram(0x81, lms.Reply.VALUES, data), data[:-1]


def _hear_lms(data: bytes) -> list[Any]:
    decoder = lms.TelegramDecoder()
    found = decoder.receive(data) + decoder.break_off()
    return [item.data for item in found if isinstance(item, lms.Telegram) and item.command == lms.Reply.VALUES]


def _ls100_frame(rng: np.random.Generator) -> tuple[bytes, Any]:
    data = rng.bytes(4 + 4 * 126)
    return ls100.frame(ls100.READ, data), data


def _hear_ls100(data: bytes) -> list[Any]:
    decoder = ls100.FrameDecoder()
    found = decoder.receive(data) + decoder.break_off()
    return [item.data for item in found if isinstance(item, ls100.Frame) and item.command == ls100.READ]


def _capsule_frame(rng: np.random.Generator) -> tuple[bytes, Any]:
    distances, start = rng.integers(100, 12_000, 32).astype(float), int(rng.integers(360 * 64))
    capsule = rplidar.Capsule(rplidar.Answer.EXPRESS, start, False, distances, np.zeros(32, dtype=np.int64))
    return rplidar.capsule_bytes(capsule), (start, tuple(distances.tolist()), (0,) * 32)


def _hear_capsules(data: bytes) -> list[Any]:
    found = rplidar.AnswerDecoder().receive(_EXPRESS + data)
    return [
        (item.start_q6, tuple(item.distance_mm.tolist()), tuple(item.offset_q3.tolist()))
        for item in found
        if isinstance(item, rplidar.Capsule)
    ]


def _sample_frame(rng: np.random.Generator) -> tuple[bytes, Any]:
    sample = rplidar.Sample(bool(rng.random() < 0.01), 30, int(rng.integers(360 * 64)), int(rng.integers(400, 48_000)))
    return rplidar.sample_bytes(sample), sample


def _hear_samples(data: bytes) -> list[Any]:
    return [item for item in rplidar.AnswerDecoder().receive(_STANDARD + data) if isinstance(item, rplidar.Sample)]


_EXPRESS = rplidar.descriptor(rplidar.Answer.EXPRESS, rplidar.CAPSULE_BYTES, many=True)
_STANDARD = rplidar.descriptor(rplidar.Answer.STANDARD, rplidar.SAMPLE_BYTES, many=True)
WIRES = {
    "native": Wire(_native_frame, _hear_native),
    "scip": Wire(_scip_frame, _hear_scip),
    "lms200": Wire(_lms_frame, _hear_lms),
    "ls100": Wire(_ls100_frame, _hear_ls100),
    "rplidar express": Wire(_capsule_frame, _hear_capsules),
    "rplidar standard": Wire(_sample_frame, _hear_samples),
}


def kept_at(wire: Wire, bit_error_rate: float, n_bytes: int, rng: np.random.Generator) -> dict[str, float]:
    """Frames sent, those that arrived intact with their neighbours' nearest bytes, and the share of them understood."""
    frames = [wire.frame(rng) for _ in range(64)]
    rounds = max(1, n_bytes // sum(len(data) for data, _ in frames))
    sent = intact = kept = wrong = 0
    for _ in range(rounds):
        stream = b"".join(data for data, _ in frames)
        bits = np.unpackbits(np.frombuffer(stream, dtype=np.uint8))
        flips = rng.choice(len(bits), size=rng.binomial(len(bits), bit_error_rate), replace=False)
        bits[flips] ^= 1
        hit = np.unique(flips // 8)
        heard = wire.hear(np.packbits(bits).tobytes())
        left = list(heard)
        at = 0
        for data, said in frames:
            sent += 1
            touched = np.searchsorted(hit, [at - 2, at + len(data) + 2])
            at += len(data)
            if touched[0] == touched[1]:
                intact += 1
                kept += said in left
            if said in left:
                left.remove(said)
        wrong += sum(not any(_agrees(item, said) for _, said in frames) for item in left)
    return {"sent": sent, "intact": intact, "kept": kept / intact if intact else float("nan"), "other_than_sent": wrong}


def mutated(data: bytes, rng: np.random.Generator) -> tuple[str, bytes]:
    """The kind of damage, and the frame with it; by chance it may be as it was."""
    damaged = bytearray(data)
    at, n = int(rng.integers(len(data))), int(rng.integers(1, 5))
    kind = _DAMAGES[int(rng.integers(len(_DAMAGES)))]
    match kind:
        case "1 bit":
            damaged[at] ^= 1 << int(rng.integers(8))
        case "2 to 4 bits":
            for bit in rng.choice(8 * len(data), size=n % 3 + 2, replace=False):
                damaged[bit // 8] ^= 1 << int(bit % 8)
        case "burst":
            damaged[at : at + 2 * n] = rng.bytes(min(2 * n, len(data) - at))
        case "lost bytes":
            del damaged[at : at + n]
        case "doubled bytes":
            damaged[at:at] = damaged[at : at + n]
        case "swapped bytes":
            other = int(rng.integers(len(data)))
            damaged[at], damaged[other] = damaged[other], damaged[at]
    return kind, bytes(damaged)


def believed(wire: Wire, mutations: int, rng: np.random.Generator) -> dict[str, dict[str, int]]:
    """By kind of damage: frames damaged so, and how many of them were believed and said something else."""
    frames = [wire.frame(rng) for _ in range(256)]
    counts = {kind: {"tried": 0, "believed": 0} for kind in _DAMAGES}
    for number in range(mutations):
        data, said = frames[number % len(frames)]
        kind, damaged = mutated(data, rng)
        if damaged == data:
            continue
        counts[kind]["tried"] += 1
        counts[kind]["believed"] += any(not _agrees(heard, said) for heard in wire.hear(damaged))
    return counts


def _agrees(heard: Any, said: Any) -> bool:
    """True when nothing of what was heard differs from what was said; -1 says that it was known to be damaged."""
    if heard == said:
        return True
    if isinstance(said, tuple) and len(said) == 2 and isinstance(said[1], tuple):
        return bool(heard[0] == said[0] and all(a in (b, -1) for a, b in zip(heard[1], said[1], strict=True)))
    return False


def main() -> None:
    """Print the figures as JSON, a line a protocol."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.wires")
    parser.add_argument("--mutations", type=int, default=100_000, help="damaged frames of each protocol")
    parser.add_argument("--bytes", type=int, default=BYTES_A_RATE, help="bytes sent at each bit error rate")
    parser.add_argument("--wire", choices=WIRES, help="one protocol only")
    given = parser.parse_args()
    for name, wire in WIRES.items():
        if given.wire in (None, name):
            rng = np.random.default_rng(2026)
            rates = {f"{rate:g}": kept_at(wire, rate, given.bytes, rng) for rate in RATES}
            print(
                json.dumps({"wire": name, "kept": rates, "damaged": believed(wire, given.mutations, rng)}), flush=True
            )


if __name__ == "__main__":
    main()
