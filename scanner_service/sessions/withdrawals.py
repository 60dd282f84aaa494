"""Passes that are taken out of the map, and passes that were closed and when, as the record's events tell it."""

from collections.abc import Iterable, Mapping
from typing import Any

from scanner_service.analysis.passes import PassKey
from scanner_service.sessions.engine import Engine
from scanner_service.storage.record import Record
from scanner_service.storage.rows import EventRow

WITHDRAWN = "pass_withdrawn"
SCAN_ENDED = "losses"
"""The event at the end of a scan: what was scanned before it is closed. It holds the losses up to then."""

SERVICE_ENDED = "service_ended"
"""The event with which the next service says that the last one ended in the middle; it closes the passes too."""


def withdraw(record: Record, engine: Engine, key: PassKey) -> int:
    """Take a pass out of the map; returns how many points that were, 0 when it is unknown or withdrawn already.

    Durable first: a map that forgot what the record still counts would differ after the next start.
    """
    named = {"device_id": key[0], "boot_id": key[1], "pass_index": key[2]}
    if not engine.ask(lambda engine: engine.live_map.has_pass(key)).result():
        return 0
    record.append_event(engine.session_id, WITHDRAWN, named, timeout_s=5.0).result(30.0)
    return engine.ask(lambda engine: engine.withdraw_pass(key)).result()


def withdrawn_passes(events: Iterable[EventRow]) -> set[PassKey]:
    """The passes that the events withdraw."""
    return {key_of(event.details) for event in events if event.kind == WITHDRAWN and not event.damaged}


def key_of(named: Mapping[str, Any]) -> PassKey:
    """A pass that is named in JSON; raises KeyError, TypeError, ValueError when none is."""
    return str(named["device_id"]), int(named["boot_id"]), int(named["pass_index"])


def ends_of_passes(events: Iterable[EventRow]) -> list[int]:
    """After how many lines of the session every pass was closed, in order."""
    return [event.line_number for event in events if event.kind in (SCAN_ENDED, SERVICE_ENDED) and not event.damaged]


def end_of_scan_utc(events: Iterable[EventRow]) -> str | None:
    """When the scan ended last, as the record has it; None while it has not."""
    times = [event.time_utc for event in events if event.kind in (SCAN_ENDED, SERVICE_ENDED) and not event.damaged]
    return times[-1] if times else None
