"""A map without a pass that was withdrawn is judged as the map that never had it."""

import numpy as np
import pytest

from scanner_service.rescan.coverage import observed_coverage
from scanner_service.rescan.passes.motion import StraightMotion
from tests.unit.rescan.passes.posed_scans import Bench
from tests.unit.rescan.test_unseen import ASKED, FENCED, PARTS, leaning


@pytest.mark.parametrize(
    ("part", "stays"), [(PARTS["post"], leaning(90.0, 60.0)), (FENCED, leaning(0.0))], ids=["post", "fenced"]
)
@pytest.mark.parametrize("withdrawn", ["first", "last"])
def test_a_withdrawn_pass_is_as_if_it_had_never_been(part, stays: StraightMotion, withdrawn: str) -> None:
    told = []
    for others in ((), (leaning(180.0),)):
        bench = Bench(part)
        for motion in (*others, stays) if withdrawn == "first" else (stays, *others):
            bench.posed.rng = np.random.default_rng(3 if motion is stays else 4)
            bench.scan(motion, -14.0, 38.0, 0.3 if motion is stays else 0.5)
        for _ in others:
            keys = [("SIM-POSED", 1, number) for number in range(9)]
            known = [key for key in keys if bench.map.has_pass(key)]
            bench.map.withdraw_pass(known[0] if withdrawn == "first" else known[-1])
        snapshot, report = bench.judged(ASKED)
        counted = snapshot.neighbours > 0
        judgement, areas = report.judgement, [region.area_mm2 for region in report.regions]
        share = observed_coverage(snapshot, report).share
        told.append((judgement.reason[counted], judgement.width_mm[counted], areas, share))
    for never, withdrawn_again in zip(*told, strict=True):
        np.testing.assert_array_equal(withdrawn_again, never)
