"""The closed loop drives a turntable: scanner and table on ptys, rig file, service, and `scanner rescan --auto`."""

import json
import math

import pytest

from simulators.turntable import RADIUS_MM
from tests.end_to_end.running import wait_for
from tests.end_to_end.test_rescan_loop import rescan

FULL_TURN_MM = 2.0 * math.pi * RADIUS_MM


@pytest.fixture
def table(running):
    """A service with the rig file of a simulated turntable, and the turntable."""
    rigs = running.data / "rigs"
    rigs.mkdir(parents=True)
    simulator = running.simulator("turntable", "--rig-file", rigs / "turntable.toml")
    return running.service(), simulator


def coarse_scan(service, density_per_mm2, line_spacing_mm, share_of_turn):
    body = {
        "name": "turned",
        "source": {"kind": "rig", "rig": "turntable.toml", "line_spacing_mm": line_spacing_mm, "start_mm": 0.0,
                   "end_mm": share_of_turn * FULL_TURN_MM, "home": True},
        "settings": {"density_per_mm2": density_per_mm2},
    }  # fmt: skip
    answer = service.client.post("/api/v1/sessions", json=body)
    assert answer.status_code == 201, answer.text
    session_id = answer.json()["id"]
    service.start(session_id)
    return session_id, service.wait_for_state(session_id, "stopped")


def looped(service, session_id, *arguments):
    done = rescan(service, session_id, "--auto", *arguments)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def loop_that_ended(service, where):
    def loop():
        return service.client.get(f"{where}/rescan").json()["loop"]

    wait_for(lambda: not loop()["running"], "the loop to end")
    return loop()


def events(service, session_id):
    told = service.client.get(f"/api/v1/sessions/{session_id}/events?limit=1000").json()["events"]
    return [(event["kind"], event["details"]) for event in told]


def assert_driven_by_parts_of_a_turn(result):
    for order in result["orders"]:
        assert order["status"] == "done" and order["reached_end"], order["message"]
        one, outcome = order["pass"], order["outcome"]
        assert -1e-6 <= one["start_mm"] < one["end_mm"] <= FULL_TURN_MM + 1e-6
        assert one["turn_part"] is None and outcome["doubt"] is None


def test_part_of_a_turn_is_scanned_again_by_itself_and_a_table_that_is_gone_ends_the_loop(table):
    service, simulator = table
    session_id, before = coarse_scan(service, 4.0, 3.0, 0.35)
    assert before["lines"] == int(0.35 * FULL_TURN_MM / 3.0) + 1
    result = looped(service, session_id, "--max-passes", "1")
    assert result["loop"]["why_ended"] == "the limit of 1 passes is met"
    assert_driven_by_parts_of_a_turn(result)
    (order,) = result["orders"]
    assert order["outcome"]["reached_mm2"] > 0.6 * order["outcome"]["promised_mm2"] > 20.0
    assert service.status(session_id)["coverage"] > before["coverage"]
    kinds = [kind for kind, _ in events(service, session_id)]
    wanted = ["pass_accepted", "pass_started", "pass_outcome", "loop_ended"]
    assert [kind for kind in kinds if kind in wanted] == wanted

    simulator.tell("unplug_stage")
    where = f"/api/v1/sessions/{session_id}"
    assert service.client.post(f"{where}/rescan", json={"max_passes": 1}).status_code == 202
    loop = loop_that_ended(service, where)
    order = service.client.get(f"{where}/pass-orders").json()["orders"][-1]
    assert order["status"] == "failed" and simulator.ready["stage_port"] in order["message"]
    assert loop["why_ended"] == f"pass order {order['order']} failed: {order['message']}"
    assert service.status(session_id)["state"] == "stopped"  # nothing was scanned, and what there is stays as it was
    told = [details for kind, details in events(service, session_id) if kind == "pass_outcome"]
    assert (told[-1]["status"], told[-1]["message"]) == ("failed", order["message"])


@pytest.mark.long
@pytest.mark.timeout(3600)
def test_a_turntable_is_looped_until_the_coverage_is_reached_that_was_asked_for(table):
    service, _ = table
    session_id, before = coarse_scan(service, 16.0, 0.8, 0.6)
    assert before["coverage"] < 0.2
    where = f"/api/v1/sessions/{session_id}"
    limits = {"max_passes": 12, "coverage_share": 0.7}
    assert service.client.post(f"{where}/rescan", json=limits).status_code == 202
    wait_for(lambda: not service.client.get(f"{where}/rescan").json()["loop"]["running"], "the loop to end", 3500.0)
    loop = loop_that_ended(service, where)
    assert loop["why_ended"] == "the observed coverage of 70.0% is reached" and loop["passes"] > 1
    result = service.client.get(f"{where}/pass-orders").json()
    assert_driven_by_parts_of_a_turn(result)
    large = [order["outcome"] for order in result["orders"] if order["outcome"]["promised_mm2"] > 100.0]
    assert large and all(outcome["reached_mm2"] > 0.7 * outcome["promised_mm2"] for outcome in large)
    assert service.status(session_id)["coverage"] >= 0.7


@pytest.mark.long
def test_a_table_that_stalls_while_it_homes_fails_the_order_and_ends_the_loop_and_the_next_one_goes_on(table):
    service, simulator = table
    session_id, _ = coarse_scan(service, 6.0, 2.0, 0.9)
    where = f"/api/v1/sessions/{session_id}"
    assert service.client.post(f"{where}/rescan", json={"max_passes": 3}).status_code == 202

    def orders():
        return service.client.get(f"{where}/pass-orders").json()["orders"]

    wait_for(lambda: any(order["status"] == "running" for order in orders()), "an order to be carried out")
    simulator.tell("stall")
    loop = loop_that_ended(service, where)
    (order,) = orders()
    assert order["status"] == "failed" and order["message"]
    assert loop["why_ended"] == f"pass order {order['order']} failed: {order['message']}"
    failed = service.status(session_id)
    assert (failed["state"], failed["message"]) == ("failed", order["message"])
    assert [kind for kind, _ in events(service, session_id) if kind.startswith(("pass_o", "loop"))] == [
        "pass_outcome", "loop_ended"
    ]  # fmt: skip

    result = looped(service, session_id, "--max-passes", "1")  # somebody has seen to it
    assert_driven_by_parts_of_a_turn(result)
    mended = service.status(session_id)
    assert (mended["state"], mended["message"]) == ("stopped", None)
    assert mended["lines"] > failed["lines"]
