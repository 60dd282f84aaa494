"""`scanner demo --loop`: a coarse scan, and the closed loop that mends it, carried out by a simulated arm."""

import time
from typing import TYPE_CHECKING, Any

import httpx

from scanner_service.commands.rescan import fate_of
from scanner_service.commands.terminal import errors, fail

if TYPE_CHECKING:
    from scanner_service.commands.simulated_arm import SimulatedArm

FIRST_SPACING_MM = 0.4
DENSITY_PER_MM2 = 16.0
MAX_PASSES = 16
COVERAGE_SHARE = 0.97
_POLL_S = 0.1


def demo_name(what: str, part: str) -> str:
    """What a session of the demo is called: by its part where that is not the demo's own."""
    return what if part == "demo" else f"{what}: {part}"


def watch_loop(client: httpx.Client, part: str, seed: int) -> str:
    """Scan the part coarsely from above, then let the loop run to its end, telling of each pass; the session's id."""
    try:
        from scanner_service.commands.simulated_arm import SimulatedArm  # noqa: PLC0415 - an extra: tell how to get it
        from simulators.parts import PARTS  # noqa: PLC0415
    except ImportError as error:
        fail(f"the simulated arm needs {error.name}: install scanner-service[simulation]")
    subject = PARTS[part]()
    asked = {
        "name": demo_name("demo loop", part),
        "source": {"kind": "push"},
        "settings": {"density_per_mm2": DENSITY_PER_MM2},
    }
    try:
        session_id = str(_asked(client, "POST", "/api/v1/sessions", asked)["id"])
        arm = SimulatedArm(client, session_id, subject, seed)
        arm.scan_from_above(*subject.travel_mm, FIRST_SPACING_MM)
        where = f"/api/v1/sessions/{session_id}"
        _tell(f"one coarse pass from above: {_coverage(client, where)}")
        arm.state_rig()
        _asked(client, "POST", f"{where}/rescan", {"max_passes": MAX_PASSES, "coverage_share": COVERAGE_SHARE})
        why = _follow(client, where, arm)
    except httpx.HTTPStatusError as error:
        fail(f"the service refused: {error.response.json().get('detail', error.response.text)}")
    _tell(f"The loop ended: {why}.")
    return session_id


def _follow(client: httpx.Client, where: str, arm: "SimulatedArm") -> str:
    """Carry out what the loop orders, and tell what became of it; why the loop ended."""
    carried: set[int] = set()
    told: set[int] = set()
    while True:
        loop = _asked(client, "GET", f"{where}/rescan")["loop"]
        for order in _asked(client, "GET", f"{where}/pass-orders")["orders"]:
            number, status = order["order"], order["status"]
            if status == "running" and number not in carried:
                carried.add(number)
                _tell(f"pass {number} is under way: {order['pass']['lines']} lines")
                arm.carry_out(order)
            elif status not in ("accepted", "running") and number not in told:
                told.add(number)
                _tell(f"{_said(order)}; {_coverage(client, where)}")
                if loop["running"]:
                    _tell("planning the next pass")
        if not loop["running"]:
            return str(loop["why_ended"])
        time.sleep(_POLL_S)


def _said(order: dict[str, Any]) -> str:
    """One pass and what became of it."""
    one = order["pass"]
    return f"pass {order['order']}, {one['lines']} lines {one['line_spacing_mm']:.2f} mm apart: {fate_of(order)}"


def _coverage(client: httpx.Client, where: str) -> str:
    share = _asked(client, "GET", where)["coverage"]
    return "observed coverage unknown" if share is None else f"observed coverage {share:.1%}"


def _asked(client: httpx.Client, method: str, path: str, body: object = None) -> Any:
    return client.request(method, path, json=body).raise_for_status().json()


def _tell(text: str) -> None:
    errors.print(text, highlight=False, soft_wrap=True)
