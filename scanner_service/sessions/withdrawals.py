"""Passes that were taken out of the map or closed, as the record's events tell it; does neither itself."""

from collections.abc import Iterable

from scanner_service.analysis.passes import PassKey
from scanner_service.storage.rows import EventRow

WITHDRAWN = "pass_withdrawn"
SCAN_ENDED = "losses"
"""The event at the end of a scan: what was scanned before it is closed. It holds the losses up to then."""

SERVICE_ENDED = "service_ended"
"""The event with which the next service says that the last one ended in the middle; it closes the passes too."""


def withdrawn_passes(events: Iterable[EventRow]) -> set[PassKey]:
    """The passes that the events withdraw."""
    return {
        (str(event.details["device_id"]), int(event.details["boot_id"]), int(event.details["pass_index"]))
        for event in events
        if event.kind == WITHDRAWN and not event.damaged
    }


def ends_of_passes(events: Iterable[EventRow]) -> list[int]:
    """After how many lines of the session every pass was closed, in order."""
    return [event.line_number for event in events if event.kind in (SCAN_ENDED, SERVICE_ENDED) and not event.damaged]
