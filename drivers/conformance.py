"""The contract of drivers, as checks that a third party can run against its own scanner or stage; knows no device.

    from drivers.conformance import check_stage
    check_stage(lambda: my_package.open_stage(setup), span_mm=(0.0, 20.0))

Each check runs against the real device, or a simulator of it, and moves it within `span_mm`. All laws are tried; the
broken ones are told together. `docs/devices/plugins.md` is the contract in words.
"""

import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import numpy as np

from drivers.errors import DriverError, StageError, StageLimit, StagePositionUnknown, StageRefused, StageStopped
from drivers.protocols.scanner_events import PassEnded
from drivers.scanline import Profile
from drivers.scanners.face import FreeRunningScanner
from drivers.stages.face import DrivenStage

_PATIENCE_S = 60.0
_TOO_FAR_MM = 1e7


class ContractBroken(DriverError):
    """A driver does not keep the contract; `laws` are those it broke, one sentence each."""

    def __init__(self, laws: list[str]) -> None:
        self.laws = laws
        super().__init__("the driver breaks its contract:" + "".join(f"\n  - {law}" for law in laws))


class _Laws:
    """Which laws were kept and which were not."""

    def __init__(self) -> None:
        self.kept: list[str] = []
        self.broken: list[str] = []

    def hold(self, law: str, holds: bool, seen: object = "") -> None:
        """Note whether a law holds, and what was seen where it does not."""
        if holds:
            self.kept.append(law)
        else:
            self.broken.append(f"{law}; seen: {seen}" if seen != "" else law)

    @contextmanager
    def refused(self, law: str, *kinds: type[Exception]) -> Iterator[None]:
        """Note whether what is done inside is refused by an error of these kinds."""
        try:
            yield
        except kinds:
            self.kept.append(law)
        except Exception as error:  # noqa: BLE001 - a driver under test may raise anything; that is the finding
            self.broken.append(f"{law}; it raised {error!r}")
        else:
            self.broken.append(f"{law}; it was done")

    def finish(self) -> list[str]:
        """Return the laws that were kept; raise ContractBroken when one was not."""
        if self.broken:
            raise ContractBroken(self.broken)
        return self.kept


def check_stage(
    make: Callable[[], DrivenStage], span_mm: tuple[float, float], speed_mm_per_s: float = 10.0
) -> list[str]:
    """Run a stage through its contract; return the laws that were checked.

    Parameters
    ----------
    make : returns a driver that is not entered; called once. Its position must not be known before it homes.
    span_mm : two places at least 5 mm apart that the axis may go to.
    speed_mm_per_s : how fast.

    Raises
    ------
    ContractBroken : with all laws that do not hold.
    """
    laws = _Laws()
    threads, descriptors = threading.active_count(), _open_descriptors()
    stage = make()
    a_mm, b_mm = span_mm
    try:
        info = stage.enter()
        laws.hold("enter returns an identity", bool(info.identity))
        if not stage.position_known:
            with laws.refused("no motion while the position is unknown", StagePositionUnknown):
                stage.start_move(a_mm, speed_mm_per_s)
        stage.home()
        laws.hold("the position is known after homing", stage.position_known)
        _check_moves(stage, laws, a_mm, b_mm, speed_mm_per_s)
        _check_stop(stage, laws, a_mm, speed_mm_per_s)
        stage.exit()
        stage.exit()
        laws.hold("exit can be repeated", True)
        stage.enter()
        laws.hold("a driver can be entered again", True)
    finally:
        stage.exit()
    _check_nothing_left(laws, threads, descriptors)
    return laws.finish()


def _check_moves(stage: DrivenStage, laws: _Laws, a_mm: float, b_mm: float, speed: float) -> None:
    for target in (_TOO_FAR_MM, -_TOO_FAR_MM, math.nan, math.inf):
        with laws.refused(f"a target of {target:g} mm is refused", StageLimit):
            stage.start_move(target, speed)
    for wrong in (0.0, -1.0, math.nan, math.inf):
        with laws.refused(f"a speed of {wrong:g} mm/s is refused", StageLimit):
            stage.start_move(a_mm, wrong)
    stage.readings()
    rest = stage.move_to(a_mm, speed)
    laws.hold("move_to returns where the stage rests", abs(rest.position_mm - a_mm) < 0.1, rest)
    stage.start_move(b_mm, speed)
    laws.hold("finish_move returns None while the stage moves", stage.finish_move(0.0) is None)
    with laws.refused("a second motion is refused while one is under way", StageRefused):
        stage.start_move(a_mm, speed)
    deadline_s = time.monotonic() + _PATIENCE_S
    reading = None
    while reading is None and time.monotonic() < deadline_s:
        reading = stage.finish_move(0.5)
    laws.hold("a motion comes to its end", reading is not None)
    readings = stage.readings()
    asked = [item.asked_s for item in readings]
    laws.hold("readings come in order", asked == sorted(asked))
    laws.hold("a reading was asked for before it arrived", all(r.asked_s <= r.arrived_s for r in readings))
    laws.hold("a moving stage is read on its way", any(r.is_moving for r in readings), f"{len(readings)} readings")
    low, high = sorted((a_mm, b_mm))
    on_way = [r.position_mm for r in readings if r.asked_s >= rest.arrived_s]
    laws.hold("readings lie between start and end", all(low - 0.1 <= p <= high + 0.1 for p in on_way), on_way)
    again = [item.asked_s for item in stage.readings()]
    laws.hold("a reading is handed out once", not set(asked) & set(again))


