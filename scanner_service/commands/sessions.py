"""`scanner sessions`: what a running service holds: list, show with the ledger, open, pause, resume, stop, delete."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import httpx
import typer
from rich.box import SIMPLE_HEAD
from rich.progress import BarColumn, Progress, TextColumn
from rich.table import Table

from scanner_service.api.keys import read_local_key
from scanner_service.commands.data_folder import DEFAULT_DATA, Data
from scanner_service.commands.terminal import console, errors, fail, plain_errors, show_json, tell_regions
from scanner_service.commands.until_ready import wait_until_ready
from scanner_service.sessions.named import named_session

_ASKED = {
    "density_per_mm2": "{:g} points/mm²",
    "line_spacing_mm": "lines {:g} mm apart at most",
    "chord_error_mm": "chord error {:g} mm at most",
    "incidence_deg": "incidence {:g}° at most",
    "noise_mm": "noise {:g} mm at most",
    "coverage_share": "coverage {:.1%}",
}
sessions_app = typer.Typer(
    help="The sessions of a running service: list, show with the ledger of losses, open, pause, resume, stop, delete.",
    no_args_is_help=True,
    rich_markup_mode=None,
)
Url = Annotated[str, typer.Option(help="Where the service listens.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the answer as JSON.")]
SessionId = Annotated[str, typer.Argument(help="The session's id, its first letters, or `latest`.")]
WholeId = Annotated[str, typer.Argument(help="The whole id of the session, as `list` shows it.")]
DEFAULT_URL = "http://127.0.0.1:8765"
_POLL_S = 0.1


@contextmanager
def running_service(data: Path, url: str) -> Iterator[httpx.Client]:
    """A client of the running service, with this machine's own key; one that was just started is waited for."""
    key = read_local_key(data)
    if key is None:
        fail(f"there is no key in {data}: start `scanner serve` first, or name its folder with --data")
    with httpx.Client(base_url=url, headers={"Authorization": f"Bearer {key}"}, timeout=120.0) as client:
        try:
            client.get("/healthz")
        except httpx.HTTPError as error:
            fail(f"no service answers at {url} ({error}): start it with `scanner serve`, or say --url")
        wait_until_ready(client)
        yield client


def ask(client: httpx.Client, method: str, path: str, **said: Any) -> Any:
    """The answer of the service; what it refuses is told in its own words."""
    answer = client.request(method, path, **said)
    if answer.is_error:
        fail(f"the service refused: {answer.json().get('detail', answer.status_code)}")
    return answer.json() if answer.content else None


def named(client: httpx.Client, wanted: str) -> str:
    """The whole id of the session that is meant."""

    def ids() -> Iterator[str]:
        after = None
        while True:
            page = ask(client, "GET", "/api/v1/sessions", params={"limit": 1000} | ({"after": after} if after else {}))
            yield from (row["id"] for row in page["sessions"])
            after = page["next"]
            if after is None:
                return

    return named_session(ids(), wanted)


def _path(session_id: str, rest: str = "") -> str:
    if not session_id.isalnum():
        fail(f"{session_id!r} is no session id; `scanner sessions list` shows them")
    return f"/api/v1/sessions/{session_id}{rest}"


@sessions_app.command("list")
def list_command(
    data: Data = DEFAULT_DATA,
    url: Url = DEFAULT_URL,
    limit: Annotated[int, typer.Option(min=1, max=1000, help="At most so many, the newest first.")] = 20,
    as_json: AsJson = False,
) -> None:
    """The sessions, newest first."""
    with plain_errors(), running_service(data, url) as client:
        found = ask(client, "GET", "/api/v1/sessions", params={"limit": limit})["sessions"]
        if as_json:
            show_json(found)
            return
        table = Table(box=SIMPLE_HEAD, pad_edge=False)  # the names alone may take more lines than one
        table.add_column("id", no_wrap=True)
        table.add_column("name", overflow="fold")
        for name in ("state", "created"):
            table.add_column(name, no_wrap=True)
        for name in ("lines", "points"):
            table.add_column(name, justify="right", no_wrap=True)
        for row in found:
            when = row["created"][2:16].replace("T", " ")
            table.add_row(row["id"], row["name"], row["state"], when, f"{row['lines']:,}", f"{row['points']:,}")
        console.print(table)


@sessions_app.command("show")
def show_command(
    session_id: SessionId, data: Data = DEFAULT_DATA, url: Url = DEFAULT_URL, as_json: AsJson = False
) -> None:
    """What a session is doing, and what became of every line of it."""
    with plain_errors(), running_service(data, url) as client:
        session_id = named(client, session_id)
        _open(client, session_id, quiet=as_json)
        status = ask(client, "GET", _path(session_id))
        if as_json:
            show_json(status)
            return
        console.print(
            f"{status['name']}  {status['state']}  {status['lines']:,} lines  {status['points']:,} points  "
            f"{status['points_per_s']:,.0f} points/s",
            highlight=False,
        )
        for text in (status["message"], status["notes"]):
            if text:
                console.print(text, highlight=False)
        if status["coverage"] is not None:
            tell_regions(ask(client, "GET", _path(session_id, "/regions"))["regions"])
        console.print(_requirement_sentence(status), highlight=False, soft_wrap=True)
        tell_ledger(status["losses"]["passes"])


