"""What a rig may ask of any scanner, whatever its protocol; knows no device.

Two kinds of scanner exist. One with a *stage of its own* (the native protocol) runs a pass from a start to an end and
tells the stage position with each line. One that *runs free* (all others) measures as long as it is told to, and its
profiles have `position_mm = NaN`: where the stage was is the rig's business.
"""

from types import TracebackType
from typing import Protocol, Self, TypeAlias

from drivers.protocols.scanner_events import ScannerEvent
from drivers.scanline import DeviceInfo, Profile
from drivers.tally import Tally

Happening: TypeAlias = Profile | ScannerEvent


class Scanner(Protocol):
    """One scanner on one port. A thread of its own reads it and never waits for whoever fetches `events`."""

    def enter(self) -> DeviceInfo:
        """Open the port, end what an earlier program left running, and ask who is there; raises a DriverError."""

    def events(self, timeout_s: float) -> list[Happening]:
        """Profiles and events since the last call, in order; waits at most `timeout_s` for the first.

        Raises what ended the reading thread, once nothing is left to fetch.
        """

    def tally(self) -> Tally:
        """The exact accounts since `enter`: sent, stored, lost by reason."""

    @property
    def laser_on(self) -> bool | None:
        """The device's last word on its laser; None is unknown, and to be shown as on."""

    @property
    def is_connected(self) -> bool:
        """True while the device answers."""

    def exit(self) -> None:
        """Stop, switch the laser off, close the port; never raises, idempotent."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


class FreeRunningScanner(Scanner, Protocol):
    """A scanner without a stage: profiles in the sensor frame from `start_profiles` to `stop_profiles`.

    `device_time_s` of its profiles is the device's own clock, unwrapped, beginning anywhere (arrival time for a device
    without a clock); `line_index` counts every profile that the device is known to have made, also lost ones, and never
    goes back within `boot_id`, which is drawn at `enter`. `line_spacing_mm` and `step_mm` are NaN.
    """

    @property
    def baud_rate(self) -> int | None:
        """The rate at which the device answers; None before `enter`."""

    def start_profiles(self, *, resume: bool = True) -> int:
        """Switch the laser on and begin; return the pass index.

        With `resume` a link that comes back goes on measuring by itself (the laser is then switched on again);
        without it, and after `stop_profiles`, the laser stays off. Raises a DriverError when the device does not do it.
        """

    def stop_profiles(self) -> None:
        """Stop and switch the laser off; returns when the last profiles and `PassEnded` are in `events`."""
