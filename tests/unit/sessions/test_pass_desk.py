"""Recommended passes in a session: accepted, scanned by hand, reckoned up, and refused where they make no sense."""

import dataclasses
import threading
import time

import numpy as np
import pytest

from drivers.rig_limits import AxisKind
from scanner_service.rescan.judgement import Reason
from scanner_service.rescan.passes.errors import RigUnlimited
from scanner_service.rescan.passes.outcome import Outcome
from scanner_service.rescan.passes.planner import plan_passes
from scanner_service.rescan.passes.promises import NO_EXPERIENCE
from scanner_service.rescan.passes.serving import Serving
from scanner_service.rescan.passes.tried import TRIES
from scanner_service.rescan.reference import ReferenceSurface
from scanner_service.rescan.region import RegionStatus
from scanner_service.rescan.requirement import Requirement
from scanner_service.sessions import pass_planning
from scanner_service.sessions.book import SessionBook
from scanner_service.sessions.closed_loop import LoopLimits
from scanner_service.sessions.errors import PartNotTurned, PassUnknown, PlanOvertaken, SessionBusy
from scanner_service.sessions.pass_orders import OrderBook, PassStatus
from scanner_service.sessions.pass_planning import name_of
from scanner_service.sessions.references import Nominal
from scanner_service.sessions.rig_setups import RigSetup
from scanner_service.sessions.settings import SessionSettings
from scanner_service.sessions.source_specs import PushSpec
from scanner_service.storage.record import Record
from simulators.posed_rig import PosedScanner
from tests.unit.rescan.passes.posed_scans import (
    ALONG_SMALL_STEP,
    DENSITY,
    FROM_ABOVE,
    OPTICS,
    SCANNER,
    SMALL_STEP,
    free_reach,
    linear_reach,
)
from tests.unit.rescan.passes.test_serving import box_corners


@pytest.fixture
def book(tmp_path):
    with Record.open(tmp_path / "record.sqlite") as record:
        book = SessionBook(record)
        yield book
        book.close()


@pytest.fixture
def scanned(book):
    """A step scanned too coarsely by a client, and the scanner in its hand."""
    session = book.create(
        "step", PushSpec(), SessionSettings(target=Requirement(density_per_mm2=DENSITY), max_points=400_000)
    )
    posed = PosedScanner(SCANNER, SMALL_STEP, np.random.default_rng(1))
    session.start()
    push(session, posed, FROM_ABOVE, *ALONG_SMALL_STEP, 0.6)
    session.stop()
    return session, posed


def push(session, posed, motion, start_mm, end_mm, spacing_mm):
    replies = [session.push(line) for line in posed.scan(motion.part_from_sensor, start_mm, end_mm, spacing_mm)]
    for reply in replies:
        reply.result(300)


def kinds(book, session):
    return [event.kind for event in book.record.events(session.row.session_id)]


def told(book, session, kind):
    """How often the record tells of a kind of event; its writer is given time."""
    deadline_s = time.monotonic() + 300.0
    while kind not in (found := kinds(book, session)) and time.monotonic() < deadline_s:
        time.sleep(0.05)
    return found.count(kind)


def test_a_pass_is_accepted_scanned_by_hand_and_reckoned_up(book, scanned, monkeypatch):
    session, posed = scanned
    desk = book.pass_desk(session)
    desk.describe_rig(RigSetup(free_reach(30.0), OPTICS))
    plan = desk.plan()
    learn, half_known = desk._learn, []

    def planned_before(order):
        half_known.append(desk.plan())
        learn(order)

    monkeypatch.setattr(desk, "_learn", planned_before)
    event, held = session.event, {}

    def owned(kind, details):
        held[kind] = desk._lock._is_owned()
        event(kind, details)

    monkeypatch.setattr(session, "event", owned)
    order = desk.accept(plan.passes[0].number)
    assert order.status is PassStatus.ACCEPTED
    desk.carry_out(order.order_id)
    assert session.state == "scanning"
    one = order.planned
    push(session, posed, one.motion, one.start_mm, one.end_mm, one.line_spacing_mm)
    guidance = desk.guidance(order.order_id)
    assert guidance.aside_mm < 0.5 and guidance.along_mm < 1.0
    session.stop()
    desk.wait_for(order)
    assert order.status is PassStatus.DONE
    assert held["pass_outcome"]  # no decision comes between what is and what the record tells
    assert order.reached_end and order.teaches
    assert order.outcome.promised_mm2 == pytest.approx(one.promised.mm2)
    assert order.outcome.expected_mm2 == pytest.approx(one.explores.mm2)
    assert order.outcome.reached_mm2 > 0.7 * order.outcome.promised_mm2
    assert desk.plan().version > plan.version
    assert desk.plan().needed_mm2 < plan.needed_mm2
    assert name_of(desk.plan()) != name_of(half_known[0])  # where the sensor stands was not known then
    assert told(book, session, "pass_outcome") == 1
    assert [kind for kind in kinds(book, session) if kind.startswith("pass_")] == [
        "pass_accepted",
        "pass_started",
        "pass_outcome",
    ]


