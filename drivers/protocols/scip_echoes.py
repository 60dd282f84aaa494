"""Several echoes a step, as newer Hokuyo lidars tell them (ND, NE, HD, HE), both halves of the wire; decides nothing.

A step is a value, or a distance and an intensity, of three characters each; a `&` goes before each further echo of the
same step. So only what was read from the beginning tells which step a character belongs to.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drivers.protocols.scip import BLOCK_CHARS, IntArray, Reply, check_character, decode_values, encode_value
from drivers.scanline import BoolArray

ECHO_STREAMS = {"ND": 3, "NE": 6}
"""Characters of one echo; NE is a distance and an intensity."""
ECHO_SINGLES = {"HD": 3, "HE": 6}
MAX_ECHOES = 3
"""More than any model tells of one step."""
NONE = -1
_FURTHER = b"&"


@dataclass(frozen=True, slots=True)
class EchoScan:
    """One scan: the raw clock, distances and intensities (n, 3), and which steps cannot be told (n,).

    `NONE` stands where a step has no such echo, and for all intensities where only distances were asked for.
    """

    timestamp: int
    distances: IntArray
    intensities: IntArray
    damaged: BoolArray
    damaged_bytes: int


def echo_characters(steps: Sequence[Sequence[tuple[int, ...]]]) -> bytes:
    """Return the characters of a scan: for each step its echoes, each (distance,) or (distance, intensity)."""
    return b"".join(
        _FURTHER.join(b"".join(encode_value(value, 3) for value in echo) for echo in echoes) for echoes in steps
    )


def echoes_of(answer: Reply, width: int, n_steps: int) -> EchoScan | None:
    """Return the scan in a reply, of `n_steps` steps with echoes of `width` characters; None when it cannot be told.

    After a block whose check fails nothing says which step a value belongs to: the rest of the scan is damaged.
    """
    if len(answer.lines) < 2 or len(answer.lines[0]) != 5 or not _is_sound(answer.lines[0]):
        return None
    characters, damaged_bytes = bytearray(), 0
    for number, line in enumerate(answer.lines[1:], start=1):
        is_full = len(line) == BLOCK_CHARS + 1
        if not _is_sound(line) or not (is_full or (number == len(answer.lines) - 1 and len(line) < BLOCK_CHARS + 1)):
            damaged_bytes = sum(len(rest) + 1 for rest in answer.lines[number:])
            break
        characters += line[:-1]
    told = _steps(bytes(characters), width, is_whole=not damaged_bytes)
    if told is None or len(told) > n_steps or (not damaged_bytes and len(told) < n_steps):
        return None
    distances = np.full((n_steps, MAX_ECHOES), NONE, dtype=np.int64)
    intensities = distances.copy()
    for step, echoes in enumerate(told):
        values = decode_values(b"".join(echoes), 3).reshape(len(echoes), width // 3)
        distances[step, : len(echoes)] = values[:, 0]
        if width > 3:
            intensities[step, : len(echoes)] = values[:, 1]
    timestamp = int(decode_values(answer.lines[0][:-1], 4)[0])
    return EchoScan(timestamp, distances, intensities, np.arange(n_steps) >= len(told), damaged_bytes)


def _steps(characters: bytes, width: int, *, is_whole: bool) -> list[list[bytes]] | None:
    """The echoes of each step; without the last step where more of it may have stood in what is not there."""
    steps: list[list[bytes]] = []
    at, continues = 0, False
    while at + width <= len(characters):
        echo = characters[at : at + width]
        if _FURTHER in echo:
            return None
        if continues:
            steps[-1].append(echo)
        else:
            steps.append([echo])
        if len(steps[-1]) > MAX_ECHOES:
            return None
        at += width
        continues = characters[at : at + 1] == _FURTHER
        at += continues
    if is_whole:
        return None if at != len(characters) or continues else steps
    return steps[:-1] if at == len(characters) or continues else steps


def _is_sound(line: bytes) -> bool:
    """True when a data line's check agrees and its characters are of the 64, or a `&`."""
    return (
        len(line) > 1
        and line[-1] == check_character(line[:-1])
        and all(0x30 <= byte <= 0x6F or byte == _FURTHER[0] for byte in line[:-1])
    )
