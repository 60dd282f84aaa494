"""The closed loop of a turntable that a client drives: a block is scanned all around, and its top is given up."""

import math

import numpy as np

from drivers.rig import Rig, Turntable
from drivers.rig_limits import AxisKind, RigLimits
from drivers.scanline import Pose
from scanner_service.rescan.passes.motion import TurningMotion
from scanner_service.rescan.passes.reach import Reach
from scanner_service.rescan.requirement import Requirement
from scanner_service.sessions.book import SessionBook
from scanner_service.sessions.closed_loop import LoopLimits
from scanner_service.sessions.pass_orders import PassStatus
from scanner_service.sessions.rig_setups import RigSetup
from scanner_service.sessions.settings import SessionSettings
from scanner_service.sessions.source_specs import PushSpec
from scanner_service.storage.record import Record
from simulators.posed_rig import PosedScanner
from simulators.shapes import box
from tests.unit.rescan.passes.posed_scans import OPTICS, SCANNER

DENSITY = 12.0
RADIUS_MM = 8.0
LOW, HIGH = (-7.0, -5.0, 0.0), (7.0, 5.0, 10.0)
FULL_TURN_MM = 2.0 * math.pi * RADIUS_MM
AXIS = np.array([0.0, 0.0, 1.0])
BESIDE = Pose(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), np.array([0.0, -6.0, 5.0]))


def turntable_setup():
    rig = Rig(stage_from_sensor=BESIDE, turntable=Turntable(AXIS, RADIUS_MM))
    limits = RigLimits(
        AxisKind.TURNTABLE, (0.0, FULL_TURN_MM), (0.0, 200.0), (0.0, 200.0), SCANNER.geometry(), (-25.0, 25.0),
        RADIUS_MM,
    )  # fmt: skip
    motion = TurningMotion(rig.part_from_sensor(0.0), AXIS, RADIUS_MM)
    return RigSetup(Reach(limits, rig), OPTICS, motion, driven_by_client=True)


def share_of_sides_dense_enough(points_mm):
    """Of squares of 2 mm on the four sides that lie 1 mm inside of all edges."""
    met = []
    for axis in (0, 1):
        other = 1 - axis
        for side in (LOW[axis], HIGH[axis]):
            on = points_mm[np.abs(points_mm[:, axis] - side) < 0.2]
            edges = [np.arange(LOW[k] + 1.0, HIGH[k] - 0.9, 2.0) for k in (other, 2)]
            count, _, _ = np.histogram2d(on[:, other], on[:, 2], edges)
            met += (count / 4.0 >= DENSITY).reshape(-1).tolist()
    return float(np.mean(met))


def test_a_turntable_is_looped_until_its_part_is_scanned_all_around(tmp_path):
    setup = turntable_setup()
    with Record.open(tmp_path / "record.sqlite") as record:
        book = SessionBook(record)
        session = book.create(
            "block", PushSpec(), SessionSettings(target=Requirement(density_per_mm2=DENSITY), max_points=400_000)
        )
        posed = PosedScanner(SCANNER, box(LOW, HIGH), np.random.default_rng(1))
        scanned = []

        def scan(motion, start_mm, end_mm, spacing_mm):
            lines = list(posed.scan(motion.part_from_sensor, start_mm, end_mm, spacing_mm))
            scanned.extend(line.points_mm[np.isfinite(line.points_mm).all(axis=1)] for line in lines)
            for reply in [session.push(line) for line in lines]:
                reply.result(120)
            session.stop()

        session.start()
        scan(setup.scanned_by, 0.0, 0.6 * FULL_TURN_MM, 1.0)
        before = share_of_sides_dense_enough(np.concatenate(scanned))
        desk = book.pass_desk(session)
        desk.describe_rig(setup)
        loop = desk.run_loop(LoopLimits(max_passes=2))
        carried = set()
        while loop.running:
            for order in desk.orders():
                if order.status is PassStatus.RUNNING and order.order_id not in carried:
                    carried.add(order.order_id)
                    one = order.planned
                    assert isinstance(one.motion, TurningMotion)
                    assert 0.0 <= one.start_mm <= FULL_TURN_MM and 0.0 <= one.end_mm <= FULL_TURN_MM
                    scan(one.motion, one.start_mm, one.end_mm, one.line_spacing_mm)
            desk._session._closing.wait(0.02)
        assert loop.why_ended == "the limit of 2 passes is met"  # what no gap betrays is looked for, too
        assert before < 0.7
        assert share_of_sides_dense_enough(np.concatenate(scanned)) > 0.97
        for order in desk.orders():
            assert order.status is PassStatus.DONE and order.reached_end
            assert order.outcome.agreement.expected > 1000 and order.outcome.agreement.share > 0.95
        lost = max(desk.plan().unreachable, key=lambda one: one.area_mm2)
        assert "cannot face it" in lost.why and lost.area_mm2 > 0.5 * (HIGH[0] - LOW[0]) * (HIGH[1] - LOW[1])
        book.close()
