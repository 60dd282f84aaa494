"""When a loop has what it was asked for: a coverage that counts what is hidden, or no region left."""

import dataclasses

import numpy as np

from drivers.scanline import Pose
from scanner_service.rescan.judgement import Reason
from scanner_service.rescan.passes.motion import StraightMotion
from scanner_service.rescan.passes.serving import Serving
from scanner_service.rescan.requirement import Interest
from scanner_service.sessions.closed_loop import LoopLimits, _fulfilled
from scanner_service.sessions.results import judge
from simulators.parts import step
from tests.unit.rescan.passes.posed_scans import ASKED, FROM_ABOVE, SCANNER, Bench

AROUND_THE_STEP = dataclasses.replace(ASKED, interest=Interest((-15.0, 8.0, -2.0), (15.0, 32.0, 7.0)))


def at_the_wall():
    """A pass that looks at the step's wall: the sensor leans by 45° against the travel, the laser towards it."""
    turn = np.radians(45.0)
    lean = np.array([[1.0, 0.0, 0.0], [0.0, np.cos(turn), -np.sin(turn)], [0.0, np.sin(turn), np.cos(turn)]])
    middle = np.array([0.0, 20.0, 2.5])
    return StraightMotion(Pose(lean, middle - lean @ middle), lean[:, 1])


def test_a_coverage_is_reached_once_the_wall_that_a_step_hides_is_scanned():
    bench = Bench(step().surface).scan(FROM_ABOVE, -1.0, 41.0, 0.2)
    asked = LoopLimits(coverage_share=0.97)
    hidden = judge(bench.map.snapshot(), AROUND_THE_STEP, SCANNER.geometry())
    assert _fulfilled(hidden, asked) is None
    assert _fulfilled(hidden, LoopLimits()) is None
    assert _fulfilled(hidden, LoopLimits(serving=Serving(reasons=frozenset({Reason.SHADOW})))) is None
    assert "no region is left" in _fulfilled(hidden, LoopLimits(serving=Serving(reasons=frozenset({Reason.NOISY}))))
    bench.scan(at_the_wall(), 5.0, 35.0, 0.15)
    seen = judge(bench.map.snapshot(), AROUND_THE_STEP, SCANNER.geometry())
    assert _fulfilled(seen, asked) == "the observed coverage of 97.0% is reached"
