"""How commands speak to a person or a program: progress, tables, JSON, one plain sentence for an error."""

import contextlib
import json
import math
import os
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from pathlib import Path
from typing import Any, NoReturn, TextIO

import httpx
import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from drivers.errors import DriverError
from scanner_service.analysis.errors import AnalysisError
from scanner_service.api.answers import plain
from scanner_service.api.keys import KeyStoreError
from scanner_service.api.server import ServerError
from scanner_service.sessions.errors import SessionError
from scanner_service.storage.errors import RecordError
from scanner_service.storage.exports.errors import ExportError
from scanner_service.storage.formats.errors import FormatError

_UNWRAPPED = 10_000


def paper(stream: TextIO, environment: Mapping[str, str]) -> Console:
    """A console on a terminal as wide as that is; in a file or a pipe nothing is wrapped or cut.

    `COLUMNS` in the environment says how wide it is to be.
    """
    is_seen = stream.isatty() or "COLUMNS" in environment
    return Console(file=None if stream in (sys.stdout, sys.stderr) else stream, stderr=stream is sys.stderr,
                   width=None if is_seen else _UNWRAPPED, markup=False, emoji=False, _environ=environment)  # fmt: skip


# What is told may hold brackets and colons: paths, names, extras of a package, usb:VID:PID.
console = paper(sys.stdout, os.environ)
errors = paper(sys.stderr, os.environ)
_MADE: ContextVar[tuple[Path, ...]] = ContextVar("folders that the command has made", default=())
_UNWANTED = {"outside_pass", "between_stops", "before_start"}
"""Reasons of lines that a scanner made while its stage turned or went to the next stop: no loss."""
_NOT_READ = {"host_overflow", "overflow", "queue_full"}
"""Reasons of lines that came, and that this computer had no time for."""

EXPECTED = (
    httpx.HTTPError,
    AnalysisError,
    DriverError,
    KeyStoreError,
    ServerError,
    SessionError,
    RecordError,
    ExportError,
    FormatError,
    OSError,
    ValueError,
)


def fail(sentence: str) -> NoReturn:
    """End with one plain sentence and status 1."""
    errors.print(sentence, style="bold red", highlight=False, soft_wrap=True)
    raise typer.Exit(1)


@contextlib.contextmanager
def plain_errors() -> Iterator[None]:
    """Tell what users can mend in one sentence; let faults of the program show themselves."""
    before = _MADE.set(())
    try:
        yield
    except httpx.TimeoutException:
        fail("the service did not answer in time: the computer is too busy; what it was asked for may be done yet")
    except EXPECTED as error:
        fail(str(error) or type(error).__name__)
    except KeyboardInterrupt:
        errors.print("Stopped; what was not yet written is gone.")
        raise typer.Exit(130) from None
    finally:
        _remove_empty(_MADE.get())
        _MADE.reset(before)


def check_folder(folder: Path) -> None:
    """Make the folder for results if need be, and make sure before any work that files can be written there.

    Folders made here that are still empty when the command ends are removed again.
    """
    made = [each for each in (folder, *folder.parents) if not each.exists()]
    _MADE.set((*_MADE.get(), *made))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        fail(f"no file can be written to {folder} ({error.strerror}): choose another folder with --out")


def _remove_empty(folders: tuple[Path, ...]) -> None:
    """Remove the folders, the innermost first, as far as they are empty."""
    for folder in folders:
        with contextlib.suppress(OSError):
            folder.rmdir()


def show_json(value: Any) -> None:
    """Print a result for programs: NaN is null."""
    sys.stdout.write(json.dumps(plain(value), indent=2, allow_nan=False) + "\n")


