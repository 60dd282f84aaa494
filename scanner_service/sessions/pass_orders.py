"""The orders of one session: passes that were accepted, how far each has come, and how they outlast a restart.

Knows the record's events as values, no session, no planner and no thread.
"""

import logging
import threading
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from scanner_service.analysis.passes import PassKey
from scanner_service.rescan.passes.kept_pass import keep_pass, kept_pass
from scanner_service.rescan.passes.outcome import Outcome
from scanner_service.rescan.passes.recommendation import RecommendedPass
from scanner_service.sessions.errors import PassUnknown, SessionBusy
from scanner_service.sessions.reckoning import Brought
from scanner_service.sessions.withdrawals import WITHDRAWN, key_of
from scanner_service.storage.rows import EventRow

_LOG = logging.getLogger(__name__)
ACCEPTED, STARTED, CANCELLED, OUTCOME = "pass_accepted", "pass_started", "pass_cancelled", "pass_outcome"
KEPT = "pass_kept"
"""Events of the record, in the order of an order's life."""

_ENDED = "the service ended while the pass was carried out"
_IS_KEPT = "it was doubted, and somebody said that it lies where it should"


class PassStatus(StrEnum):
    """How far an accepted pass has come.

    `doubted`: it was carried out, and its points seem to lie elsewhere than where they were measured; nothing that it
    brought is counted until somebody withdraws or keeps it. `withdrawn`: its points were taken out of the map.
    """

    ACCEPTED = "accepted"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"
    DOUBTED = "doubted"
    WITHDRAWN = "withdrawn"


@dataclass(slots=True)
class PassOrder:
    """A pass that was accepted: which one, how far it has come, and what became of it.

    `map_passes` are the numbers that its scanlines have in the map, once it is done, and `passes` the names of these
    passes; `reached_end` is True when they go through to the end of the pass, None when the record is of a time when
    this was not kept. `done` is set when a pass that was carried out is over and its outcome told.
    """

    order_id: int
    planned: RecommendedPass
    version: int
    status: PassStatus = PassStatus.ACCEPTED
    outcome: Outcome | None = None
    message: str | None = None
    map_passes: list[int] = field(default_factory=list)
    passes: list[PassKey] = field(default_factory=list)
    reached_end: bool | None = False
    done: threading.Event = field(default_factory=threading.Event, repr=False, compare=False)

    @property
    def is_over(self) -> bool:
        """True when nothing more will become of it."""
        return self.status not in (PassStatus.ACCEPTED, PassStatus.RUNNING)

    @property
    def teaches(self) -> bool:
        """True when it was carried out as planned, to its end: what it did not bring is not there to be had."""
        went = self.reached_end if self.reached_end is not None else bool(self.map_passes)
        return self.status is PassStatus.DONE and self.outcome is not None and went

    @property
    def is_in_force(self) -> bool:
        """True when it is over, and its points are in the map, where they were measured."""
        return self.status in (PassStatus.DONE, PassStatus.FAILED)

    @property
    def doubt(self) -> str | None:
        """That nothing which it brought is counted, and what to do (its outcome says why); None when all is well."""
        if self.status is not PassStatus.DOUBTED:
            return None
        return (
            f"pass order {self.order_id} is doubted, its points seem to lie elsewhere than where they were measured: "
            f"withdraw it and scan it again, or keep it (in the viewer, or `scanner rescan` with --withdraw "
            f"{self.order_id} or --keep {self.order_id})"
        )

    def end(self, brought: Brought, failure: str | None) -> None:
        """It was carried out, and reckoned up; `failure` says why its scan failed, if it did."""
        self.outcome, self.reached_end = brought.outcome, brought.reached_end
        self.map_passes, self.passes = brought.map_passes, brought.passes
        self.message = failure
        self.status = PassStatus.FAILED if failure else PassStatus.DONE
        self.doubt_it()

    def doubt_it(self) -> None:
        """An order that has ended elsewhere than where it was measured is doubted."""
        if self.is_in_force and self.outcome is not None and self.outcome.doubt:
            self.status = PassStatus.DOUBTED

    def keep(self) -> None:
        """Somebody says that it lies where it should; raises SessionBusy when nobody doubts it."""
        if self.status is not PassStatus.DOUBTED:
            raise SessionBusy(f"pass order {self.order_id} is {self.status.value}: only one that is doubted is kept")
        self.status, self.message = (PassStatus.FAILED, self.message) if self.message else (PassStatus.DONE, _IS_KEPT)

    def to_dict(self) -> dict[str, object]:
        """For JSON."""
        return {
            "order": self.order_id,
            "version": self.version,
            "status": self.status.value,
            "message": self.message,
            "reached_end": self.reached_end,
            "pass": self.planned.to_dict(),
            "passes": [dict(zip(("device_id", "boot_id", "pass_index"), key, strict=True)) for key in self.passes],
            "outcome": self.outcome.to_dict() if self.outcome else None,
        }