def test_orders_are_answered_while_a_plan_is_made(book, scanned, monkeypatch):
    session, _ = scanned
    desk = book.pass_desk(session)
    desk.describe_rig(RigSetup(free_reach(30.0), OPTICS))
    accepted = desk.accept(1)
    begun, answered, waited = threading.Event(), threading.Event(), []

    def slow_plan(*arguments):
        begun.set()
        waited.append(answered.wait(120))
        return plan_passes(*arguments)

    monkeypatch.setattr(pass_planning, "plan_passes", slow_plan)
    desk.describe_rig(RigSetup(free_reach(30.0), OPTICS))  # plans anew
    plans = []
    planner = threading.Thread(target=lambda: plans.append(desk.plan()))
    planner.start()
    assert begun.wait(120)
    assert desk.orders() == [accepted] and desk.order(1) is accepted
    assert desk.cancel(1).status is PassStatus.CANCELLED
    answered.set()
    planner.join(300)
    assert waited == [True]  # the plan was still being made when all of these were answered
    assert plans[0].passes


def test_a_pass_is_accepted_of_the_plan_that_was_seen_or_not_at_all(book, scanned):
    session, _ = scanned
    desk = book.pass_desk(session)
    desk.describe_rig(RigSetup(free_reach(30.0), OPTICS))
    seen = desk.plan()
    assert desk.accept(2, seen=name_of(seen)).planned.to_dict() == seen.passes[1].to_dict()
    desk.describe_rig(RigSetup(free_reach(30.0), OPTICS))  # planned anew, with the same result: what was seen holds
    assert desk.accept(2, seen=name_of(seen)).planned.to_dict() == seen.passes[1].to_dict()
    desk.describe_rig(RigSetup(linear_reach(), OPTICS))
    with pytest.raises(PlanOvertaken, match=r"is not in force.*list the passes again"):
        desk.accept(1, seen=name_of(seen))
    with pytest.raises(PlanOvertaken):
        desk.accept(1, Serving(reasons=frozenset({Reason.SPARSE})), name_of(seen))
    assert len(desk.orders()) == 2


