"""`scanner rescan`: recommended passes of a session of a running service: list, carry out, or the whole closed loop."""

import contextlib
import time
from collections.abc import Sequence
from typing import Annotated, Any

import httpx
import typer
from rich.table import Table

from scanner_service.commands.data_folder import DEFAULT_DATA, Data
from scanner_service.commands.sessions import named, running_service
from scanner_service.commands.terminal import console, errors, fail, plain_errors, show_json, waiting_for

Serving = dict[str, Sequence[str | int | float | bool | None]]
_POLL_S = 0.3
_PLANNED_S = 900.0
"""A plan takes a second or two; on a computer that is busy with much else, minutes."""
_PLANNING = "planning passes …"
_UNDER_WAY = ("accepted", "running")
_UNCOUNTED = {"doubted": "doubted: nothing of it is counted", "withdrawn": "withdrawn: its points are out of the map"}


def rescan_command(
    session: Annotated[str, typer.Argument(help="The session's id, its first letters, or `latest`.")],
    carry_out: Annotated[int | None, typer.Option("--pass", help="Carry out this pass of the list.")] = None,
    plan: Annotated[str | None, typer.Option("--plan", help="The plan that --pass was listed in.")] = None,
    turned: Annotated[bool, typer.Option("--turned", help="The part lies as the pass asks.")] = False,
    auto: Annotated[bool, typer.Option("--auto", help="Repeat until nothing is left to do.")] = False,
    cancel: Annotated[int | None, typer.Option("--cancel", help="Give up this accepted order.")] = None,
    withdraw: Annotated[
        int | None, typer.Option("--withdraw", help="Take what this order scanned out of the map.")
    ] = None,
    keep: Annotated[int | None, typer.Option("--keep", help="Count a doubted order: it lies where it should.")] = None,
    region: Annotated[list[int] | None, typer.Option("--region", min=1, help="Serve this region; repeatable.")] = None,
    reason: Annotated[list[str] | None, typer.Option("--reason", help="Serve this reason; repeatable.")] = None,
    max_passes: Annotated[int, typer.Option(min=1, max=200, help="Most passes of --auto.")] = 20,
    max_seconds: Annotated[float, typer.Option(min=1.0, help="Most seconds of passes of --auto.")] = 600.0,
    coverage: Annotated[
        float | None,
        typer.Option(min=0.0, max=1.0, help="Coverage that ends --auto; that of the requirement by default."),
    ] = None,
    data: Data = DEFAULT_DATA,
    url: Annotated[str, typer.Option(help="Where the service listens.")] = "http://127.0.0.1:8765",
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """List the recommended passes of a session, carry one out, or all of them by themselves."""
    with plain_errors():
        asked = {"cancel": cancel, "withdraw": withdraw, "keep": keep}
        decided = [(verb, order) for verb, order in asked.items() if order is not None]
        if sum((auto, carry_out is not None, len(decided))) > 1:
            fail("say one of --pass, --auto, --cancel, --withdraw and --keep")
        if coverage is not None and not auto:
            fail("--coverage ends a loop: say --auto as well")
        if (carry_out is None) != (plan is None):
            fail(
                "say --pass and --plan together: the plan is named below the list of passes, and what the number means "
                "depends on it"
            )
        serving: Serving = {"region": region or [], "reason": reason or []}
        with running_service(data, url) as client:
            where = f"/api/v1/sessions/{named(client, session)}"
            if auto:
                limits = {"max_passes": max_passes, "max_seconds": max_seconds, "coverage_share": coverage}
                chosen = {"regions": serving["region"], "reasons": serving["reason"]}
                result = _loop(client, where, limits | chosen, as_json)
            elif carry_out is not None and plan is not None:
                result = _one(client, where, carry_out, plan, turned, serving)
            elif decided:
                verb, order = decided[0]
                result = _decide(client, f"{where}/pass-orders/{order}", verb)
            else:
                with waiting_for(_PLANNING):
                    result = _ask(client.get(f"{where}/recommended-passes", params=serving, timeout=_PLANNED_S))
        if as_json:
            show_json(result)
        elif auto:
            _tell_orders(result["orders"])
            console.print(f"The loop ended: {result['loop']['why_ended']}.", highlight=False, soft_wrap=True)
        elif carry_out is not None or decided:
            _tell_orders([result])
        else:
            _tell_plan(result)


def _loop(client: httpx.Client, where: str, limits: dict[str, Any], quiet: bool) -> dict[str, Any]:
    """Start the closed loop and follow it to its end."""
    before = len(_ask(client.get(f"{where}/pass-orders"))["orders"])
    told = before
    with waiting_for(_PLANNING) as say:
        _ask(client.post(f"{where}/rescan", json=limits, timeout=_PLANNED_S))
        while True:
            loop = _ask(client.get(f"{where}/rescan"))["loop"]
            orders = _ask(client.get(f"{where}/pass-orders"))["orders"]
            while told < len(orders) and orders[told]["status"] not in _UNDER_WAY:
                if not quiet:
                    said = f"order {orders[told]['order']}: {_said(orders[told])}"
                    errors.print(said, highlight=False, soft_wrap=True)
                told += 1
            if not loop["running"]:
                return {"loop": loop, "orders": orders[before:]}
            under_way = next((order for order in orders if order["status"] == "running"), None)
            say(_PLANNING if under_way is None else f"order {under_way['order']} is carried out …")
            time.sleep(_POLL_S)


def _one(client: httpx.Client, where: str, number: int, plan: str, turned: bool, serving: Serving) -> dict[str, Any]:
    """Accept a pass, carry it out and wait for its end; a hand is guided meanwhile. One refused is cancelled."""
    accept = f"{where}/recommended-passes/{number}/accept"
    order = _ask(client.post(accept, params=serving, json={"plan": plan}, timeout=_PLANNED_S))
    mine = f"{where}/pass-orders/{order['order']}"
    errors.print(f"order {order['order']}: {_said(order)}", highlight=False, soft_wrap=True)
    turn = order["pass"]["turn_part"]
    if turned != (turn is not None):  # nothing moved yet, and the same command can be given again
        client.delete(mine)
        if turn is None:
            fail(f"pass {number} of plan {plan} asks for no turn of the part: leave out --turned")
        fail(f"first {turn}; then give the same command with --turned (nothing moved, order {order['order']} is gone)")
    _ask(client.post(f"{mine}/carry-out", json={"part_is_turned": turned}))
    by_hand = _ask(client.get(where))["source"]["kind"] == "push"
    said = ""
    while True:
        order = _ask(client.get(mine))
        if order["status"] not in _UNDER_WAY:
            return dict(order)
        if by_hand:
            guidance = client.get(f"{mine}/guidance")
            now = guidance.json()["say"] if guidance.is_success else guidance.json()["detail"]
            if now != said:
                said = now
                errors.print(now, highlight=False, soft_wrap=True)
        time.sleep(_POLL_S)


def _decide(client: httpx.Client, order: str, verb: str) -> Any:
    """Cancel, withdraw or keep an order; what it is then."""
    if verb == "cancel":
        return _ask(client.delete(order))
    with waiting_for("judging the scan anew …") if verb == "withdraw" else contextlib.nullcontext():
        return _ask(client.post(f"{order}/{verb}", timeout=_PLANNED_S))


def _said(order: dict[str, Any]) -> str:
    one = order["pass"]
    head = f"{one['start_mm']:.1f} to {one['end_mm']:.1f} mm, lines {one['line_spacing_mm']:.3f} mm apart"
    return f"{head}: {fate_of(order)}"


def fate_of(order: dict[str, Any]) -> str:
    """What became of an order, in words."""
    told, outcome = [_UNCOUNTED.get(order["status"], order["status"])], order["outcome"]
    if order["status"] == "doubted" and outcome is not None:
        decide = "`scanner rescan SESSION --withdraw {0}`, then scan it again; if not, `--keep {0}`"
        told.append(f"{outcome['doubt']} If so, {decide.format(order['order'])}")
    elif order["status"] != "withdrawn" and outcome is not None:
        if outcome["promised_mm2"] >= 0.5 or outcome["expected_mm2"] < 1.0:
            promised = _area(outcome["promised_mm2"], outcome["promised_between_mm2"])
            told.append(f"promised {promised}, reached {outcome['reached_mm2']:.0f} mm²")
        if outcome["expected_mm2"] >= 1.0:
            expected = _area(outcome["expected_mm2"], outcome["expected_between_mm2"])
            told.append(f"explored: {outcome['found_mm2']:.0f} mm² found, {expected} expected")
    if order["status"] == "done" and order["reached_end"] is False:
        told.append("ended before its end")
    if order["message"]:
        told.append(order["message"])
    return "; ".join(told)


def _area(mm2: float, between_mm2: list[float] | None) -> str:
    """An area as it was foretold, with the interval in which it lies four times in five: "12 mm² (8 to 15)"."""
    return f"{mm2:.0f} mm²" + ("" if between_mm2 is None else f" ({between_mm2[0]:.0f} to {between_mm2[1]:.0f})")


def _tell_plan(plan: dict[str, Any]) -> None:
    """The numbers as a table that fits a narrow terminal, and below it what each pass is for, uncut."""
    table = Table(title="Recommended passes", title_justify="left")
    for name in ("pass", "from mm", "to mm", "spacing", "lines", "s", "gain mm²", "mm²/s"):
        table.add_column(name, justify="right", no_wrap=True)
    for one in plan["passes"]:
        table.add_row(
            str(one["number"]), f"{one['start_mm']:.1f}", f"{one['end_mm']:.1f}", f"{one['line_spacing_mm']:.3f}",
            str(one["lines"]), f"{one['duration_s'] + one['approach_s']:.1f}", f"{one['gain_mm2']:.0f}",
            f"{one['gain_per_s_mm2']:.1f}",
        )  # fmt: skip
    if plan["passes"]:
        console.print(table)
    else:
        console.print("No pass is recommended.")
    for one in plan["passes"]:
        first = f"; first {one['turn_part']} (then say --turned)" if one["turn_part"] else ""
        said = f"pass {one['number']} serves {_served(one)}: {_foretold(one)}{first}"
        console.print(said, highlight=False, soft_wrap=True)
    for lost in plan["unreachable"]:
        of = "outside of any region, as guessed" if lost["region"] is None else f"of region {lost['region']}"
        said = (
            f"unreachable: {lost['area_mm2']:.1f} mm² {of}, {lost['share']:.0%} of what is wanted there: {lost['why']}"
        )
        console.print(said, highlight=False, soft_wrap=True)
    if plan["passes"]:
        said = f"This is plan {plan['plan']}; --pass NUMBER --plan {plan['plan']} carries one out."
        console.print(said, highlight=False, soft_wrap=True)


def _served(one: dict[str, Any]) -> str:
    named = [str(item["region"]) for item in one["serves"] if item["region"] is not None]
    regions = f"region{'s' if len(named) > 1 else ''} {', '.join(named)}" if named else ""
    unseen = "unseen surface" if len(named) < len(one["serves"]) else ""
    return " and ".join(filter(None, (regions, unseen))) or "nothing"


def _foretold(one: dict[str, Any]) -> str:
    """What a pass promises, and what it explores, each with its interval."""
    promised = f"promises {_area(one['promised_mm2'], one['promised_between_mm2'])}"
    explored = f"explores, and expects {_area(one['explores_mm2'], one['explores_between_mm2'])}"
    told = [promised] if one["promised_mm2"] >= 0.5 else []
    return ", ".join([*told, explored] if one["explores_mm2"] >= 0.5 or not told else told)


def _tell_orders(orders: list[dict[str, Any]]) -> None:
    for order in orders:
        console.print(f"order {order['order']}: {_said(order)}", highlight=False, soft_wrap=True)


def _ask(response: httpx.Response) -> Any:
    if response.is_error:
        fail(f"the service refused: {response.json().get('detail', response.text)}")
    return response.json()