class OrderBook:
    """All orders of a session, the oldest first; whoever owns it does the locking."""

    def __init__(self) -> None:
        self._orders: list[PassOrder] = []
        self._gone: set[PassKey] = set()  # passes that were withdrawn

    def all(self) -> list[PassOrder]:
        """The orders as they are now."""
        return list(self._orders)

    def take(self, planned: RecommendedPass, version: int) -> PassOrder:
        """A new order."""
        order = PassOrder(len(self._orders) + 1, planned, version)
        self._orders.append(order)
        return order

    def get(self, order_id: int) -> PassOrder:
        """One order; raises PassUnknown."""
        if not 1 <= order_id <= len(self._orders):
            raise PassUnknown(f"no pass order {order_id} was taken in this session; accept a recommended pass first")
        return self._orders[order_id - 1]

    def running(self) -> PassOrder | None:
        """The order that is being carried out; None when none is."""
        return next((order for order in self._orders if order.status is PassStatus.RUNNING), None)

    def cancel(self, order_id: int, why: str) -> PassOrder:
        """Give an order up that was not started; raises PassUnknown, or SessionBusy when it is too late for that."""
        order = self.get(order_id)
        if order.status is not PassStatus.ACCEPTED:
            hint = "stop the session to end it" if order.status is PassStatus.RUNNING else "it is over"
            raise SessionBusy(f"pass order {order_id} is {order.status.value} and cannot be cancelled: {hint}")
        order.status, order.message = PassStatus.CANCELLED, why
        return order

    def to_withdraw(self, order_id: int) -> list[PassKey]:
        """The passes of an order that may be withdrawn; raises PassUnknown, or SessionBusy when it may not."""
        order = self.get(order_id)
        if not order.passes or order.status is PassStatus.WITHDRAWN:
            raise SessionBusy(f"pass order {order_id} is {order.status.value} and has no points in the map of its own")
        return order.passes

    def withdrawn(self, key: PassKey) -> None:
        """A pass was taken out of the map: an order that has none left there is withdrawn."""
        self._gone.add(key)
        for order in self._orders:
            self._leave(order)

    def ended(self, order: PassOrder, brought: Brought, failure: str | None) -> None:
        """As `PassOrder.end`; it is withdrawn at once when its passes were taken out before it was reckoned up."""
        order.end(brought, failure)
        self._leave(order)

    def _leave(self, order: PassOrder) -> None:
        if order.passes and self._gone.issuperset(order.passes):
            order.status = PassStatus.WITHDRAWN

    def doubt(self) -> str | None:
        """What is to be decided of the first order that is doubted; None when none is."""
        return next((order.doubt for order in self._orders if order.doubt), None)

    def restore(self, events: Iterable[EventRow]) -> None:
        """Go on where the events of an earlier service end; what it was just carrying out has failed.

        An event that cannot be read ends it: orders are numbered, and none may take another's number. A decision that
        does not fit its order is passed over.
        """
        for event in events:
            try:
                self._replay(event.kind, event.details)
            except SessionBusy as error:
                _LOG.warning("a decision on a pass order is passed over: %s", error)
            except (KeyError, TypeError, ValueError, PassUnknown) as error:
                _LOG.warning("the pass orders of a session cannot be read beyond event %s: %s", event.kind, error)
                break
        for order in self._orders:
            if order.status is PassStatus.RUNNING:
                order.status, order.message = PassStatus.FAILED, _ENDED

    def _replay(self, kind: str, details: Mapping[str, Any]) -> None:
        if kind == ACCEPTED and "kept" in details:
            if int(details["order"]) != len(self._orders) + 1:
                raise ValueError(f"order {details['order']} follows on order {len(self._orders)}")
            self.take(kept_pass(details["kept"]), int(details["version"]))
        elif kind == WITHDRAWN:
            self.withdrawn(key_of(details))
        elif kind in (STARTED, CANCELLED, OUTCOME, KEPT):
            order = self.get(int(details["order"]))
            if kind == STARTED:
                order.status = PassStatus.RUNNING
            elif kind == CANCELLED:
                order.status, order.message = PassStatus.CANCELLED, details.get("message")
            elif kind == KEPT:
                order.keep()
            else:
                order.status, order.message = PassStatus(details["status"]), details.get("message")
                order.map_passes = [int(number) for number in details.get("map_passes", ())]
                order.reached_end = bool(details["reached_end"]) if details.get("reached_end") is not None else None
                if details.get("outcome"):
                    order.outcome = Outcome.from_dict(details["outcome"])
                order.passes = [key_of(named) for named in details.get("passes", ())]
                order.doubt_it()
                self._leave(order)


def accepted_event(order: PassOrder) -> dict[str, Any]:
    """What the record keeps of an order that was taken."""
    return order.to_dict() | {"kept": keep_pass(order.planned)}


def outcome_event(order: PassOrder) -> dict[str, Any]:
    """What the record keeps of an order that is over, its missed places included."""
    told = order.to_dict()
    if order.outcome is not None:
        told["outcome"] = order.outcome.to_dict() | {
            name: getattr(order.outcome, name).round(2).tolist() for name in ("missed_mm", "empty_mm")
        }
    return told | {"map_passes": order.map_passes}