def _requirement_sentence(status: dict[str, Any]) -> str:
    """What is asked for, and whether the coverage asked for is reached."""
    asked = status["requirement"]
    told = [words.format(asked[name]) for name, words in _ASKED.items() if asked[name] is not None]
    if asked["density_per_mm2"] is None:
        told.insert(0, f"{asked['density_share']:.0%} of the lines' own density")
    if asked["interest"] is not None:
        told.append("in a region of interest")
    named = "" if asked["preset"] is None else f"{asked['preset']}: "
    reached = {True: "; it holds", False: f"; it has {status['coverage'] or 0.0:.1%}", None: ""}[status["holds"]]
    return f"Requirement: {named}{', '.join(told)}{reached}"


def tell_ledger(passes: list[dict[str, Any]]) -> None:
    """The ledger as people read it: a row a pass, each of which adds up, and below them what was lost and why."""
    table = Table(title="Ledger, scanlines: sent = stored + under way + lost", title_justify="left")
    table.add_column("scanned pass", no_wrap=True)
    for name in ("sent", "stored", "partial", "under way", "lost"):
        table.add_column(name, justify="right", no_wrap=True)
    boots = {(account["device_id"], account["boot_id"]) for account in passes}
    devices = {device for device, _ in boots}
    reasons = []
    for account in passes:
        lines, chunks = account["lines"], account["chunks"] or {"sent": 0, "lost": {}}
        name = f"{account['device_id']} {account['pass_index']}"
        if len(boots) > len(devices):
            name += f" boot {account['boot_id']}"
        counts = (f"{lines[kind]:,}" for kind in ("sent", "stored", "partial", "under_way"))
        table.add_row(name, *counts, f"{sum(lines['lost'].values()):,}")
        for what, account_of in (("scanlines", lines), ("chunks", chunks)):
            if sum(account_of["lost"].values()):
                told = ", ".join(f"{n:,} {reason.replace('_', ' ')}" for reason, n in account_of["lost"].items() if n)
                reasons.append(f"{name}: of {account_of['sent']:,} {what} lost: {told}")
    console.print(table)
    for reason in reasons:
        console.print(reason, highlight=False, soft_wrap=True)


@sessions_app.command("open")
def open_command(
    session_id: SessionId, data: Data = DEFAULT_DATA, url: Url = DEFAULT_URL, as_json: AsJson = False
) -> None:
    """Reopen a session: its live map is built again from the record, with a progress bar."""
    with plain_errors(), running_service(data, url) as client:
        session_id = named(client, session_id)
        _open(client, session_id, quiet=as_json)
        status = ask(client, "GET", _path(session_id))
        if as_json:
            show_json(status)
        else:
            console.print(f"open: {status['lines']:,} lines, {status['points']:,} points", highlight=False)


def _open(client: httpx.Client, session_id: str, quiet: bool) -> None:
    """Have the session opened, and show how far that is."""
    told = ask(client, "POST", _path(session_id, "/open"))
    bar = Progress(
        TextColumn("opening"),
        BarColumn(bar_width=24),
        TextColumn("{task.percentage:>3.0f}%"),
        TextColumn("{task.fields[facts]}"),
        console=errors,
        disable=quiet,
        transient=True,
    )
    with bar:
        task = bar.add_task("opening", total=1.0, facts="")
        while not told["is_open"]:
            if told["failure"]:
                fail(told["failure"])
            if told["progress"] is not None:
                facts = f"{told['lines']:,} of {told['of']:,} lines"
                bar.update(task, completed=told["progress"], facts=facts)
            time.sleep(_POLL_S)
            told = ask(client, "GET", _path(session_id, "/open"))


def _telling(verb: str, told: str) -> None:
    """A command that asks for one thing and says what state the session is in then."""

    def command(
        session_id: SessionId, data: Data = DEFAULT_DATA, url: Url = DEFAULT_URL, as_json: AsJson = False
    ) -> None:
        with plain_errors(), running_service(data, url) as client:
            status = ask(client, "POST", _path(named(client, session_id), f"/{verb}"))
            if as_json:
                show_json(status)
            else:
                message = f": {status['message']}" if status["message"] else ""
                console.print(f"{status['state']}{message}", highlight=False)

    command.__doc__ = told
    sessions_app.command(verb)(command)


_telling("start", "Begin to scan: the laser of a device is switched on.")
_telling("pause", "Hold a scan: stage and laser stop.")
_telling("resume", "Go on behind the last line: the laser is switched on.")
_telling("stop", "End a scan and judge it.")


@sessions_app.command("note")
def note_command(
    session_id: SessionId,
    text: Annotated[str, typer.Argument(help="What is to be said of the session; replaces what was said before.")],
    data: Data = DEFAULT_DATA,
    url: Url = DEFAULT_URL,
    as_json: AsJson = False,
) -> None:
    """Keep notes with a session."""
    with plain_errors(), running_service(data, url) as client:
        row = ask(client, "PATCH", _path(named(client, session_id)), json={"notes": text})
        if as_json:
            show_json(row)
        else:
            console.print(f"noted on {row['name']}", highlight=False)


@sessions_app.command("delete")
def delete_command(
    session_id: WholeId,
    data: Data = DEFAULT_DATA,
    url: Url = DEFAULT_URL,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask.")] = False,
) -> None:
    """Delete a session with everything stored of it; asks first."""
    with plain_errors(), running_service(data, url) as client:
        answer = client.delete(_path(session_id))
        if answer.status_code != httpx.codes.CONFLICT:
            fail(f"the service refused: {answer.json().get('detail', answer.status_code)}")
        if not yes:
            errors.print(answer.json()["detail"].partition(": say so")[0], highlight=False, soft_wrap=True)
            if not typer.confirm("Delete it?", err=True):
                fail("nothing was deleted")
        ask(client, "DELETE", _path(session_id), params={"confirm": session_id})
        console.print("deleted", highlight=False)
