"""Recordings of a log scanner (JoeScan LogScanner, `.raw`): several heads and cameras, each with an encoder count.

Little-endian records, the whole file perhaps gzip-compressed. All heads measure in one common plane, in hundredths of
an inch; the file tells neither how far an encoder count goes nor where a laser stands.
"""

import math
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from drivers.rig import Rig
from drivers.scanline import Float64Array, Profile, Scanline
from scanner_service.storage.formats.errors import (
    ContentDamaged,
    FileEmpty,
    FileTooLarge,
    FileTruncated,
    LaserUnknown,
    OptionRefused,
    SpacingUnknown,
)
from scanner_service.storage.formats.recording import ReadOptions, Recording
from scanner_service.storage.formats.spacing import median_point_spacing_mm

MM_PER_HUNDREDTH = 0.254
_MAGIC_INTEGER, _MAGIC_FLOAT = 0x010203, 0x010204
_MAGICS = {struct.pack("<i", magic) for magic in (_MAGIC_INTEGER, _MAGIC_FLOAT)}
_GZIP = b"\x1f\x8b"
_HEAD = struct.Struct("<iIHi")
_TAIL = struct.Struct("<IQIIii")
_INTEGER_POINT = np.dtype([("x", "<i2"), ("y", "<i2"), ("brightness", "u1")])
_FLOAT_POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("brightness", "<f4")])
_MOST_ENCODERS = 64
_MOST_POINTS = 100_000
_LASER_BEYOND_MM = 1000.0
_PASS = 1


@dataclass(frozen=True, slots=True)
class _Record:
    """One profile as the file has it: `x` and `y` (n,) in hundredths of an inch."""

    encoder: int
    time_ns: int
    head: int
    camera: int
    x: Float64Array
    y: Float64Array


def is_joescan(data: bytes) -> bool:
    """True for the content of such a recording, compressed or not."""
    if data[:2] == _GZIP:
        try:
            return zlib.decompressobj(wbits=31).decompress(data[:4096], 4) in _MAGICS
        except zlib.error:
            return False
    return data[:4] in _MAGICS


def read_joescan(data: bytes, name: str, options: ReadOptions) -> Recording:
    """Read a recording as scanlines, in the order in which they were taken.

    The line spacing must be given: it is that between profiles while the stage moves, and with it the median encoder
    step of a moving stage makes the scale. Each camera of each head is a device of its own; standing, jittering and
    reversed steps stay as they are, measured.

    Raises
    ------
    SpacingUnknown : no line spacing was given.
    LaserUnknown : no laser position was given and there is only one head, whose side nothing tells.
    FileTruncated, ContentDamaged, FileTooLarge, FileEmpty, OptionRefused : what is wrong with the file or the options.
    """
    if options.units not in (None, "auto", "inch"):
        raise OptionRefused(f"{name} is in hundredths of an inch; leave out units")
    spacing_mm = options.line_spacing_mm
    if spacing_mm is None:
        raise SpacingUnknown(
            f"{name} does not tell how far its encoder counts go: give the line spacing while the stage moves "
            "(--line-spacing, in mm)"
        )
    records = list(_records(_expanded(data, name, options.max_bytes), name))
    if not any(len(record.x) for record in records):
        raise FileEmpty(f"{name} holds no point: there is nothing to replay")
    moving = _moving_step(records)
    if moving is None:
        raise SpacingUnknown(f"{name}: its encoder never moves, so that no line has a place")
    mm_per_count = spacing_mm / moving
    lasers, laser_note = _lasers(records, options, name)
    lines = tuple(_scanlines(records, mm_per_count, spacing_mm, lasers, name))
    points = sum(int(np.isfinite(line.points_mm[:, 0]).sum()) for line in lines)
    declared = sum(len(record.x) for record in records)
    heads = len({record.head for record in records})
    cameras = len({(record.head, record.camera) for record in records})
    return Recording(
        name,
        "joescan",
        lines,
        points,
        declared,
        spacing_mm,
        median_point_spacing_mm(line.points_mm for line in lines),
        {"not_finite": declared - points} if declared > points else {},
        (
            f"{len(lines):,} profiles of {heads} heads with {cameras} cameras; each camera is a device, and its clock "
            "begins at its first profile",
            f"one encoder count is taken as {mm_per_count:.6g} mm: the median step of a moving stage, {moving:g} "
            f"counts, is the line spacing of {spacing_mm:g} mm",
            laser_note,
        ),
    )


def _expanded(data: bytes, name: str, max_bytes: int) -> bytes:
    if data[:2] != _GZIP:
        return data
    opened = zlib.decompressobj(wbits=31)
    try:
        content = opened.decompress(data, max_bytes + 1)
    except zlib.error as error:
        raise ContentDamaged(f"{name} is damaged: {error}; copy it again") from None
    if len(content) > max_bytes:
        raise FileTooLarge(f"{name} expands to more than {max_bytes} bytes, which is the most that is read")
    if not opened.eof:
        raise FileTruncated(f"{name} ends in the middle of its compressed content; copy it again")
    return content


def _records(data: bytes, name: str) -> Iterator[_Record]:
    at, number = 0, 0
    while at < len(data):
        record, at = _record(data, at, number, name)
        number += 1
        yield record


