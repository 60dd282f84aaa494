"""The account of the profiles of a scanner that runs free: numbered here, since its wire does not; knows no protocol.

Every profile that the device is known to have made has a number, also the lost ones; numbers never go back.
"""

from drivers.boot_ledger import BootLedger, Kind
from drivers.protocols.framing import Damage
from drivers.tally import Tally

_U32 = 1 << 32
_MAX_SKIP = 1 << 30  # a gap that is said to be longer is no gap but nonsense


class ProfileAccount:
    """Numbers profiles and books what became of them, on the pass that runs; `boot_id` names it in the record."""

    def __init__(self, boot_id: int) -> None:
        self.pass_index = 0
        """The pass that runs, or ran last; 0 before the first."""
        self._ledger = BootLedger(boot_id=boot_id)
        self._next_line = 0
        self._dropped = 0
        self._timed_s = 0.0
        self._timed_pass = 0
        self._is_torn = False  # since the last profile bytes were damaged, or the link was down

    @property
    def latest_line(self) -> int:
        """The number of the profile that was entered last."""
        return self._next_line - 1

    def begin_pass(self) -> None:
        """A new pass begins."""
        self.pass_index += 1

    def end_pass(self) -> None:
        """The pass is over: what is known to be lost is booked on it, what is lost later on the next one."""
        number = self._next_line % _U32
        self._ledger.totals(number, number, self._dropped, self._dropped, self.pass_index, True)

    def lost(self, n_lines: int) -> None:
        """Profiles that the device made and that did not arrive; their reason is what happened on the wire."""
        self._next_line += min(max(n_lines, 0), _MAX_SKIP)

    def lost_by_time(self, device_time_s: float, period_s: float) -> int:
        """Enter the profiles that are missing before one of `device_time_s`, of a scanner that makes one a period.

        Return how many of them the device did not send. Those are told from the ones that the wire lost: a wire that
        loses anything leaves a torn end, so that a gap between two sound neighbours is the device's own.
        """
        n_lines = 0
        if self._timed_pass == self.pass_index:
            n_lines = max(0, round((device_time_s - self._timed_s) / period_s) - 1)
            self.lost(n_lines)
        self._timed_s, self._timed_pass = device_time_s, self.pass_index
        return 0 if self._is_torn else n_lines

    def enter(self, dropped_lines: int = 0) -> bool:
        """Enter the next profile; `dropped_lines` of those lost so far the device dropped itself."""
        number, self._dropped = self._next_line % _U32, dropped_lines % _U32
        self._next_line += 1
        self._is_torn = False
        return self._ledger.chunk(number, number, self._dropped, self._dropped, self.pass_index).kind is Kind.NEW

    def handed_on(self, no_return: dict[str, int], *, whole: bool) -> None:
        """The profile entered last was taken; `no_return` counts its points without a distance, by reason."""
        self._ledger.line_closed(whole=whole)
        self._ledger.no_return(no_return)

    def not_taken(self) -> None:
        """The profile entered last found no room."""
        self._ledger.line_not_kept("host_overflow", 1)

    def damage(self, damage: Damage) -> None:
        """Enter a damaged piece of the stream."""
        self._is_torn = True
        self._ledger.damage(damage.reason.value, damage.n_bytes)

    def link_lost(self) -> None:
        """Enter that the link is down: what is lost until the next profile is lost by that."""
        self._is_torn = True
        self._ledger.link_lost()

    def tally(self) -> Tally:
        """The accounts so far."""
        return self._ledger.tally()
