"""COBS frames with a CRC-32, a zero before and after each; knows nothing of what the frames say.

On the wire: 00, COBS(body, CRC-32 of body, little endian), 00. Both zeros belong to the frame. A damaged byte costs
one frame: even where a closing zero is hit, the next frame's opening zero ends the wreck.
"""

import zlib
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

from cobs import cobs

MAX_FRAME_BYTES = 512
"""Longest frame on the wire, both zeros counted."""
MAX_BODY_BYTES = 503
"""Longest body: 503 + 4 (CRC) + 2 (COBS) + 2 (zeros) = 511 bytes on the wire."""
MIN_BODY_BYTES = 1
_CRC_BYTES = 4
_CRC_RESIDUE = 0x2144DF1C  # of whatever ends in its own CRC-32, little endian
_MAX_CODED_BYTES = MAX_FRAME_BYTES - 2


class DamageReason(StrEnum):
    """Why bytes were not accepted."""

    BAD_CRC = "bad_crc"
    BAD_COBS = "bad_cobs"
    TOO_LONG = "too_long"
    TOO_SHORT = "too_short"
    UNKNOWN_TYPE = "unknown_type"
    BAD_LAYOUT = "bad_layout"
    DEBRIS = "debris"  # bytes outside frames: no opening zero of their own, and they do not check
    CUT_OFF = "cut_off"  # the link went away in the middle of a frame
    BAD_SUM = "bad_sum"  # a weaker check than a CRC-32 does not agree: other scanners' protocols


@dataclass(frozen=True, slots=True)
class Damage:
    """Bytes that were not accepted, zeros included, with the reason."""

    reason: DamageReason
    n_bytes: int


class Body(NamedTuple):
    """An intact frame's content without its CRC; `n_bytes` is what it took on the wire."""

    data: bytes
    n_bytes: int


def frame(body: bytes) -> bytes:
    """Return `body` as it goes on the wire.

    Raises
    ------
    ValueError : when the body is empty or longer than MAX_BODY_BYTES.
    """
    if not MIN_BODY_BYTES <= len(body) <= MAX_BODY_BYTES:
        raise ValueError(f"a frame's body has {MIN_BODY_BYTES} to {MAX_BODY_BYTES} bytes, not {len(body)}")
    crc = zlib.crc32(body).to_bytes(_CRC_BYTES, "little")
    return b"\0" + bytes(cobs.encode(body + crc)) + b"\0"


def most_frame_bytes(body_bytes: int) -> int:
    """Return the most bytes that a body of that length takes on the wire."""
    content = body_bytes + _CRC_BYTES
    return content + 1 + content // 254 + 2


class FrameDecoder:
    """Cuts a stream of bytes into intact bodies and damage; keeps at most one frame's bytes.

    At any time: bytes received = bytes of bodies + bytes of damage + `padding_bytes` + `pending_bytes`. Padding are
    zeros that belong to no frame, which a device may send to clear the line.
    """

    def __init__(self) -> None:
        self._coded = bytearray()
        self._skipped_bytes = 0  # of a frame that has grown too long; its bytes are counted, not kept
        self._opened = False  # the frame under way has an opening zero of its own
        self.padding_bytes = 0

    @property
    def pending_bytes(self) -> int:
        """Bytes received of which nothing can be said yet."""
        return int(self._opened) + len(self._coded) + self._skipped_bytes

    def receive(self, data: bytes) -> list[Body | Damage]:
        """Take the next bytes; return what they complete, in the order of the wire."""
        found: list[Body | Damage] = []
        *ended, rest = bytes(data).split(b"\0")
        for piece in ended:
            if self._coded or self._skipped_bytes:  # began in bytes received earlier
                self._keep(piece)
                found.append(self._close(bytes(self._coded), self.pending_bytes + 1))
            elif piece:
                found.append(self._close(piece, self._opened + len(piece) + 1))
            else:
                self.padding_bytes += self._opened
                self._opened = True
        self._keep(rest)
        return found

    def reset(self) -> list[Damage]:
        """Forget the frame under way, as after a lost link; return its bytes as damage."""
        n_bytes = self.pending_bytes
        self._coded.clear()
        self._skipped_bytes = 0
        self._opened = False
        return [Damage(DamageReason.CUT_OFF, n_bytes)] if n_bytes else []

    def _keep(self, piece: bytes) -> None:
        if self._skipped_bytes or len(self._coded) + len(piece) > _MAX_CODED_BYTES:
            self._skipped_bytes += len(self._coded) + len(piece)
            self._coded.clear()
        else:
            self._coded += piece

    def _close(self, coded: bytes, n_bytes: int) -> Body | Damage:
        """End the frame of these bytes at the zero that has just been read; both zeros count in `n_bytes`."""
        verdict = DamageReason.TOO_LONG if self._skipped_bytes or len(coded) > _MAX_CODED_BYTES else _open(coded)
        opened = self._opened
        self._coded.clear()
        self._skipped_bytes = 0
        self._opened = False
        if isinstance(verdict, bytes):
            return Body(verdict, n_bytes)
        return Damage(verdict if opened else DamageReason.DEBRIS, n_bytes)


def _open(coded: bytes) -> bytes | DamageReason:
    try:
        content: bytes = cobs.decode(coded)
    except cobs.DecodeError:
        return DamageReason.BAD_COBS
    if len(content) < MIN_BODY_BYTES + _CRC_BYTES:
        return DamageReason.TOO_SHORT
    return content[:-_CRC_BYTES] if zlib.crc32(content) == _CRC_RESIDUE else DamageReason.BAD_CRC
