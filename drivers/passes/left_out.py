"""Profiles that the rig did not make lines of, taken off the scanner's account of each pass; knows numbers only."""

import threading
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace

from drivers.scanline import Profile
from drivers.tally import OTHER_PASSES, PassTally

WirePass = tuple[int, int]
"""(boot id, pass index): a pass by the scanner's own numbers."""


class LeftOut:
    """All that one rig has left out, by pass of the scanner and by reason; any thread may enter or read."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._of_pass: dict[WirePass, Counter[tuple[str, bool]]] = {}

    def enter(self, profile: Profile, reason: str) -> None:
        """A profile became no line."""
        key = (profile.boot_id, profile.pass_index)
        with self._lock:
            self._of_pass.setdefault(key, Counter())[reason, profile.is_whole] += 1

    def counts(self) -> dict[WirePass, Counter[tuple[str, bool]]]:
        """A copy, by pass: (reason, whether the profile was whole) and how many."""
        with self._lock:
            return {key: Counter(counts) for key, counts in self._of_pass.items()}


def without(
    passes: Mapping[WirePass, PassTally], left_out: Mapping[WirePass, Counter[tuple[str, bool]]]
) -> dict[WirePass, PassTally]:
    """Return the scanner's accounts with the lines that were left out moved from the stored to the lost ones.

    The chunks stay as they are: they came over the wire. What is counted in `left_out` must have been read before
    `passes`, so that no line is taken off that was not stored yet.
    """
    found = dict(passes)
    for key, counts in left_out.items():
        booked = key if key in found else (key[0], OTHER_PASSES)
        if booked not in found:
            continue
        lines = found[booked].lines
        lost = Counter(lines.lost)
        for (reason, _), count in counts.items():
            lost[reason] += count
        whole = sum(count for (_, is_whole), count in counts.items() if is_whole)
        partial = sum(counts.values()) - whole
        found[booked] = replace(
            found[booked],
            lines=replace(
                lines, whole=lines.whole - whole, partial=lines.partial - partial, lost=dict(sorted(lost.items()))
            ),
        )
    return found
