"""When a loop has what it was asked for: a coverage in which listed shadows count, or no region left."""

import dataclasses

from scanner_service.rescan.judgement import Reason
from scanner_service.sessions.closed_loop import LoopLimits, _fulfilled
from scanner_service.sessions.results import judge
from simulators.parts import step
from tests.unit.rescan.passes.posed_scans import ASKED, FROM_ABOVE, SCANNER, Bench


def test_a_coverage_is_not_reached_as_long_as_shadows_are_listed_that_it_does_not_know():
    snapshot, _ = Bench(step().surface).scan(FROM_ABOVE, -1.0, 41.0, 0.25).judged()
    judged = judge(snapshot, ASKED, SCANNER.geometry())
    shadows = tuple(region for region in judged.regions if region.reason is Reason.SHADOW)
    assert sum(region.area_mm2 for region in shadows) > 100.0
    filled = dataclasses.replace(judged.coverage, gap_mm2=0.0, share=0.99)  # as after a pass about their middles
    asked = LoopLimits(coverage_share=0.97)
    listed = dataclasses.replace(judged, coverage=filled, regions=shadows)
    assert _fulfilled(listed, asked) is None
    mended = dataclasses.replace(judged, coverage=filled, regions=())
    assert _fulfilled(mended, asked) == "the observed coverage of 97.0% is reached"
    assert _fulfilled(mended, LoopLimits()) == "the requirement holds: no region is left"
    assert _fulfilled(listed, LoopLimits()) is None