def _check_stop(stage: DrivenStage, laws: _Laws, a_mm: float, speed: float) -> None:
    ended: list[Exception] = []

    def move() -> None:
        try:
            stage.move_to(a_mm, speed)
        except StageError as error:
            ended.append(error)

    mover = threading.Thread(target=move)
    mover.start()
    deadline_s = time.monotonic() + _PATIENCE_S
    while not any(r.is_moving for r in stage.readings()) and time.monotonic() < deadline_s:
        time.sleep(0.05)
    stage.stop()
    mover.join(_PATIENCE_S)
    laws.hold(
        "whoever waits for a stopped motion is told", len(ended) == 1 and isinstance(ended[0], StageStopped), ended
    )
    stage.readings()
    time.sleep(1.0)
    places = [r.position_mm for r in stage.readings()]
    laws.hold("after a stop the stage rests", bool(places) and max(places) - min(places) < 0.05, places)
    laws.hold("a stop ends the motion on its way", not (places and abs(places[-1] - a_mm) < 0.05), places)


def check_scanner(
    make: Callable[[], FreeRunningScanner], lines: int = 20, *, laser_always_on: bool = False
) -> list[str]:
    """Run a scanner that runs free through its contract; return the laws that were checked.

    Parameters
    ----------
    make : returns a driver that is not entered; called once.
    lines : how many profiles to wait for.
    laser_always_on : True for a scanner whose laser no command switches off; it must then say so, as on or unknown.

    Raises
    ------
    ContractBroken : with all laws that do not hold.
    """
    laws = _Laws()
    threads, descriptors = threading.active_count(), _open_descriptors()
    scanner = make()
    try:
        info = scanner.enter()
        laws.hold("enter says who answers", bool(info.device_id) and info.points_per_line > 0, info)
        if laser_always_on:
            laws.hold("a laser that is always on is never called off", scanner.laser_on is not False)
        else:
            laws.hold("the laser is not on before it is asked for", scanner.laser_on is not True)
        pass_index = scanner.start_profiles()
        profiles, _ = _collect(scanner, lambda found, _: len(found) >= lines)
        laws.hold(f"{lines} profiles come", len(profiles) >= lines, len(profiles))
        scanner.stop_profiles()
        if laser_always_on:
            laws.hold("nor after stopping", scanner.laser_on is not False)
        else:
            laws.hold("the laser is off after stopping", scanner.laser_on is False, scanner.laser_on)
        more, told = _collect(scanner, lambda _, events: any(isinstance(event, PassEnded) for event in events))
        laws.hold("PassEnded is told after stopping", any(isinstance(event, PassEnded) for event in told))
        _check_profiles(laws, [*profiles, *more], pass_index)
        tally = scanner.tally()
        laws.hold("sent = stored + lost, in lines", tally.lines.balances, tally.lines)
        laws.hold("sent = stored + lost, in chunks", tally.chunks.balances, tally.chunks)
        laws.hold(
            "every profile handed out is accounted for", tally.lines.stored == len(profiles) + len(more), tally.lines
        )
        scanner.exit()
        scanner.exit()
        laws.hold("exit can be repeated", True)
        scanner.enter()
        laws.hold("a driver can be entered again", True)
    finally:
        scanner.exit()
    _check_nothing_left(laws, threads, descriptors)
    return laws.finish()


def _check_profiles(laws: _Laws, profiles: list[Profile], pass_index: int) -> None:
    indices = [profile.line_index for profile in profiles]
    times = [profile.device_time_s for profile in profiles]
    laws.hold("profiles belong to the pass", all(profile.pass_index == pass_index for profile in profiles))
    laws.hold("line indices grow", all(a < b for a, b in pairwise(indices)), indices[:10])
    laws.hold("device times do not run backwards", times == sorted(times), times[:10])
    laws.hold("the device's clock runs", len(set(times)) > 1)
    laws.hold("a scanner that runs free knows no position", all(math.isnan(p.position_mm) for p in profiles))
    laws.hold("x and z are float64 of one length", all(p.x_mm.dtype == p.z_mm.dtype == np.float64 for p in profiles))
    laws.hold("arrays are read-only", not any(p.x_mm.flags.writeable or p.z_mm.flags.writeable for p in profiles))
    both = all(bool((np.isnan(p.x_mm) == np.isnan(p.z_mm)).all()) for p in profiles)
    laws.hold("a place without a return is NaN in x and in z", both)
    laws.hold("nothing is infinite", not any(np.isinf(p.x_mm).any() or np.isinf(p.z_mm).any() for p in profiles))


def _collect(
    scanner: FreeRunningScanner, enough: Callable[[list[Profile], list[object]], bool]
) -> tuple[list[Profile], list[object]]:
    profiles: list[Profile] = []
    told: list[object] = []
    deadline_s = time.monotonic() + _PATIENCE_S
    while not enough(profiles, told) and time.monotonic() < deadline_s:
        for happening in scanner.events(0.1):
            if isinstance(happening, Profile):
                profiles.append(happening)
            else:
                told.append(happening)
    return profiles, told


def _check_nothing_left(laws: _Laws, threads: int, descriptors: int) -> None:
    laws.hold("no thread is left after exit", threading.active_count() <= threads, threading.enumerate())
    laws.hold("no descriptor is left after exit", _open_descriptors() <= descriptors)


def _open_descriptors() -> int:
    folder = Path("/proc/self/fd")
    return len(list(folder.iterdir())) if folder.is_dir() else 0
