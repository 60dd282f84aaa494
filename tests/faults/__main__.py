"""The release draws of the fault harness: `python -m tests.faults kills --kills 2000 --lines 1000000`, and its kin.

The tests of every change draw smaller numbers from the same generators. One line of JSON at the end; exit status 1 when
anything was lost, doubled, torn or corrupt.
"""

import argparse
import json
import logging
import os
import sys
import time
from typing import Any

from tests.faults import sqlite_disk
from tests.faults.bit_flips import flip_bits
from tests.faults.kills import kill_services
from tests.faults.power_cuts import cut_power
from tests.faults.storage_faults import every_fault, inject, sample

_BAD = ("lost", "doubled", "torn", "corrupt", "died", "silent")


def main() -> int:
    """Run one of the harnesses as the command line says."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults", description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    what = parser.add_subparsers(dest="what", required=True)
    kills = what.add_parser("kills", help="kill -9 of the whole service during a scan")
    kills.add_argument("--kills", type=int, default=2000)
    kills.add_argument("--lines", type=int, default=1_000_000, help="acknowledged lines to reach")
    cuts = what.add_parser("cuts", help="power cuts")
    cuts.add_argument("--cuts", type=int, default=20_000)
    faults = what.add_parser("faults", help="a failing disk, at every call")
    faults.add_argument("--sample", type=int, help="so many of all faults only")
    flips = what.add_parser("flips", help="flipped bits of the file")
    flips.add_argument("--flips", type=int, default=10_000)
    given = parser.parse_args()
    logging.disable(logging.CRITICAL)  # thousands of expected faults, each told by the record
    if given.what in ("cuts", "faults") and sqlite_disk.available():
        parser.error(sqlite_disk.available())
    begun_s, said_s = time.monotonic(), [0.0]

    def progress(account: Any) -> None:
        now_s = time.monotonic()
        if now_s - said_s[0] > 10:
            said_s[0] = now_s
            print(f"{now_s - begun_s:7.0f} s  {account}", file=sys.stderr, flush=True)

    account: Any
    match given.what:
        case "kills":
            account = kill_services(given.kills, given.lines, given.seed, progress)
        case "cuts":
            account = cut_power(given.cuts, given.seed, on_progress=progress)
        case "faults":
            chosen = every_fault() if given.sample is None else sample(given.sample, given.seed)
            account = inject(chosen, progress)
        case "flips":
            account = flip_bits(given.flips, given.seed, progress)
    told = dict(vars(account))
    took_s = round(time.monotonic() - begun_s, 1)
    print(json.dumps({"harness": given.what, "seed": given.seed, "took_s": took_s, "load": os.getloadavg()[0], **told}))
    return int(any(told.get(kind, 0) for kind in _BAD))


if __name__ == "__main__":
    raise SystemExit(main())
