"""Recommended passes: list, accept, cancel, carry out, guide, loop; each is one call of the session's pass desk."""

from typing import Annotated

import numpy as np
from fastapi import APIRouter, Depends, Query, Request
from starlette.responses import Response

from scanner_service.api.answers import answer
from scanner_service.api.pass_schemas import AcceptIn, CarryOutIn, LoopIn, ReasonName, RegionId, RigIn, serving_of
from scanner_service.api.routes.sessions import Session, book_of, operator, status_answer, viewer
from scanner_service.api.schemas import PassIn
from scanner_service.rescan.passes.serving import Serving
from scanner_service.sessions.pass_desk import PassDesk
from scanner_service.sessions.pass_planning import name_of

router = APIRouter(prefix="/api/v1/sessions/{session_id}", tags=["passes"])


def desk_of(request: Request, session: Session) -> PassDesk:
    """The session's pass desk."""
    return book_of(request).pass_desk(session)


Desk = Annotated[PassDesk, Depends(desk_of)]


def named_serving(
    region: Annotated[list[RegionId] | None, Query(max_length=1000)] = None,
    reason: Annotated[list[ReasonName] | None, Query(max_length=10)] = None,
) -> Serving:
    """What the passes are to serve: `region` by its id and `reason` may be named several times; none: everything."""
    return serving_of(region or [], reason or [])


Served = Annotated[Serving, Depends(named_serving)]


@router.put("/rig", dependencies=[operator])
def state_rig(desk: Desk, body: RigIn) -> Response:
    """State what the rig can do and what the scanner can see; needed where the service does not drive the scanner."""
    desk.describe_rig(body.to_setup())
    return answer({"stated": body.model_dump()})


@router.get("/recommended-passes", dependencies=[viewer])
def list_passes(desk: Desk, serving: Served) -> Response:
    """The recommended passes for the map as it is, the best for its time first, and what none of them can bring.

    Nothing is changed by that: regions that no pass can bring are marked when a pass is accepted or a loop plans.
    """
    plan = desk.foretell(serving)
    return answer({"plan": name_of(plan)} | plan.to_dict())


@router.post("/recommended-passes/{number}/accept", status_code=201, dependencies=[operator])
def accept_pass(desk: Desk, number: int, serving: Served, body: AcceptIn = AcceptIn()) -> Response:  # noqa: B008
    """Take an order for a pass of the plan that was listed for the same regions and reasons. Nothing moves by that.

    The status is 409 when that plan is no longer in force: the number may then mean another pass.
    """
    return answer(desk.accept(number, serving, body.seen()).to_dict(), 201)


@router.get("/pass-orders", dependencies=[viewer])
def list_orders(desk: Desk) -> Response:
    """Passes that were accepted, with what they promised and what they brought."""
    return answer({"orders": [order.to_dict() for order in desk.orders()]})


@router.get("/pass-orders/{order}", dependencies=[viewer])
def get_order(desk: Desk, order: int) -> Response:
    """One accepted pass."""
    return answer(desk.order(order).to_dict())


@router.post("/pass-orders/{order}/carry-out", dependencies=[operator])
def carry_out(desk: Desk, order: int, body: CarryOutIn = CarryOutIn()) -> Response:  # noqa: B008 - it is frozen
    """Drive an accepted pass, or wait for the scanlines that a hand brings. The laser is switched on.

    It may come without a body: then the part is not turned. Where the pass asks for a turn, that is refused and the
    order waits on.

    An order that is refused for another reason is cancelled, and one whose devices do not set off has failed, with the
    reason as its message.
    """
    return answer(desk.carry_out(order, body.part_is_turned).to_dict())


@router.delete("/pass-orders/{order}", dependencies=[operator])
def cancel_order(desk: Desk, order: int) -> Response:
    """Give up an accepted pass that was not carried out, at once; it stays in the list, as cancelled."""
    return answer(desk.cancel(order).to_dict())


@router.post("/pass-orders/{order}/withdraw", dependencies=[operator])
def withdraw_order(desk: Desk, order: int) -> Response:
    """Take what an accepted pass has scanned out of the map: it is `withdrawn`, and may be planned again.

    Its lines stay in the record. The answer comes when all is judged anew.
    """
    return answer(desk.withdraw(order).to_dict())


@router.post("/pass-orders/{order}/keep", dependencies=[operator])
def keep_order(desk: Desk, order: int) -> Response:
    """Count what a doubted pass has brought after all: somebody who has looked says that it lies where it should."""
    return answer(desk.keep(order).to_dict())


@router.post("/passes/withdraw", dependencies=[operator])
def withdraw_pass(session: Session, desk: Desk, body: PassIn) -> Response:
    """Take a pass out of the map, as if it had never been scanned. Its raw lines stay in the record."""
    points = desk.withdraw_pass((body.device_id, body.boot_id, body.pass_index))
    return answer({**status_answer(session), "withdrawn_points": points})


@router.get("/pass-orders/{order}/guidance", dependencies=[viewer])
def get_guidance(desk: Desk, order: int) -> Response:
    """Where the scanner is beside an accepted pass: how far, which way, how fast."""
    found = desk.guidance(order)
    return answer(
        {
            "along_mm": found.along_mm,
            "aside_mm": found.aside_mm,
            "angle_deg": float(np.degrees(found.angle_rad)),
            "speed_mm_per_s": found.speed_mm_per_s,
            "wanted_mm_per_s": found.wanted_mm_per_s,
            "say": found.say,
        }
    )


@router.post("/rescan", status_code=202, dependencies=[operator])
def start_loop(desk: Desk, body: LoopIn = LoopIn()) -> Response:  # noqa: B008 - it is frozen
    """Plan and carry out by itself until the requirement holds, nothing reachable is left, or a limit is met."""
    return answer(desk.run_loop(body.to_limits()).to_dict(), 202)


@router.get("/rescan", dependencies=[viewer])
def get_loop(desk: Desk) -> Response:
    """The closed loop: how far it is, or why it ended; null when there was none."""
    return answer({"loop": desk.loop.to_dict() if desk.loop is not None else None})


@router.delete("/rescan", status_code=202, dependencies=[operator])
def end_loop(desk: Desk) -> Response:
    """End the closed loop after the pass that is under way."""
    desk.end_loop()
    return answer({"loop": desk.loop.to_dict() if desk.loop is not None else None}, 202)
