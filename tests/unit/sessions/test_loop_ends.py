"""When a loop has what it was asked for: a coverage that counts what is hidden, or no region left."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from drivers.scanline import Pose
from scanner_service.rescan.judgement import Reason
from scanner_service.rescan.passes.motion import StraightMotion
from scanner_service.rescan.passes.serving import Serving
from scanner_service.rescan.requirement import Interest
from scanner_service.sessions.closed_loop import LoopLimits, LoopState, _fulfilled, run
from scanner_service.sessions.errors import PlanOvertaken
from scanner_service.sessions.results import judge
from simulators.parts import plate, step
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


class Desk:
    """A desk at which nothing is ever carried out: what is planned is told, and the verdict never rests."""

    def __init__(self, results, passes):
        self._results, self._plan = results, SimpleNamespace(passes=passes, to_dict=dict)
        self.accepted = 0

    def judged(self):
        return self._results

    def plan(self, serving):
        return self._plan

    def accept(self, number, serving, seen):
        self.accepted += 1
        raise PlanOvertaken("another verdict came before")


def one_pass(gain_mm2):
    return SimpleNamespace(number=1, turn=None, gain_mm2=gain_mm2, duration_s=1.0, approach_s=1.0)


@pytest.fixture
def told(monkeypatch):
    """Why a loop over a sound plate ends, when passes expect so much hidden surface and a coverage is asked for."""
    monkeypatch.setattr("scanner_service.sessions.closed_loop.name_of", lambda plan: "abc")
    snapshot = Bench(plate().surface).scan(FROM_ABOVE, -1.0, 41.0, 0.2).map.snapshot()
    inside = dataclasses.replace(ASKED, interest=Interest((-15.0, 5.0, -1.0), (15.0, 35.0, 1.0)))
    results = judge(snapshot, inside, SCANNER.geometry())
    assert not results.regions and results.share > 0.99

    def why(gain_mm2, share=None, is_all=True):
        at = (
            results
            if is_all
            else dataclasses.replace(results, coverage=dataclasses.replace(results.coverage, share=0.9))
        )
        desk, loop = Desk(at, [one_pass(gain_mm2)] if gain_mm2 else []), LoopState(LoopLimits(coverage_share=share))
        run(desk, loop, lambda: None)
        return loop.why_ended, desk.accepted

    return why


def test_a_loop_goes_on_where_no_region_is_left_as_long_as_much_may_be_hidden(told):
    assert told(0.0)[0] == told(5.0)[0] == "the requirement holds: no region is left"
    why, accepted = told(200.0)
    assert accepted == 8 and "the verdict kept changing" in why  # and it does not plan for ever


def test_a_coverage_that_is_not_there_is_never_called_fulfilled(told):
    assert told(0.0, share=0.95, is_all=False)[0].startswith("nothing that the rig reaches by itself is left")
    assert told(5.0, share=0.95, is_all=False)[1] == 8
    assert told(5.0, share=0.95)[0] == "the observed coverage of 95.0% is reached"
