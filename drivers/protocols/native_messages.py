"""What the native serial protocol says: its messages and constants as values; knows no bytes and no manners.

`docs/protocol.md` is the specification. Numbers that count (sequences, lines, drops) are u32 and wrap.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from drivers.scanline import DeviceInfo

Int32Array = npt.NDArray[np.int32]

PROTOCOL_VERSION = 1
DEAD_MAN_S = 0.5
"""The device turns laser and motion off after this long without an intact frame from the host."""
NO_RETURN = -(2**31)
"""Stands for x or z of a point without a return."""
UNKNOWN_NM = -(2**63)
"""Stands for a length the device does not know."""
TENTH_UM_PER_MM = 10_000
NM_PER_MM = 1_000_000
PM_PER_MM = 1_000_000_000
MAX_TEXT_BYTES = 64


class Type(IntEnum):
    """First byte of a frame's body; the high bit is set in what the host sends."""

    HELLO = 0x01
    CHUNK = 0x02
    ACK = 0x03
    END_OF_PASS = 0x04
    HELLO_REQUEST = 0x81
    START = 0x82
    STOP = 0x83
    LASER = 0x84
    KEEPALIVE = 0x85
    END_SEEN = 0x86


class PositionKind(IntEnum):
    """What a chunk's position is."""

    NONE = 0
    ENCODER_COUNT = 1
    STAGE_NM = 2


class AckStatus(IntEnum):
    """What became of a command."""

    OK = 0
    UNKNOWN_COMMAND = 1
    BAD_VALUE = 2
    BUSY = 3  # START while a pass is running, or its end has not been sent
    LASER_OFF = 4  # START while the laser is off
    FAULT = 5  # an interlock or a fault of the device


class EndReason(IntEnum):
    """Why the last pass ended."""

    REACHED_END = 0
    STOPPED = 1  # by the host: STOP, or LASER off
    DEAD_MAN = 2
    FAULT = 3
    NONE = 255  # a pass is running, or there was none in this boot


@dataclass(frozen=True, slots=True)
class Status:
    """The device's state and totals at this place of its stream: everything counted here precedes this frame.

    `next_sequence` and `next_line` are the first numbers not yet used up before this frame: every chunk (line) below
    has been sent, or dropped by the device itself and counted in `dropped_chunks` (`dropped_lines`: lines of which
    every chunk was dropped). `pass_index` counts the passes of this boot from 1, 0 before the first. All u32, wrapping.
    """

    boot_id: int
    laser_on: bool
    streaming: bool
    end_reason: EndReason
    pass_index: int
    next_sequence: int
    next_line: int
    dropped_chunks: int
    dropped_lines: int


@dataclass(frozen=True, slots=True)
class Hello:
    """Who the device is. `command_id` is that of the request, 0 when sent unasked at boot.

    `encoder_mm_per_count` is 0 for a device without an encoder; `dead_man_s` its dead-man's time.
    """

    command_id: int
    info: DeviceInfo
    encoder_mm_per_count: float
    dead_man_s: float
    status: Status


@dataclass(frozen=True, slots=True)
class OtherVersion:
    """A HELLO in another version of the protocol; all that can be read of it."""

    version: int


@dataclass(frozen=True, slots=True)
class Chunk:
    """A piece of one profile with the whole header of its line, so that it can be placed alone.

    What was read in one go may hold several that follow each other in one line: they come as one, with the first one's
    number and place, all their points, and `sizes`, the number of points of each; empty for a single chunk.
    `points` (k, 2) int32 are x, z in 0.1 um, NO_RETURN for both where there was none. `laser` is x, y, z in 0.1 um,
    `position` is counts or nanometres as `position_kind` says, `line_spacing_nm` and `step_nm` may be UNKNOWN_NM.
    `dropped_chunks` (`dropped_lines`) counts what the device dropped itself among the numbers below this one's.
    """

    boot_id: int
    sequence: int
    pass_index: int
    line_index: int
    device_time_us: int
    position_kind: PositionKind
    position: int
    laser: tuple[int, int, int]
    line_spacing_nm: int
    step_nm: int
    dropped_chunks: int
    dropped_lines: int
    points_in_line: int
    first_point: int
    points: Int32Array
    sizes: tuple[int, ...] = ()

    @property
    def n_chunks(self) -> int:
        """How many chunks of the wire these are."""
        return len(self.sizes) or 1

    def apart(self) -> Iterator["Chunk"]:
        """The single chunks, as they were on the wire."""
        start = 0
        for number, size in enumerate(self.sizes or (len(self.points),)):
            yield replace(
                self,
                sequence=(self.sequence + number) % 2**32,
                first_point=self.first_point + start,
                points=self.points[start : start + size],
                sizes=(),
            )
            start += size


@dataclass(frozen=True, slots=True)
class Ack:
    """The device's answer to a command."""

    command_id: int
    command: int
    result: AckStatus
    status: Status


@dataclass(frozen=True, slots=True)
class EndOfPass:
    """Sent behind the last chunk of a pass, and again until END_SEEN; `status.end_reason` says why it ended."""

    status: Status


@dataclass(frozen=True, slots=True)
class HelloRequest:
    """Asks for a Hello."""

    command_id: int


@dataclass(frozen=True, slots=True)
class Start:
    """Starts a pass: lines every `line_spacing_nm` from `start_nm` to `end_nm` of the device's stage."""

    command_id: int
    line_spacing_nm: int
    start_nm: int
    end_nm: int
    line_rate_mhz: int
    """Lines per second, times 1000 (millihertz)."""


@dataclass(frozen=True, slots=True)
class Stop:
    """Ends the pass now; the laser goes off."""

    command_id: int


@dataclass(frozen=True, slots=True)
class Laser:
    """Switches the laser; off during a pass also ends the pass."""

    command_id: int
    on: bool


@dataclass(frozen=True, slots=True)
class Keepalive:
    """Holds the dead-man off."""

    command_id: int


@dataclass(frozen=True, slots=True)
class EndSeen:
    """Ends the repetition of END_OF_PASS for this pass; the only command without an acknowledgement."""

    command_id: int
    pass_index: int


FromDevice: TypeAlias = Hello | OtherVersion | Chunk | Ack | EndOfPass
FromHost: TypeAlias = HelloRequest | Start | Stop | Laser | Keepalive | EndSeen
Message: TypeAlias = FromDevice | FromHost
