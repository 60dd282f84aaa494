"""What a live session is called, and what is asked of it: the one owner of its row; knows no verdict.

Whatever changes is durable before it is here, and touches what is its own. Whoever asks for something else waits for
those who did so before; nobody else ever waits for a disk here.
"""

import itertools
import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from scanner_service.rescan.requirement import Requirement
from scanner_service.sessions.references import Nominal
from scanner_service.sessions.settings import SessionSettings
from scanner_service.storage.formats.reference_mesh import ReferenceSpec
from scanner_service.storage.record import Record
from scanner_service.storage.rows import SessionRow


class Terms:
    """The row of one session as it is now.

    `judge` is called with what is asked for from now on, and with what has changed: by name, before and now.
    """

    def __init__(
        self,
        row: SessionRow,
        record: Record,
        nominal: Nominal,
        judge: Callable[[SessionSettings, Nominal, dict[str, Any]], None],
    ) -> None:
        self._record = record
        self._judge = judge
        self._asking = threading.Lock()  # the turn of whoever asks for something else
        self._row = row
        self._settings = SessionSettings.from_dict(row.settings)
        self._nominal = nominal
        self._lock = threading.Lock()  # of the row
        self._readings = itertools.count(1)
        self._latest_reading = 0

    @property
    def row(self) -> SessionRow:
        """As it is in the record, but for the state, which the session's course has."""
        return self._row

    @property
    def settings(self) -> SessionSettings:
        """What the row says of them."""
        return self._settings

    def read_again(self) -> None:
        """Name and notes were changed in the record: take them over.

        Of several readings the one that began last counts: each change was durable before its own began.
        """
        number = next(self._readings)
        now = self._record.get_session(self._row.session_id)
        with self._lock:
            if number > self._latest_reading:
                self._latest_reading = number
                self._row = replace(self._row, name=now.name, notes=now.notes)

    def judge_by(self, requirement: Requirement) -> None:
        """Ask for something else from now on: what was scanned already is judged anew before this returns.

        Raises
        ------
        RequirementUnusable : it contradicts itself, or the scanner's noise; what was asked for before stays.
        RecordError : the record does not take it; what was asked for before stays.
        TimeoutError : the record does not answer yet; what was asked for before stays until the session is reopened.
        """
        with self._asking:
            self._ask_for(replace(self._settings, target=requirement), self._nominal)

    def measure_against(self, spec: ReferenceSpec | None, nominal: Nominal) -> None:
        """Measure coverage against another nominal part from now on, None against the surface seen; as `judge_by`."""
        with self._asking:
            self._ask_for(replace(self._settings, reference=spec), nominal)

    def _ask_for(self, settings: SessionSettings, nominal: Nominal) -> None:
        before, now = self._settings.to_dict(), settings.to_dict()
        self._record.change_settings(self._row.session_id, now)  # durable first: it outlasts us
        with self._lock:
            self._row = replace(self._row, settings=now)
            self._settings, self._nominal = settings, nominal
        changed = {name: {"before": before[name], "now": now[name]} for name in now if now[name] != before[name]}
        self._judge(settings, nominal, changed)
