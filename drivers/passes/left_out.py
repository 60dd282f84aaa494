"""Profiles that the rig did not make lines of, taken off the scanner's account of each pass; knows numbers only."""

import threading
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace

from drivers.scanline import Profile
from drivers.tally import MAX_PASSES, OTHER_PASSES, LineTally, PassTally

WirePass = tuple[int, int]
"""(boot id, pass index): a pass by the scanner's own numbers."""


class LeftOut:
    """All that one rig has left out, by pass of the scanner and by reason; any thread may enter or read.

    Of one boot as many passes are kept apart as the scanner's account keeps.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._kept_apart: Counter[int] = Counter()  # passes of each boot
        self._of_pass: dict[WirePass, Counter[tuple[str, bool]]] = {}

    def enter(self, profile: Profile, reason: str) -> None:
        """A profile became no line."""
        key = (profile.boot_id, profile.pass_index)
        with self._lock:
            if key not in self._of_pass and self._kept_apart[profile.boot_id] >= MAX_PASSES:
                key = (profile.boot_id, OTHER_PASSES)
            elif key not in self._of_pass:
                self._kept_apart[profile.boot_id] += 1
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
    `passes`, so that no line is taken off that was not stored yet. A pass that the scanner tells nothing of, as after
    it was entered anew, has the lines that were left out, and no others.
    """
    found = dict(passes)
    for key, counts in left_out.items():
        others = (key[0], OTHER_PASSES)
        booked = others if key not in found and others in found else key
        total = sum(counts.values())
        whole = sum(count for (_, is_whole), count in counts.items() if is_whole)
        unknown = PassTally(lines=LineTally(sent=total, whole=whole, partial=total - whole))
        told = found.get(booked, unknown)
        lines = told.lines
        lost = Counter(lines.lost)
        for (reason, _), count in counts.items():
            lost[reason] += count
        partial = total - whole
        found[booked] = replace(
            told,
            lines=replace(
                lines, whole=lines.whole - whole, partial=lines.partial - partial, lost=dict(sorted(lost.items()))
            ),
        )
    return found