@contextlib.contextmanager
def scan_progress(title: str, quiet: bool = False) -> "Iterator[ScanProgress]":
    """A progress bar with lines, points/s, coverage and losses; on standard error, so that results stay clean."""
    bar = Progress(
        TextColumn("[bold]{task.description}"),
        BarColumn(bar_width=24),
        TextColumn("{task.percentage:>3.0f}%"),
        TextColumn("{task.fields[facts]}"),
        TimeElapsedColumn(),
        console=errors,
        disable=quiet,
        refresh_per_second=5,
    )
    with bar:
        yield ScanProgress(bar, title, quiet)


class ScanProgress:
    """The bar of one scan; on something that is no terminal a line is printed now and then instead."""

    def __init__(self, bar: Progress, title: str, quiet: bool) -> None:
        self._bar = bar
        self._task = bar.add_task(title, total=1.0, facts="")
        self._is_terminal = errors.is_terminal
        self._quiet = quiet
        self._printed = -1.0

    def show(self, status: Mapping[str, Any]) -> None:
        """Show a status as the API gives it."""
        coverage = status["coverage"]
        done = status["progress"] or 0.0
        if coverage is None or math.isnan(coverage):
            share = "coverage –"
        elif status.get("coverage_kind", "observed") == "reference":
            share = f"coverage of the nominal part {coverage:.1%}"
        else:  # while a scan is under way nobody knows of the surface that is still to come
            share = f"{'coverage so far' if done < 1.0 else 'observed coverage'} {coverage:.1%}"
        losses = status["losses"]
        facts = (
            f"{status['lines']:,} lines  {status['points_per_s']:,.0f} points/s  {share}  "
            f"{lost_lines(losses):,} lines lost, {partial_lines(losses):,} partial"
        )
        self._bar.update(self._task, completed=done, facts=facts)
        if not self._is_terminal and not self._quiet and done >= self._printed + 0.2:
            self._printed = done
            errors.print(f"{done:4.0%}  {facts}", highlight=False, soft_wrap=True)


@contextlib.contextmanager
def work_progress(title: str, quiet: bool = False) -> "Iterator[WorkProgress]":
    """A bar for work of several steps; on standard error, and silent on something that is no terminal."""
    bar = Progress(
        TextColumn("[bold]{task.description}"),
        BarColumn(bar_width=24),
        TextColumn("{task.percentage:>3.0f}%"),
        TimeElapsedColumn(),
        console=errors,
        disable=quiet or not errors.is_terminal,
        refresh_per_second=5,
    )
    with bar:
        yield WorkProgress(bar, title)


class WorkProgress:
    """The bar of one piece of work, which says what is being done."""

    def __init__(self, bar: Progress, title: str) -> None:
        self._bar = bar
        self._title = title
        self._task = bar.add_task(title, total=1.0)

    def show(self, what: str, share: float) -> None:
        """Show what is being done, and the share of it that is done."""
        self._bar.update(self._task, completed=share, description=f"{self._title}: {what}")


@contextlib.contextmanager
def waiting_for(said: str) -> Iterator[Callable[[str], None]]:
    """Say what is being waited for, and what next, on standard error: on a terminal as long as it lasts.

    On something that is no terminal each is a line of its own, once.
    """
    told = said

    def say(now: str) -> None:
        nonlocal told
        if now != told and not errors.is_terminal:
            errors.print(now, highlight=False, soft_wrap=True)
        told = now
        shown.update(now)

    if not errors.is_terminal:
        errors.print(said, highlight=False, soft_wrap=True)
    with errors.status(said) as shown:
        yield say


def lost_lines(losses: Mapping[str, Any]) -> int:
    """Lines of all passes that were sent and wanted, and are not stored: by the device, on the wire, or here."""
    return sum(_lost(losses["passes"]).values())


def partial_lines(losses: Mapping[str, Any]) -> int:
    """Lines of all passes that are stored and lack a piece."""
    return sum(int(account["lines"]["partial"]) for account in losses["passes"])


