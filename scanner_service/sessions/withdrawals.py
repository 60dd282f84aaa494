"""Passes that were taken out of the map, as the record's events tell it; withdraws nothing itself."""

from collections.abc import Iterable

from scanner_service.analysis.passes import PassKey
from scanner_service.storage.rows import EventRow

WITHDRAWN = "pass_withdrawn"


def withdrawn_passes(events: Iterable[EventRow]) -> set[PassKey]:
    """The passes that the events withdraw."""
    return {
        (str(event.details["device_id"]), int(event.details["boot_id"]), int(event.details["pass_index"]))
        for event in events
        if event.kind == WITHDRAWN and not event.damaged
    }
