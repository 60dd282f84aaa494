"""What a pass that was carried out has brought: its lines, how far they went, its outcome; owns nothing."""

from dataclasses import dataclass

import numpy as np

from scanner_service.analysis.passes import PassKey
from scanner_service.rescan.passes.guidance import reaches_end
from scanner_service.rescan.passes.outcome import Outcome, reckon
from scanner_service.rescan.passes.recommendation import RecommendedPass
from scanner_service.sessions.engine import Engine
from scanner_service.sessions.results import Results
from scanner_service.sessions.rig_setups import RigSetup


@dataclass(frozen=True, slots=True)
class Brought:
    """What became of a pass; `map_passes` and `passes` are those of the map that it made, by number and by name."""

    outcome: Outcome
    map_passes: list[int]
    passes: list[PassKey]
    reached_end: bool


def brought_by(planned: RecommendedPass, before: Results, after: Results, setup: RigSetup, engine: Engine) -> Brought:
    """Compare the verdicts before and after a pass; raises SessionError when the session is closed."""
    outcome = reckon(planned, before.snapshot, before.report, after.snapshot, after.report, setup.optics)
    known, now = before.snapshot.lines.pass_number, after.snapshot.lines
    fresh: list[int] = np.setdiff1d(now.pass_number, known).tolist()
    taken = np.isin(now.pass_number, fresh) & ~now.stationary
    keys = engine.ask(lambda engine: engine.live_map.pass_keys(fresh)).result()
    return Brought(outcome, fresh, keys, reaches_end(planned, setup.optics.geometry.laser_mm, now.laser_mm[taken]))
