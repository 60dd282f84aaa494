"""Scripts over a decoder, at one of several rates: saying, hearing, waiting; knows no protocol, no port, no clock.

Bytes to be sent are left in `outgoing`, the rate and DTR wanted in `baud_rate` and `dtr`; whoever drives the port looks
after every byte that came.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, Protocol, TypeVar

from drivers.errors import ScannerError, ScannerSilent, ScannerTimeout
from drivers.protocols.dialogue import Dialogue, Pause, Script
from drivers.protocols.framing import Damage, DamageReason

_Found = TypeVar("_Found")


class Decoder(Protocol):
    """Bytes in, items and Damage out."""

    def receive(self, data: bytes) -> Sequence[Any]:
        """What these bytes complete."""

    def reset(self) -> int:
        """Forget what has begun; return how many bytes that were."""


class Talk(ABC):
    """One end of a wire: one script at a time, and items that no script waits for.

    Parameters
    ----------
    decoder : understands the device's bytes.
    advise : takes a sentence that the user should know.
    rates : baud rates to try, the likeliest first.
    """

    break_after_s: float | None = None
    """A pause inside a frame after which its rest will not come; None where a frame says itself where it ends."""

    def __init__(self, decoder: Decoder, advise: Callable[[str], None], rates: tuple[int, ...]) -> None:
        if not rates or min(rates) <= 0:
            raise ValueError(f"baud rates must be greater than 0, not {rates}")
        self.outgoing = bytearray()
        self.baud_rate = rates[0]
        """What the port is to be set to now."""
        self.dtr: bool | None = None
        """How DTR is to stand now; None leaves it."""
        self.heard_bytes = 0
        self._decoder = decoder
        self._advise = advise
        self._rates = rates
        self._heard_s = 0.0
        self._answered_at: int | None = None  # the rate at which somebody answered last
        self._dialogue: Dialogue | None = None

    # ---- what a protocol brings -------------------------------------------------------------------------------------

    @abstractmethod
    def _nobody(self, tried: str, *, heard: bool) -> str:
        """One sentence on why nobody was met at the rates `tried`; `heard` tells whether anything came at all."""

    @abstractmethod
    def _damage(self, damage: Damage) -> None:
        """Take a damaged piece of the stream."""

    @abstractmethod
    def _unasked(self, item: Any, now_s: float) -> None:
        """Take an item that no script waited for."""

    def _poll(self, now_s: float) -> None:  # noqa: B027 - only some protocols have to ask again and again
        """Do what is due by now."""

    def _decode(self, data: bytes, now_s: float) -> Sequence[Any]:
        """Items and Damage that these bytes complete."""
        return self._decoder.receive(data)

    def _reset_decoder(self) -> list[Damage]:
        """Forget what has begun; return it as damage."""
        n_bytes = self._decoder.reset()
        return [Damage(DamageReason.CUT_OFF, n_bytes)] if n_bytes else []

    def _break_off(self) -> Sequence[Any]:
        """What can be understood when the rest of the frame under way will not come; the decoder may keep nothing."""
        return ()

    # ---- the wire ---------------------------------------------------------------------------------------------------

    def receive(self, data: bytes, now_s: float) -> None:
        """Take bytes from the device."""
        if not data:
            return
        self.heard_bytes += len(data)
        if self._dialogue is not None:
            self._dialogue.heard(now_s)
        self._heard_s = now_s
        self._hear(self._decode(data, now_s), now_s)

    def tick(self, now_s: float) -> None:
        """Do what is due by now."""
        if self.break_after_s is not None and now_s - self._heard_s > self.break_after_s:
            self._hear(self._break_off(), now_s)
        if self._dialogue is not None:
            self._dialogue.tick(now_s)
        self._poll(now_s)

    def _hear(self, items: Sequence[Any], now_s: float) -> None:
        for item in items:
            if isinstance(item, Damage):
                self._damage(item)
            elif not (self._dialogue is not None and self._dialogue.offer(item, now_s)):
                self._unasked(item, now_s)

    # ---- for the scripts --------------------------------------------------------------------------------------------

    def _say(self, data: bytes) -> None:
        self.outgoing += data

    def _run(
        self,
        script: Script[Any],
        now_s: float,
        done: Callable[[Any, float], None],
        failed: Callable[[ScannerError, float], None],
    ) -> None:
        """Run a script instead of the one that runs; one of the two is told of its end."""
        self._abandon_dialogue()

        def is_done(result: object, at_s: float) -> None:
            self._dialogue = None
            done(result, at_s)

        def has_failed(error: ScannerError, at_s: float) -> None:
            self._dialogue = None
            failed(error, at_s)

        self._dialogue = dialogue = Dialogue(script, now_s, is_done, has_failed)
        dialogue.begin(now_s)

    def _abandon_dialogue(self) -> None:
        dialogue, self._dialogue = self._dialogue, None
        if dialogue is not None:
            dialogue.abandon()

    def _find_rate(self, meet: Callable[[], Script[_Found | None]]) -> Script[_Found]:
        """Try the rates one after the other, the present one first, until `meet` brings something.

        A rate at which somebody has answered before is tried again between the others: on a link that came back an
        answer may be lost, and all the other rates take long.

        Raises
        ------
        ScannerSilent : it never does.
        """
        before = self.heard_bytes
        first, *others = dict.fromkeys((self.baud_rate, *self._rates))
        likely = () if self._answered_at is None else (self._answered_at,)
        for rate in (first, *(rate for other in others for rate in (other, *likely))):
            self.baud_rate = rate
            found = yield from meet()
            if found:
                self._answered_at = rate
                return found
        tried = ", ".join(map(str, dict.fromkeys(self._rates)))
        raise ScannerSilent(self._nobody(tried, heard=self.heard_bytes > before))

    def _settle_at(self, new: int, old: int, meet: Callable[[], Script[bool]]) -> Script[None]:
        """The device has agreed to a new rate: go there, and back where it cannot be understood.

        Raises
        ------
        ScannerTimeout : it answers at neither rate.
        """
        for rate in (new, old):
            self.baud_rate = rate
            yield Pause(0.05)
            if (yield from meet()):
                self._answered_at = rate
                if rate == old:
                    self._advise(f"the scanner agreed to {new} baud and cannot be understood there; it stays at {old}")
                return
        raise ScannerTimeout(f"the scanner went to {new} baud and does not answer any more; switch it off and on")
