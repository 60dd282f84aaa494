"""Damaged files of every format, and what reading them does; run as a program it reads until it is told to stop.

python -m tests.unit.storage.fuzzed_files FOLDER COUNT SEED
"""

import json
import random
import resource
import struct
import sys
from pathlib import Path

from scanner_service.storage.formats import FormatError, open_cloud

INTERESTING = (0, 1, 0x7F, 0x80, 0xFF)


def damaged(whole, rng):
    """A file with some of its bytes flipped, set, cut out, doubled, moved, or with a large number in its header."""
    data = bytearray(whole)
    for _ in range(rng.choice((1, 1, 1, 2, 4, 16))):
        if not data:
            break
        at = rng.randrange(min(len(data), rng.choice((64, 512, len(data)))))
        kind = rng.randrange(7)
        if kind == 0:
            data[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            data[at] = rng.choice(INTERESTING)
        elif kind == 2:
            del data[at : at + rng.choice((1, 2, 4, 100, 10_000))]
        elif kind == 3:
            data[at:at] = data[at : at + rng.choice((1, 4, 64))]
        elif kind == 4:
            del data[at:]
        elif kind == 5:
            number = rng.choice((2**31, 2**32 - 1, 2**40, 2**63 - 1, 10**9))
            data[at : at + 8] = struct.pack("<Q", number)
        else:
            other = rng.randrange(len(data))
            data[at : at + 32] = data[other : other + 32]
    return bytes(data)


def _crc32c(data):
    """CRC-32C (Castagnoli), bit-reflected polynomial 0x82F63B78."""
    crc = 0xFFFFFFFF
    for byte in data:
        crc = TABLE[(crc ^ byte) & 0xFF] ^ (crc >> 8)
    return crc ^ 0xFFFFFFFF


def _table():
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = (crc >> 1) ^ (0x82F63B78 if crc & 1 else 0)
        yield crc


TABLE = list(_table())


def sealed(data):
    """The bytes with the checksum of each page of an E57 file made right, so that damage gets past it."""
    pages = [data[start : start + 1020] for start in range(0, len(data) - 1023, 1024)]
    return b"".join(page + struct.pack(">I", _crc32c(page)) for page in pages)


def peak_mb():
    """The most memory that this process has taken so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def read_all(folder, count, rng):
    """Read so many damaged files; how they ended, what should not be, and what one of them took at most."""
    sources = sorted(path for path in folder.iterdir() if path.name.startswith("whole."))
    ends, faults, largest_mb = {}, [], 0.0
    for number in range(count):
        source = sources[number % len(sources)]
        path = folder / f"damaged{source.suffix}"
        data = damaged(source.read_bytes(), rng)
        path.write_bytes(sealed(data) if source.suffix == ".e57" and rng.random() < 0.8 else data)
        before_mb = peak_mb()
        try:
            cloud = open_cloud(path)
            end = "read"
            if cloud.points_declared != len(cloud.points_mm) + sum(cloud.dropped.values()):
                faults.append(f"{source.name} {number}: points are not accounted for")
        except FormatError as error:
            end = type(error).__name__
            if not str(error).startswith(path.name) or "\n" in str(error):
                faults.append(f"{source.name} {number}: {error}")
        except Exception as error:  # noqa: BLE001 - what this is looking for
            end = "FAULT"
            faults.append(f"{source.name} {number}: {type(error).__name__}: {error}")
            (folder / f"fault-{number}{source.suffix}").write_bytes(path.read_bytes())
        largest_mb = max(largest_mb, peak_mb() - before_mb)
        ends[f"{source.suffix} {end}"] = ends.get(f"{source.suffix} {end}", 0) + 1
    return ends, faults, largest_mb


if __name__ == "__main__":
    folder, count, seed = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
    assert sealed(whole := (folder / "whole.e57").read_bytes()) == whole
    for path in folder.glob("whole.*"):  # what reading takes anyway is not counted
        open_cloud(path)
    ends, faults, largest_mb = read_all(folder, count, random.Random(seed))
    print(json.dumps({"ends": ends, "faults": faults[:20], "largest_mb": largest_mb}))