def loss_sentence(losses: Mapping[str, Any]) -> str:
    """What was lost in all passes, by reason, and what helps where it is known."""
    passes = losses["passes"]
    lost, partial = _lost(passes), partial_lines(losses)
    chunks: Counter[str] = Counter()
    for account in passes:
        chunks.update((account["chunks"] or {}).get("lost", {}))
    if not (lost or partial or chunks.total()):
        return "No scanline was lost, and none is partial."
    sent = sum(int(account["lines"]["sent"]) for account in passes)
    sent_chunks = sum(int((account["chunks"] or {}).get("sent", 0)) for account in passes)
    said = [f"of {sent:,} scanlines {partial:,} are partial", f"{lost.total():,} lost{_by_reason(lost)}"]
    if chunks.total():
        said.append(f"of {sent_chunks:,} chunks {chunks.total():,} were lost{_by_reason(chunks)}")
    return " ".join((f"Losses: {', '.join(said)}.", *_advice({*lost, *chunks}, losses.get("device") or {})))


def _advice(reasons: set[str], device: Mapping[str, Any]) -> Iterator[str]:
    """What helps, by what was counted: a scanner drops what its wire does not carry, and what nobody reads."""
    late, dropped = device.get("late_reads", 0), "device_dropped" in reasons
    carried_hz = device.get("wire_line_rate_hz")
    wire_has_time = carried_hz is not None and device["line_rate_hz"] <= carried_hz
    if dropped and not wire_has_time:
        yield "The scanner measured more than its wire carries: a slower pass or a lower line rate helps."
    elif dropped and not late:
        yield "The scanner dropped lines that its wire has time for: a slower pass or a lower line rate helps."
    if reasons & _NOT_READ or "uart_overrun" in device.get("damage", {}) or (dropped and late):
        often = "once" if late == 1 else f"{late:,} times"
        when = f" (late {often}, by up to {device['largest_pause_s']:.1f} s)" if late else ""
        yield f"This computer was too busy to read in time what came{when}: close other programs, or scan more slowly."


def _lost(passes: Iterable[Mapping[str, Any]]) -> "Counter[str]":
    total: Counter[str] = Counter()
    for account in passes:
        total.update({reason: n for reason, n in account["lines"]["lost"].items() if n and reason not in _UNWANTED})
    return total


def _by_reason(lost: Mapping[str, int]) -> str:
    told = ", ".join(f"{count:,} {reason.replace('_', ' ')}" for reason, count in sorted(lost.items()) if count)
    return f" ({told})" if told else ""


def tell_regions(regions: Sequence[Mapping[str, Any]]) -> None:
    """The rescan regions as people read them: a table that fits a narrow terminal, and below it what helps, uncut."""
    table = Table(title="Rescan regions", title_justify="left")
    table.add_column("#", justify="right")
    table.add_column("reason", no_wrap=True)
    for name in ("area mm²", "has", "needs", "priority"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("status", no_wrap=True)
    for region in regions:
        table.add_row(
            str(region["number"]),
            str(region["reason"]).replace("_", " "),
            f"{region['area_mm2']:.1f}",
            *_missed(region),
            f"{region['priority']:.2f}",
            str(region["status"]),
        )
    if not regions:
        console.print("No region needs another scan.")
        return
    console.print(table)
    for remedy in dict.fromkeys(str(region["remedy"]) for region in regions):
        named = ", ".join(str(region["number"]) for region in regions if region["remedy"] == remedy)
        console.print(f"{named}: {remedy}", highlight=False, soft_wrap=True)


def _missed(region: Mapping[str, Any]) -> tuple[str, str]:
    """What a region has and what it needs, by the limit that it misses; by its density where no other is known."""
    limit = region.get("limit")
    if limit is None:
        return f"{_number(region['measured_per_mm2'])} /mm²", f"≥ {_number(region['required_per_mm2'])} /mm²"
    return str(limit["has"]), str(limit["needs"])


def _number(value: float | None) -> str:
    return "–" if value is None or math.isnan(value) else f"{value:.3g}"
