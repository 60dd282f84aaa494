"""Where a session ends: the next numbers and how far each device got; reads the record and never writes it."""

from dataclasses import dataclass, field, replace

from sqlalchemy import Connection, func, select

from scanner_service.storage.rows import Count, Watermark
from scanner_service.storage.tables import events, lines, row_crc

_LOOK_BACK_LINES = 16


@dataclass(slots=True)
class Tail:
    """Where a session ends: the next numbers, and per device and boot (in order of arrival) how far it got."""

    next_line: int = 0
    points: int = 0
    next_event: int = 0
    marks: dict[tuple[str, int], Watermark] = field(default_factory=dict)
    latest_boot: dict[str, int] = field(default_factory=dict)

    def copy(self) -> "Tail":
        """A tail of its own, so that a failed batch leaves this one as it was."""
        return replace(self, marks=dict(self.marks), latest_boot=dict(self.latest_boot))

    def watermarks(self) -> dict[str, Watermark]:
        """Of each device, the watermark of the boot whose line was stored last."""
        return {device: self.marks[device, boot] for device, boot in self.latest_boot.items()}

    def advance(self, device_id: str, boot_id: int, line_index: int, points: int) -> None:
        """Account for one more line."""
        key = (device_id, boot_id)
        mark = self.marks.get(key)
        if mark is None:
            self.marks[key] = Watermark(boot_id, line_index, line_index, 1)
        else:
            highest, first = max(mark.line_index, line_index), min(mark.first_index, line_index)
            self.marks[key] = Watermark(boot_id, highest, first, mark.line_count + 1)
        self.latest_boot[device_id] = boot_id
        self.next_line += 1
        self.points += points


def load_tail(connection: Connection, session_id: str) -> Tail:
    """Where a session ends, read from the record."""
    end = load_count(connection, session_id)
    next_event = select(func.coalesce(func.max(events.c.number) + 1, 0)).where(events.c.session_id == session_id)
    tail = Tail(end.lines, end.points, connection.execute(next_event).scalar_one())
    index = lines.c.line_index
    boots = connection.execute(
        select(lines.c.device_id, lines.c.boot_id, func.max(index), func.min(index), func.count())
        .where(lines.c.session_id == session_id)
        .group_by(lines.c.device_id, lines.c.boot_id)
        .order_by(func.max(lines.c.line_number))
    )
    for device, boot, highest, first, count in boots:
        tail.marks[device, boot] = Watermark(boot, highest, first, count)
        tail.latest_boot[device] = boot
    return tail


def load_count(connection: Connection, session_id: str) -> Count:
    """Lines and points of a session, told by its last sound line and checked against the number of keys.

    The two come out of different indexes, and a line that fails its checksum is not believed: a flipped bit neither
    makes the end of a session vanish silently nor puts it beyond all bounds.
    """
    keys = select(func.count(lines.c.line_index)).where(lines.c.session_id == session_id)
    count = int(connection.execute(keys).scalar_one())
    last = select(lines).where(lines.c.session_id == session_id).order_by(lines.c.line_number.desc())
    with connection.execution_options(stream_results=True).execute(last.limit(_LOOK_BACK_LINES)) as rows:
        for damaged, row in enumerate(rows.mappings()):
            if row["crc32"] == row_crc(dict(row)):
                after = row["line_number"] + 1 + damaged
                return Count(max(after, count), row["points_before"] + row["points"])
    return Count(count, 0)
