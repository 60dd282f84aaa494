"""The analyst of one session: the thread that reads the map every second, and judges as often as its share allows."""

import logging
import threading
import time
from collections.abc import Callable

from scanner_service.sessions.cadence import Cadence

_LOG = logging.getLogger(__name__)
ANALYSIS_PERIOD_S = 1.0
"""The map is read about this often during a scan; regions are looked for as often as `Cadence` allows."""


class Analyst:
    """A thread that goes round until `closing` is set; `failure` says why its last round came to nothing, if it did.

    Each round it calls `keep_account`, then `judge` when its share of a core allows, `read_map` when not; `lines_wait`
    tells whether scanlines are waiting meanwhile.
    """

    def __init__(
        self,
        session_id: str,
        closing: threading.Event,
        now_s: Callable[[], float],
        keep_account: Callable[[], None],
        read_map: Callable[[], None],
        judge: Callable[[], None],
        lines_wait: Callable[[], bool],
    ) -> None:
        self.failure: str | None = None
        self._session_id = session_id
        self._closing = closing
        self._now_s = now_s
        self._keep_account = keep_account
        self._read_map = read_map
        self._judge = judge
        self._lines_wait = lines_wait
        self._thread = threading.Thread(target=self._run, name=f"analyst-{session_id}", daemon=True)

    def start(self) -> None:
        """Begin to go round."""
        self._thread.start()

    def join(self) -> None:
        """Wait until the last round is over, if there was one."""
        if self._thread.is_alive():
            self._thread.join()

    def _run(self) -> None:
        cadence = Cadence()
        while not self._closing.wait(ANALYSIS_PERIOD_S):
            begun_s, begun_core_s = self._now_s(), time.thread_time()
            is_due = cadence.is_due(begun_s)
            try:
                self._keep_account()
                if is_due:
                    self._judge()
                else:
                    self._read_map()
                self.failure = None
            except Exception as error:  # noqa: BLE001 - the thread's loop: the scan goes on, and its user is told
                _LOG.exception("session %s could not be judged", self._session_id)
                self.failure = f"the scan could not be judged by an internal fault: {error}"
            if is_due:
                core_s = time.thread_time() - begun_core_s
                cadence.ran(begun_s, self._now_s(), core_s, lines_wait=self._lines_wait())
