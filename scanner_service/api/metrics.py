"""The service's counters as Prometheus asks for them, read from the sessions' ledgers; counts nothing itself."""

from collections.abc import Iterator

from prometheus_client import CollectorRegistry
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from scanner_service.sessions.book import SessionBook


class _SessionCollector(Collector):
    def __init__(self, book: SessionBook) -> None:
        self._book = book

    def collect(self) -> Iterator[Metric]:
        """One family a subject; sessions that nobody holds open are not in it."""
        lines = CounterMetricFamily(
            "scanner_lines", "Scanlines by session and what became of them", labels=["session", "outcome"]
        )
        points = CounterMetricFamily(
            "scanner_points", "Points by session and what became of them", labels=["session", "outcome"]
        )
        states = GaugeMetricFamily(
            "scanner_session_state", "1 for the state a session is in", labels=["session", "state"]
        )
        for session in self._book.open_sessions():
            name = session.row.session_id
            ledger = session.engine.ledger.to_dict()
            for outcome in ("stored", "duplicates", "conflicts"):
                lines.add_metric([name, outcome], ledger["lines"][outcome])
            for reason, count in ledger["lines"]["refused"].items():
                lines.add_metric([name, f"refused_{reason}"], count)
            points.add_metric([name, "counted"], ledger["points"]["counted"])
            for kind in ("dropped", "left_out"):
                for reason, count in ledger["points"][kind].items():
                    points.add_metric([name, reason], count)
            states.add_metric([name, session.state], 1)
        writer = self._book.record.writer_state()
        waiting = GaugeMetricFamily(
            "scanner_record_waiting_lines", "Lines taken and not yet durable", writer.waiting_lines
        )
        stored = CounterMetricFamily("scanner_record_stored_lines", "Lines made durable", writer.stored)
        refused = CounterMetricFamily("scanner_record_refused_lines", "Lines the record did not take", writer.refused)
        yield from (lines, points, states, waiting, stored, refused)


def metrics_of(book: SessionBook) -> CollectorRegistry:
    """A registry that reads the book whenever it is asked."""
    registry = CollectorRegistry()
    registry.register(_SessionCollector(book))
    return registry
