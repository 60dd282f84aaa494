"""Bytes of the native protocol, written by hand from docs/protocol.md, and the messages they must be."""

import numpy as np

from drivers.protocols.native_messages import (
    NO_RETURN,
    UNKNOWN_NM,
    Ack,
    AckStatus,
    Chunk,
    EndOfPass,
    EndReason,
    EndSeen,
    Hello,
    HelloRequest,
    Keepalive,
    Laser,
    Message,
    PositionKind,
    Start,
    Status,
    Stop,
)
from drivers.scanline import DeviceInfo, SensorGeometry


def crc32_bit_by_bit(data: bytes) -> int:
    """The CRC of docs/protocol.md, from its definition."""
    register = 0xFFFFFFFF
    for byte in data:
        register ^= byte
        for _ in range(8):
            register = register >> 1 ^ (0xEDB88320 if register & 1 else 0)
    return register ^ 0xFFFFFFFF


def cobs_block_by_block(data: bytes) -> bytes:
    """COBS from its definition: each run up to a zero, or of 254 bytes, behind its length plus one."""
    coded, run = bytearray(), bytearray()
    for byte in data:
        if byte:
            run.append(byte)
        if not byte or len(run) == 254:
            coded += bytes([len(run) + 1]) + run
            if byte:  # a full block stands for no zero
                run.clear()
                continue
            run.clear()
    return bytes(coded + bytes([len(run) + 1]) + run)


def frame_by_hand(body: bytes) -> bytes:
    """A whole frame, zeros included, without the code under test."""
    return b"\0" + cobs_block_by_block(body + crc32_bit_by_bit(body).to_bytes(4, "little")) + b"\0"


RUNNING = Status(0x12345678, True, True, EndReason.NONE, 1, 258, 6, 2, 1)
RUNNING_HEX = "78 56 34 12  03 FF  01 00 00 00  02 01 00 00  06 00 00 00  02 00 00 00  01 00 00 00"
ENDED = Status(0xFFFFFFFF, False, False, EndReason.DEAD_MAN, 3, 0xFFFFFFFF, 0, 0, 0)
ENDED_HEX = "FF FF FF FF  00 02  03 00 00 00  FF FF FF FF  00 00 00 00  00 00 00 00  00 00 00 00"
AT_BOOT = Status(0x12345678, False, False, EndReason.NONE, 0, 0, 0, 0, 0)
AT_BOOT_HEX = "78 56 34 12  00 FF  00 00 00 00  00 00 00 00  00 00 00 00  00 00 00 00  00 00 00 00"

INFO = DeviceInfo(
    device_id="SN-7",
    model="LL1",
    firmware="1.0",
    calibration_id="cal-µ",
    boot_id=0x12345678,
    points_per_line=640,
    geometry=SensorGeometry(np.array([0.0, 0.0, 150.0]), np.array([0.0, 60.0, 150.0]), (-25.0, 25.0), 0.005),
)

FROM_DEVICE: dict[str, tuple[Message, str]] = {
    "hello": (
        Hello(0, INFO, 0.0005, 0.5, AT_BOOT),
        "01  01  00 00  80 02  20 A1 07 00 00 00 00 00  F4 01"
        "00 00 00 00  00 00 00 00  60 E3 16 00   00 00 00 00  C0 27 09 00  60 E3 16 00"
        "70 2F FC FF  90 D0 03 00  88 13 00 00" + AT_BOOT_HEX + "04 53 4E 2D 37  03 4C 4C 31  03 31 2E 30"
        "06 63 61 6C 2D C2 B5",
    ),
    "chunk": (
        Chunk(
            0x12345678, 5, 1, 2, 1_500_000, PositionKind.STAGE_NM, 600_000, (0, 0, 1_500_000), 300_000, 300_000, 0, 0,
            2, 0, np.array([[-10_000, 12_345], [NO_RETURN, NO_RETURN]]),
        ),
        "02  78 56 34 12  05 00 00 00  01 00 00 00  02 00 00 00  60 E3 16 00 00 00 00 00"
        "02  C0 27 09 00 00 00 00 00  00 00 00 00  00 00 00 00  60 E3 16 00"
        "E0 93 04 00 00 00 00 00  E0 93 04 00 00 00 00 00  00 00 00 00  00 00 00 00  02 00  00 00"
        "F0 D8 FF FF  39 30 00 00  00 00 00 80  00 00 00 80",
    ),
    "chunk with counts and unknown lengths": (
        Chunk(
            1, 0xFFFFFFFF, 2, 0xFFFFFFFE, 2**64 - 1, PositionKind.ENCODER_COUNT, -1, (-1, 1, 256), UNKNOWN_NM,
            UNKNOWN_NM, 7, 8, 1280, 1279, np.array([[1, -1]]),
        ),
        "02  01 00 00 00  FF FF FF FF  02 00 00 00  FE FF FF FF  FF FF FF FF FF FF FF FF"
        "01  FF FF FF FF FF FF FF FF  FF FF FF FF  01 00 00 00  00 01 00 00"
        "00 00 00 00 00 00 00 80  00 00 00 00 00 00 00 80  07 00 00 00  08 00 00 00  00 05  FF 04"
        "01 00 00 00  FF FF FF FF",
    ),
    "ack": (Ack(513, 0x82, AckStatus.LASER_OFF, RUNNING), "03  01 02  82  04" + RUNNING_HEX),
    "end of pass": (EndOfPass(ENDED), "04" + ENDED_HEX),
}  # fmt: skip
FROM_HOST: dict[str, tuple[Message, str]] = {
    "hello request": (HelloRequest(0xFFFF), "81 FF FF"),
    "start": (
        Start(3, 300_000, -1, 20_000_000, 1_000_500),
        "82 03 00  E0 93 04 00 00 00 00 00  FF FF FF FF FF FF FF FF  00 2D 31 01 00 00 00 00  34 44 0F 00",
    ),
    "stop": (Stop(4), "83 04 00"),
    "laser off": (Laser(2, False), "84 02 00 00"),
    "laser on": (Laser(2, True), "84 02 00 01"),
    "keepalive": (Keepalive(1), "85 01 00"),
    "end seen": (EndSeen(6, 0x01020304), "86 06 00  04 03 02 01"),
}

WHOLE_FRAMES = {
    "keepalive": "00 03 85 01 05 38 31 A4 01 00",
    "laser on": "00 03 84 02 06 01 88 1A FC 37 00",
}
