"""`scanner demo`: the whole thing once, for real: simulator process, pty, service, live session, result files."""

import contextlib
import json
import subprocess
import sys
import tempfile
import time
import webbrowser
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import httpx
import typer

from scanner_service.api.app import make_app
from scanner_service.api.keys import read_local_key
from scanner_service.api.login import login_url
from scanner_service.api.server import ServerThread
from scanner_service.api.service import Service
from scanner_service.commands.demo_loop import demo_name, watch_loop
from scanner_service.commands.terminal import (
    check_folder,
    console,
    errors,
    fail,
    loss_sentence,
    plain_errors,
    scan_progress,
    show_json,
    tell_regions,
)
from scanner_service.commands.until_ready import wait_until_ready
from scanner_service.sessions.outputs import OUTPUT_FILES

DEMO_PARTS = ("demo", "plate", "step", "sphere")
LINE_SPACING_MM = 0.15
LINE_RATE_HZ = 50.0
BAUD_RATE = 3_000_000
_POLL_S = 0.2


def demo_command(
    out: Annotated[Path, typer.Option(help="Folder for the result files.")] = Path("out"),
    part: Annotated[str, typer.Option(help="Part under the simulated scanner: demo, plate, step or sphere.")] = "demo",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of the viewer; 0 takes a free one.")] = 0,
    loop: Annotated[
        bool, typer.Option("--loop", help="Scan coarsely, and watch the closed loop mend it with a simulated arm.")
    ] = False,
    keep: Annotated[bool, typer.Option("--keep", help="Serve on after the scan, until Ctrl-C.")] = False,
    browse: Annotated[bool, typer.Option("--browse", help="Open the viewer in a browser.")] = False,
    seed: Annotated[int, typer.Option(help="Of noise and dropouts.")] = 1,
    as_json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")] = False,
) -> None:
    """Scan a simulated part over a pseudo-terminal, live, and write what was found."""
    with plain_errors(), tempfile.TemporaryDirectory(prefix="scanner-demo-") as folder, contextlib.ExitStack() as stack:
        check_folder(out)
        if part not in DEMO_PARTS:
            fail(f"there is no part {part}; the parts are {', '.join(DEMO_PARTS)}")
        service = Service.open(Path(folder))
        stack.callback(service.close)
        listening = stack.enter_context(ServerThread(make_app(service), port=port))
        viewer = login_url(service.access, listening.url)
        errors.print(f"Viewer: {viewer}", soft_wrap=True, highlight=False)
        errors.print(f"        (the address works once; {'it serves until Ctrl-C' if keep else 'gone after the scan'})")
        if browse:
            webbrowser.open(viewer)
        key = read_local_key(Path(folder))
        client = stack.enter_context(
            httpx.Client(base_url=listening.url, headers={"Authorization": f"Bearer {key}"}, timeout=120.0)
        )
        wait_until_ready(client)
        if loop:
            session_id = watch_loop(client, part, seed)
        else:
            session_id = scan(client, part, stack.enter_context(simulated_scanner(part, seed)))
        for name in OUTPUT_FILES:
            (out / name).write_bytes(_checked(client.get(f"/api/v1/sessions/{session_id}/export/{name}")).content)
        summary = json.loads((out / "summary.json").read_text())
        if as_json:
            show_json(summary)
        else:
            regions = _checked(client.get(f"/api/v1/sessions/{session_id}/regions")).json()["regions"]
            tell(regions, summary, out)
        if keep:
            viewer = login_url(service.access, listening.url)
            errors.print(f"Serving on until Ctrl-C; once more the viewer: {viewer}", soft_wrap=True, highlight=False)
            with contextlib.suppress(KeyboardInterrupt):
                while True:
                    time.sleep(3600.0)


def scan(client: httpx.Client, part: str, simulator: dict[str, Any]) -> str:
    """Run one live session to its end, showing its progress; the session's id."""
    first_mm, last_mm = simulator["travel_mm"]
    request = {
        "name": demo_name("demo", part),
        "source": {
            "kind": "device",
            "port": simulator["port"],
            "baud_rate": BAUD_RATE,
            "line_spacing_mm": LINE_SPACING_MM,
            "start_mm": first_mm,
            "end_mm": last_mm,
            "line_rate_hz": LINE_RATE_HZ,
            "rearm": True,  # a simulated laser hurts nobody, and a busy machine may keep the device waiting
        },
    }
    session_id = str(_checked(client.post("/api/v1/sessions", json=request)).json()["id"])
    _checked(client.post(f"/api/v1/sessions/{session_id}/start"))
    with scan_progress("scanning") as progress:
        while True:
            status = _checked(client.get(f"/api/v1/sessions/{session_id}")).json()
            progress.show(status)
            if status["state"] == "failed":
                fail(f"the scan failed: {status['message']}")
            if status["state"] == "stopped":
                break
            time.sleep(_POLL_S)
    if status["message"]:
        errors.print(f"note: {status['message']}", highlight=False, soft_wrap=True)
    return session_id


def tell(regions: list[dict[str, Any]], summary: dict[str, Any], out: Path) -> None:
    """What was found, and where it was written."""
    tell_regions(regions)
    coverage = summary["coverage"]["share"]
    console.print(
        f"{summary['points']:,} points in {summary['scanlines']:,} scanlines, "
        f"{summary['reliable_share']:.1%} with a reliable normal; "
        f"observed coverage {'unknown' if coverage is None else format(coverage, '.1%')} "
        f"({summary['coverage']['gap_mm2']:,.0f} mm² of gaps)",
        highlight=False,
        soft_wrap=True,
    )
    console.print(loss_sentence(summary["losses"]), highlight=False, soft_wrap=True)
    console.print(f"Written to {out}: {', '.join(OUTPUT_FILES)}", highlight=False, soft_wrap=True)


@contextlib.contextmanager
def simulated_scanner(part: str, seed: int) -> Iterator[dict[str, Any]]:
    """A simulated scanner in its own process; what it announced of its port."""
    command = [sys.executable, "-m", "simulators", "--part", part, "--seed", str(seed), "--baud", str(BAUD_RATE)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            announced = process.stdout.readline() if process.stdout is not None else ""
            if not announced:
                fail("the simulated scanner did not start; run `scanner simulate` to see why")
            yield json.loads(announced)
        finally:
            process.terminate()


def _checked(response: httpx.Response) -> httpx.Response:
    if response.is_error:
        fail(f"the service refused: {response.json().get('detail', response.text)}")
    return response