def _record(data: bytes, at: int, number: int, name: str) -> tuple[_Record, int]:
    """Read the record at `at`; return it and where the next one begins."""

    def need(n_bytes: int) -> None:
        if len(data) - at < n_bytes:
            raise FileTruncated(f"{name} ends in the middle of profile {number}; copy it again")

    need(4)
    (magic,) = struct.unpack_from("<i", data, at)
    if magic not in (_MAGIC_INTEGER, _MAGIC_FLOAT):
        raise ContentDamaged(
            f"{name}: profile {number} (byte {at}) begins with no mark of a profile; the file is damaged"
        )
    at += 4
    unit_mm = MM_PER_HUNDREDTH
    if magic == _MAGIC_FLOAT:
        need(1)
        if data[at] not in (0, 1):
            raise ContentDamaged(f"{name}: profile {number} has the unknown unit {data[at]}")
        unit_mm = 25.4 if data[at] == 0 else 1.0
        at += 1
    need(_HEAD.size)
    _, _, _, n_encoders = _HEAD.unpack_from(data, at)
    at += _HEAD.size
    if not 1 <= n_encoders <= _MOST_ENCODERS:
        raise ContentDamaged(f"{name}: profile {number} claims {n_encoders} encoders; at least one is needed")
    need(8 * n_encoders + _TAIL.size)
    (encoder,) = struct.unpack_from("<q", data, at)
    at += 8 * n_encoders
    _, time_ns, head, camera, _, n_points = _TAIL.unpack_from(data, at)
    at += _TAIL.size
    kind = _INTEGER_POINT if magic == _MAGIC_INTEGER else _FLOAT_POINT
    if not 0 <= n_points <= _MOST_POINTS:
        raise ContentDamaged(f"{name}: profile {number} claims {n_points} points; at most {_MOST_POINTS} are read")
    need(n_points * kind.itemsize)
    points = np.frombuffer(data, kind, n_points, at)
    at += n_points * kind.itemsize
    x, y = (points[axis].astype(np.float64) * unit_mm for axis in ("x", "y"))
    return _Record(encoder, time_ns, head, camera, x, y), at


def _moving_step(records: list[_Record]) -> float | None:
    """Median |encoder step| of a camera from profile to profile, of the steps above half of the largest usual one."""
    last: dict[tuple[int, int], int] = {}
    steps: list[int] = []
    for record in records:
        key = (record.head, record.camera)
        if key in last:
            steps.append(abs(record.encoder - last[key]))
        last[key] = record.encoder
    usual = np.array([step for step in steps if step])
    if not usual.size:
        return None
    return float(np.median(usual[usual > 0.5 * np.percentile(usual, 90)]))


def _lasers(records: list[_Record], options: ReadOptions, name: str) -> tuple[dict[int, Float64Array], str]:
    """Where each head's laser stands in the common plane, (x, z)."""
    heads = sorted({record.head for record in records})
    if options.laser_mm is not None:
        x_mm, _, z_mm = options.laser_mm
        if math.isnan(x_mm) or math.isnan(z_mm):
            raise OptionRefused("of the laser position only y, along the travel, may be left open")
        return {head: np.array([x_mm, z_mm]) for head in heads}, "every laser stands where it was said to"
    middles: dict[int, Float64Array] = {}
    for head in heads:
        seen = [np.stack([r.x, r.y], axis=1) for r in records if r.head == head and len(r.x)]
        if seen:
            points = np.concatenate(seen)
            middles[head] = np.median(points[np.isfinite(points).all(axis=1)], axis=0)
    centre = np.mean(list(middles.values()), axis=0)
    if len(middles) < 2 or any(not float(np.linalg.norm(middle - centre)) > 1.0 for middle in middles.values()):
        raise LaserUnknown(f"{name} does not tell where its laser stands: give its position x,-,z in mm (--laser)")
    lasers = {}
    for head in heads:
        outwards = middles.get(head, centre + 1.0) - centre
        lasers[head] = middles.get(head, centre) + _LASER_BEYOND_MM * outwards / np.linalg.norm(outwards)
    return lasers, (
        f"where the lasers stand is not told: each is taken {_LASER_BEYOND_MM:g} mm beyond the middle of what its head "
        "sees, away from the middle of all heads; that tells the sides of the surface, and no distances"
    )


def _scanlines(
    records: list[_Record], mm_per_count: float, spacing_mm: float, lasers: dict[int, Float64Array], name: str
) -> Iterator[Scanline]:
    rig = Rig()
    first_count = records[0].encoder
    stem = name.split(".", 1)[0]
    last_mm: dict[tuple[int, int], float] = {}
    count: dict[tuple[int, int], int] = {}
    first_ns: dict[tuple[int, int], int] = {}
    for record in records:
        key = (record.head, record.camera)
        position_mm = (record.encoder - first_count) * mm_per_count
        line_index = count.get(key, 0)
        count[key] = line_index + 1
        laser_x, laser_z = lasers[record.head]
        finite = np.isfinite(record.x) & np.isfinite(record.y)
        profile = Profile(
            device_id=f"{stem}-head{record.head}-camera{record.camera}",
            boot_id=0,
            pass_index=_PASS,
            line_index=line_index,
            device_time_s=(record.time_ns - first_ns.setdefault(key, record.time_ns)) * 1e-9,
            arrival_s=math.nan,
            x_mm=np.where(finite, record.x, math.nan),
            z_mm=np.where(finite, record.y, math.nan),
            missing=np.zeros(len(record.x), dtype=np.bool_),
            laser_mm=np.array([laser_x, 0.0, laser_z]),
            position_mm=position_mm,
            line_spacing_mm=spacing_mm,
            step_mm=position_mm - last_mm.get(key, math.nan),
        )
        last_mm[key] = position_mm
        yield rig.place(profile)