def test_whoever_accepts_while_rigs_change_gets_what_was_seen_or_a_refusal(book, scanned):
    session, _ = scanned
    desk = book.pass_desk(session)
    setups = [RigSetup(reach, OPTICS) for reach in (free_reach(30.0), linear_reach())]
    seen = []
    for setup in setups:
        desk.describe_rig(setup)
        seen.append(desk.plan())
    assert seen[0].passes[0].to_dict() != seen[1].passes[0].to_dict()
    taken, refused, others = [], [], []

    def accept(plan):
        for _ in range(2):
            try:
                taken.append((plan, desk.accept(1, seen=name_of(plan))))
            except PlanOvertaken:
                refused.append(plan)
            except Exception as error:  # noqa: BLE001 - told by the thread that waits
                others.append(error)
            desk.describe_rig(setups[len(taken) % 2])

    threads = [threading.Thread(target=accept, args=(seen[k % 2],)) for k in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not others and len(taken) + len(refused) == 6
    for plan, order in taken:
        assert order.planned.to_dict() == plan.passes[0].to_dict()
    assert [order.order_id for order in desk.orders()] == list(range(1, len(taken) + 1))
    for setup, plan in zip(setups, seen, strict=True):
        desk.describe_rig(setup)
        assert desk.accept(1, seen=name_of(plan)).planned.to_dict() == plan.passes[0].to_dict()


def test_orders_are_cancelled_at_once_while_another_is_being_set_off(book, scanned, monkeypatch):
    session, _ = scanned
    desk = book.pass_desk(session)
    desk.describe_rig(RigSetup(free_reach(30.0), OPTICS))
    first, second, third = (desk.accept(1) for _ in range(3))
    begun, may_go, waited = threading.Event(), threading.Event(), []
    fresh_results = session.fresh_results

    def slow_verdict():
        if threading.current_thread() is setter:
            begun.set()
            waited.append(may_go.wait(300))
        return fresh_results()

    monkeypatch.setattr(session, "fresh_results", slow_verdict)
    setter = threading.Thread(target=desk.carry_out, args=(first.order_id,))
    setter.start()
    assert begun.wait(300)
    assert desk.cancel(second.order_id).status is PassStatus.CANCELLED
    with pytest.raises(SessionBusy, match="just being set off"):
        desk.cancel(first.order_id)
    with pytest.raises(SessionBusy, match="being set off"):
        desk.carry_out(first.order_id)
    with pytest.raises(SessionBusy, match="pass order 1 is being carried out"):
        desk.carry_out(third.order_id)
    assert (first.status, third.status) == (PassStatus.ACCEPTED, PassStatus.CANCELLED)
    may_go.set()
    setter.join(300)
    assert waited == [True]  # all of these were answered while the first was being set off
    assert first.status is PassStatus.RUNNING
    session.stop()
    desk.wait_for(first)


def test_a_plan_that_is_overtaken_by_another_rig_is_made_again(book, scanned, monkeypatch):
    session, _ = scanned
    desk = book.pass_desk(session)
    desk.describe_rig(RigSetup(free_reach(30.0), OPTICS))
    reaches = []

    def overtaken(snapshot, report, reach, *others):
        reaches.append(reach)
        if len(reaches) == 1:
            desk.describe_rig(RigSetup(linear_reach(), OPTICS))
        return plan_passes(snapshot, report, reach, *others)

    monkeypatch.setattr(pass_planning, "plan_passes", overtaken)
    plan = desk.plan()
    assert [reach.limits.axis for reach in reaches] == [AxisKind.FREE_POSE, AxisKind.LINEAR]
    assert all(np.allclose(one.direction, FROM_ABOVE.travel) for one in plan.passes)


def test_a_plan_is_made_again_for_another_nominal_part(book, scanned):
    session, _ = scanned
    desk = book.pass_desk(session)
    desk.describe_rig(RigSetup(free_reach(30.0), OPTICS))
    points_mm = session.results().snapshot.points_mm
    low, high = points_mm.min(axis=0), points_mm.max(axis=0)
    needed_mm2 = []
    for way_mm in (0.0, 20.0):  # the second part goes on where nobody scanned
        part = ReferenceSurface.of(box_corners(low - np.array([0.0, way_mm, 5.0]), high))
        session.terms.measure_against(None, Nominal(part))
        plan = desk.plan()
        assert desk.plan() is plan
        needed_mm2.append(plan.needed_mm2)
    assert needed_mm2[1] > needed_mm2[0] + 100.0


def test_a_session_between_two_passes_is_not_closed_to_make_room(book, scanned, monkeypatch):
    session, posed = scanned
    desk = book.pass_desk(session)
    desk.describe_rig(RigSetup(free_reach(30.0), OPTICS))
    order = desk.accept(1)
    desk.carry_out(order.order_id)
    push(session, posed, FROM_ABOVE, 9.0, 12.0, 1.0)
    begun, may_judge = threading.Event(), threading.Event()
    fresh_results = session.fresh_results

    def late_verdict():
        begun.set()
        may_judge.wait(120)
        return fresh_results()

    monkeypatch.setattr(session, "fresh_results", late_verdict)
    session.stop()
    assert begun.wait(120) and session.state == "stopped" and desk.is_at_work
    monkeypatch.setattr("scanner_service.sessions.book.MAX_LIVE", 1)
    with pytest.raises(SessionBusy, match="stop one first"):
        book.create("another", PushSpec())
    assert book.live(session.row.session_id) is session
    may_judge.set()
    desk.wait_for(order)
    assert not desk.is_at_work
    book.create("another", PushSpec())
    assert book.live(session.row.session_id) is None


def test_without_limits_of_the_rig_nothing_is_planned(book, scanned):
    with pytest.raises(RigUnlimited, match="state its limits"):
        book.pass_desk(scanned[0]).plan()


def test_what_is_not_in_the_plan_is_refused(book, scanned):
    desk = book.pass_desk(scanned[0])
    desk.describe_rig(RigSetup(free_reach(30.0), OPTICS))
    with pytest.raises(PassUnknown, match="no pass 99"):
        desk.accept(99)
    with pytest.raises(PassUnknown, match="no pass order 1"):
        desk.carry_out(1)


def test_a_part_that_must_be_turned_waits_for_its_operator(book, scanned):
    session, _ = scanned
    desk = book.pass_desk(session)
    reach = dataclasses.replace(linear_reach(part_may_turn=True), turn_part_s=0.1)
    desk.describe_rig(RigSetup(reach, OPTICS))
    turned = next(one for one in desk.plan().passes if one.turn is not None and not one.turn.is_none)
    order = desk.accept(turned.number)
    with pytest.raises(PartNotTurned, match="part_is_turned"):
        desk.carry_out(order.order_id)
    assert order.status is PassStatus.ACCEPTED and order.message is None  # a word that was forgotten costs no order
    desk.carry_out(order.order_id, part_is_turned=True)
    assert order.status is PassStatus.RUNNING
    with pytest.raises(SessionBusy, match="running"):
        desk.carry_out(order.order_id, part_is_turned=True)
    assert order.status is PassStatus.RUNNING  # one that runs is not cancelled by a second request
    session.stop()
    desk.wait_for(order)
    assert told(book, session, "pass_outcome") == 1
    assert "pass_cancelled" not in kinds(book, session)


def test_a_turned_pass_over_a_part_that_was_not_turned_is_doubted_until_it_is_withdrawn(book, scanned, tmp_path):
    session, posed = scanned
    desk = book.pass_desk(session)
    desk.describe_rig(RigSetup(dataclasses.replace(linear_reach(part_may_turn=True), turn_part_s=0.1), OPTICS))

    def turned_pass(motion_of, placed):
        order = desk.accept(next(one.number for one in desk.plan().passes if one.to_dict()["turn_part"]))
        desk.carry_out(order.order_id, part_is_turned=True)
        one = order.planned
        lines = posed.scan(motion_of(one).part_from_sensor, one.start_mm, one.end_mm, one.line_spacing_mm)
        sent = [placed(one.motion.at_zero, line) for line in lines]
        for reply in [session.push(line) for line in sent]:
            reply.result(120)
        session.stop()
        desk.wait_for(order)
        return order, (sent[0].device_id, sent[0].boot_id, sent[0].pass_index)

    def elsewhere(pose, line):  # the rig believes that the part is turned
        moved = {"points_mm": pose.apply(line.points_mm), "laser_mm": pose.apply(line.laser_mm)}
        return dataclasses.replace(
            line, plane_normal=pose.rotate(line.plane_normal), travel=pose.rotate(line.travel), **moved
        )

    wrong, key = turned_pass(lambda one: FROM_ABOVE, elsewhere)
    assert wrong.status is PassStatus.DOUBTED and wrong.reached_end and not wrong.teaches
    assert wrong.outcome.agreement.expected > 1000
    assert str(wrong.planned.turn) in wrong.outcome.doubt and "withdraw" in wrong.doubt
    assert session.status().message == wrong.doubt
    assert told(book, session, "pass_outcome") == 1
    (event,) = (one for one in book.record.events(session.row.session_id) if one.kind == "pass_outcome")
    assert event.details["status"] == "doubted"
    kept = Outcome.from_dict(event.details["outcome"])
    assert (kept.agreement, kept.doubt) == (wrong.outcome.agreement, wrong.outcome.doubt)
    with pytest.raises(SessionBusy, match="doubted"):  # a loop would mend surface that is not there
        desk.run_loop(LoopLimits())
    before = session.status().points
    assert desk.withdraw(wrong.order_id) is wrong and wrong.passes == [key]
    assert (wrong.status, wrong.doubt, session.status().message) == (PassStatus.WITHDRAWN, None, None)
    assert session.status().points < before
    with pytest.raises(SessionBusy, match="withdrawn"):
        desk.withdraw(wrong.order_id)
    right, _ = turned_pass(lambda one: one.motion, lambda pose, line: line)
    assert right.doubt is None and right.outcome.agreement.share > 0.95
    assert right.outcome.agreement.expected > 1000 and right.teaches
    again = OrderBook()
    again.restore(book.record.events(session.row.session_id))  # as after a restart
    assert (again.get(1).status, again.get(1).passes) == (PassStatus.WITHDRAWN, [key])


def test_one_pass_is_carried_out_at_a_time(book, scanned):
    session, posed = scanned
    desk = book.pass_desk(session)
    desk.describe_rig(RigSetup(free_reach(30.0), OPTICS))
    first, second = desk.accept(1), desk.accept(2)
    desk.carry_out(first.order_id)
    push(session, posed, first.planned.motion, first.planned.start_mm, first.planned.end_mm, 1.0)
    begun, may_judge = threading.Event(), threading.Event()
    fresh_results = session.fresh_results

    def late_verdict():
        if threading.current_thread().name.startswith("pass-"):  # over, and not reckoned up yet
            begun.set()
            may_judge.wait(300)
        return fresh_results()

    session.fresh_results = late_verdict
    session.stop()
    assert begun.wait(300) and session.state == "stopped"
    with pytest.raises(SessionBusy, match="pass order 1 is being carried out"):
        desk.carry_out(second.order_id)
    assert (first.status, second.status, session.state) == (PassStatus.RUNNING, PassStatus.CANCELLED, "stopped")
    assert not first.done.is_set()
    with pytest.raises(SessionBusy, match="pass order 1 is being carried out: withdraw"):
        desk.withdraw_pass(("any", 1, 0))
    may_judge.set()
    desk.wait_for(first)
    assert first.done.is_set() and first.status is PassStatus.DONE
    third, take_out, refused = desk.accept(1), session.withdraw_pass, []

    def meanwhile(key):
        with pytest.raises(SessionBusy, match="a pass is being withdrawn") as caught:
            desk.carry_out(third.order_id)
        refused.append(caught.value)
        return take_out(key)

    session.withdraw_pass = meanwhile
    desk.withdraw(first.order_id)
    assert refused and third.status is PassStatus.ACCEPTED
    desk.carry_out(desk.accept(1).order_id)
    session.stop()


@pytest.mark.parametrize(
    ("lines_share", "failures"), [(0.0, (None, "the scanner is gone", *[None] * (TRIES - 2))), (0.5, (None,))]
)
def test_a_pass_that_was_stopped_or_failed_teaches_nothing(book, scanned, tmp_path, lines_share, failures):
    session, posed = scanned
    desk = book.pass_desk(session)
    desk.describe_rig(RigSetup(free_reach(30.0), OPTICS))
    plan = desk.plan()
    for failure in failures:
        order = desk.accept(1)
        one = order.planned
        desk.carry_out(order.order_id)
        if lines_share:
            end_mm = one.start_mm + lines_share * (one.end_mm - one.start_mm)
            push(session, posed, one.motion, one.start_mm, end_mm, one.line_spacing_mm)
        if failure is None:
            session.stop()
        else:
            session.hearing.ended(failure)
        desk.wait_for(order)
        assert order.status is (PassStatus.DONE if failure is None else PassStatus.FAILED)
        assert not order.reached_end and not order.teaches
        assert len(order.outcome.missed_mm)
    told(book, session, "pass_outcome")
    session_id = session.row.session_id
    again = desk.plan()
    book.close()
    book.record.close()
    with Record.open(tmp_path / "record.sqlite") as record:
        later = SessionBook(record)
        reopened = later.pass_desk(later.get(session_id))
        assert not any(order.teaches for order in reopened.orders())
        reopened.describe_rig(RigSetup(free_reach(30.0), OPTICS))
        for now in (again, reopened.plan()):
            assert now.passes[0].learned == NO_EXPERIENCE
            assert not any("passes that should have seen it" in lost.why for lost in now.unreachable)
            if not lines_share:  # nothing was seen: all is wanted as before, and no way is known
                assert now.promised_mm2 == pytest.approx(plan.promised_mm2)
                assert now.passes[0].approach_s == plan.passes[0].approach_s
        later.close()


def test_an_accepted_pass_can_be_cancelled_until_it_is_carried_out(book, scanned):
    session, _ = scanned
    desk = book.pass_desk(session)
    desk.describe_rig(RigSetup(free_reach(30.0), OPTICS))
    order = desk.accept(1)
    assert desk.cancel(order.order_id).status is PassStatus.CANCELLED
    with pytest.raises(SessionBusy, match="cancelled"):
        desk.carry_out(order.order_id)
    with pytest.raises(SessionBusy, match="cannot be cancelled"):
        desk.cancel(order.order_id)
    assert told(book, session, "pass_cancelled") == 1


def test_orders_outlast_a_restart(book, scanned, tmp_path):
    session, posed = scanned
    desk = book.pass_desk(session)
    desk.describe_rig(RigSetup(free_reach(30.0), OPTICS))
    done = desk.accept(1)
    desk.carry_out(done.order_id)
    one = done.planned
    push(session, posed, one.motion, one.start_mm, one.end_mm, one.line_spacing_mm)
    session.stop()
    desk.wait_for(done)
    accepted, given_up = desk.accept(1), desk.accept(2)
    desk.cancel(given_up.order_id)
    session_id = session.row.session_id
    assert told(book, session, "pass_outcome") == 1
    assert told(book, session, "pass_cancelled") == 1
    book.close()
    book.record.close()
    with Record.open(tmp_path / "record.sqlite") as record:
        again = SessionBook(record)
        reopened = again.pass_desk(again.get(session_id))
        assert [order.status for order in reopened.orders()] == [
            PassStatus.DONE, PassStatus.ACCEPTED, PassStatus.CANCELLED
        ]  # fmt: skip
        first = reopened.order(1)
        assert first.outcome.reached_mm2 == pytest.approx(done.outcome.reached_mm2)
        assert first.map_passes == done.map_passes == [1]
        assert first.reached_end and first.teaches
        assert len(first.outcome.missed_mm) == len(done.outcome.missed_mm)
        reopened.describe_rig(RigSetup(free_reach(30.0), OPTICS))
        reopened.carry_out(accepted.order_id)  # what was accepted can still be carried out
        assert reopened.order(accepted.order_id).status is PassStatus.RUNNING
        again.close()


def test_what_no_pose_sees_is_unreachable_until_the_rig_can_do_more(book, scanned):
    session, _ = scanned
    desk = book.pass_desk(session)
    fixed = RigSetup(linear_reach(), OPTICS)
    desk.describe_rig(fixed)
    assert desk.foretell().lost_regions  # whoever only looks changes nothing
    assert not any(region.status is RegionStatus.UNREACHABLE for region in session.results().regions)
    plan = desk.plan()
    lost = {region.region_id for region in session.results().regions if region.status is RegionStatus.UNREACHABLE}
    assert lost == set(plan.lost_regions) and lost
    shown = next(region for region in session.results().regions if region.region_id in lost)
    assert shown.history[-1].why == plan.lost_regions[shown.region_id]
    assert told(book, session, "regions_changed")
    desk.describe_rig(RigSetup(free_reach(), OPTICS))
    desk.plan()
    left = {region.region_id for region in session.results().regions if region.status is RegionStatus.UNREACHABLE}
    assert lost - left


def test_regions_can_be_named_and_unknown_ones_are_refused(book, scanned):
    session, _ = scanned
    desk = book.pass_desk(session)
    desk.describe_rig(RigSetup(free_reach(30.0), OPTICS))
    wanted = max(session.results().regions, key=lambda region: region.area_mm2).region_id
    plan = desk.plan(Serving(regions=frozenset({wanted})))
    assert {promise.region for one in plan.passes for promise in one.promises} == {wanted}
    with pytest.raises(PassUnknown, match="no region 4711"):
        desk.plan(Serving(regions=frozenset({4711})))


def test_a_rig_that_a_client_drives_is_looped_until_a_pass_lies_elsewhere(book, scanned):
    session, posed = scanned
    desk = book.pass_desk(session)
    desk.describe_rig(RigSetup(free_reach(30.0), OPTICS, driven_by_client=True))
    loop = desk.run_loop(LoopLimits(max_passes=5))
    carried = set()
    while loop.running:
        for order in desk.orders():
            if order.status is PassStatus.RUNNING and order.order_id not in carried:
                carried.add(order.order_id)
                one = order.planned
                lines = posed.scan(one.motion.part_from_sensor, one.start_mm, one.end_mm, one.line_spacing_mm)
                lift = np.array([0.0, 0.0, 2.5 * (len(carried) - 1)])  # the second is believed to be higher than it is
                for reply in [session.push(raised(line, lift)) for line in lines]:
                    reply.result(120)
                session.stop()
        desk._session._closing.wait(0.02)
    first, second = desk.orders()
    assert (first.status, second.status) == (PassStatus.DONE, PassStatus.DOUBTED)
    assert first.teaches and not second.teaches
    assert first.outcome.reached_mm2 > 0.7 * first.outcome.promised_mm2
    assert loop.why_ended == second.doubt and "was the part moved" in second.outcome.doubt


def raised(line, lift_mm):
    return dataclasses.replace(line, points_mm=line.points_mm + lift_mm, laser_mm=line.laser_mm + lift_mm)


def test_a_hand_cannot_be_looped(book, scanned):
    desk = book.pass_desk(scanned[0])
    desk.describe_rig(RigSetup(free_reach(30.0), OPTICS))
    with pytest.raises(SessionBusy, match="by hand"):
        desk.run_loop(LoopLimits())
