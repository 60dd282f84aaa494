"""The viewer in a real browser before the real service: simulator process, pty, driver, service, WebSocket, page."""

import base64
import io
import json
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.image import imread

from drivers.scanline import Pose, Scanline
from scanner_service.sessions.book import SessionBook
from scanner_service.sessions.replay_source import ReplaySource
from scanner_service.sessions.settings import SessionSettings
from scanner_service.sessions.source_specs import PushSpec
from scanner_service.storage.record import Record
from simulators.parts import plate
from simulators.posed_rig import PosedScanner
from tests.end_to_end.browsing import NEEDS_CHROMIUM, Page, chromium, wait
from tests.end_to_end.running import ROOT
from tests.unit.analysis.scans import surface_scan
from tests.unit.rescan.passes.posed_scans import FROM_ABOVE, SCANNER

pytestmark = NEEDS_CHROMIUM


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as made:
        yield made


@pytest.fixture
def context(browser: Any) -> Iterator[Any]:
    """A browser that nobody has signed in with."""
    made = browser.new_context()
    yield made
    made.close()


def device(simulator: Any, **changes: Any) -> dict[str, Any]:
    first_mm, last_mm = simulator.ready["travel_mm"]
    source = {"kind": "device", "port": simulator.port, "baud_rate": 3_000_000, "line_rate_hz": 60.0}
    return source | {"line_spacing_mm": 0.25, "start_mm": first_mm, "end_mm": last_mm} | changes


def viewer_page(context: Any, service: Any) -> Page:
    return Page.opened(context, service.viewer, urlsplit(service.url).netloc)


def regions_of(service: Any, session_id: str) -> list[dict[str, Any]]:
    regions: list[dict[str, Any]] = service.client.get(f"/api/v1/sessions/{session_id}/regions").json()["regions"]
    return regions


def points_of(service: Any, session_id: str) -> dict[str, np.ndarray]:
    """Every point as REST tells it."""
    pages: list[dict[str, Any]] = []
    start: int | None = 0
    while start is not None:
        query = {"start": start, "limit": 10_000}
        pages.append(service.client.get(f"/api/v1/sessions/{session_id}/points", params=query).json())
        start = pages[-1]["next"]
    return {
        name: np.concatenate([np.array(page[name], dtype=np.float64) for page in pages])
        for name in ("points_mm", "density_per_mm2")
    }


def test_a_live_scan_never_shrinks_and_ends_as_the_service_has_it(running: Any, context: Any) -> None:
    service, simulator = running.service(), running.simulator("step")
    page = viewer_page(context, service)
    page.until("document.querySelector('#notice').textContent.startsWith('No session yet')")
    session_id = service.create(**device(simulator))
    service.start(session_id)
    page.until(f"viewer.session === '{session_id}'")

    seen, states = [], []

    def is_finished() -> bool:
        seen.append(page.number("points"))
        states.append(page.text("#session-state"))
        return bool(page.number("connection") == "finished")

    wait(is_finished)
    states.append(page.text("#session-state"))  # the end may have come between the two looks
    assert seen == sorted(seen)
    assert seen[-1] > 0
    told = list(dict.fromkeys(state for state in states if state))
    assert told == [state for state in ("scanning", "judging", "stopped") if state in told]
    assert told[-1] == "stopped"
    assert page.text("#connection-text") == "Finished"

    known = points_of(service, session_id)
    assert page.number("points") == page.number("total") == len(known["points_mm"])
    regions = regions_of(service, session_id)
    lost = service.status(session_id)["losses"]["device"]["lines"]["lost"]  # on a busy machine those of the step itself
    assert lost or {region["reason"] for region in regions} >= {"shadow"}
    listed = [int(number) for number in page.tab.locator("#regions .number").all_text_contents()]
    assert listed == [region["id"] for region in regions], "the most urgent first, as the service calls them"
    reasons = [text.lower() for text in page.tab.locator("#regions .reason").all_text_contents()]
    assert reasons == [region["reason"].replace("_", " ") for region in regions]
    assert sorted(page.number("outlined")) == sorted(listed)
    assert lost or page.text("#losses-count") == "nothing lost"

    page.tab.click("summary:has-text('Display')")
    page.tab.uncheck("#shaded")
    page.tab.uncheck("#show-regions")
    page.tab.fill("#point-size", "2")
    page.tab.keyboard.press("Escape")
    page.tab.click("#session-state")
    page.tab.keyboard.press("7")
    page.settle()
    for place in ((0.0, 8.0), (0.0, 34.0)):  # below and on the step
        assert_coloured_by_density(page, known, *place)

    page.tab.click("#requirement-fold > summary")
    page.tab.fill("#ask-density_per_mm2", "200")  # of all that was scanned: no region stays as it was
    page.tab.click("#requirement-apply")
    page.until("document.querySelector('#requirement-said').textContent.startsWith('200 points/mm²')")
    page.until("document.querySelector('#judging-text').textContent.match(/^Judged: [0-9]+ region/)")
    page.until("viewer.regions > 0 && viewer.connection === 'finished'")
    now = regions_of(service, session_id)
    assert [int(number) for number in page.tab.locator("#regions .number").all_text_contents()] == [
        one["id"] for one in now
    ]
    said = page.tab.locator("#regions .density").all_text_contents()
    assert lost or said[0].endswith("≥ 200points/mm²")  # lines that were lost are missed first, by their spacing
    assert page.complaints == []
    page.tab.close()


def assert_coloured_by_density(page: Page, known: dict[str, np.ndarray], x_mm: float, y_mm: float) -> None:
    """The commonest colour around a place, seen from the top, is the one that viridis has for the densities there."""
    points, density = known["points_mm"], known["density_per_mm2"]
    near = np.hypot(points[:, 0] - x_mm, points[:, 1] - y_mm) < 1.5
    assert near.sum() > 50
    eye, middle, (low, high) = (page.number(name) for name in ("eye", "middle", "densityRange"))
    frame = page.tab.locator("#canvas").bounding_box()
    px_per_mm = frame["height"] / (2 * (eye[2] - np.median(points[near, 2])) * np.tan(np.radians(16)))
    x = frame["x"] + middle[0] + (x_mm - eye[0]) * px_per_mm
    y = frame["y"] + middle[1] - (y_mm - eye[1]) * px_per_mm
    picture = page.tab.screenshot(clip={"x": x - 8, "y": y - 8, "width": 16, "height": 16})
    pixels = imread(io.BytesIO(picture), format="png")[..., :3].reshape(-1, 3)
    shares = (np.quantile(density[near], [0.02, 0.98]) - low) / (high - low)
    expected = mpl.colormaps["viridis"](np.linspace(*shares, 50))[:, :3]
    distances = np.abs(pixels[:, None, :] - expected[None, :, :]).max(axis=2).min(axis=1)
    assert np.median(distances) < 0.03, f"{np.median(pixels, axis=0)} at densities {shares} of the range"
    assert high > density.max() / 2 > 0


def test_the_page_says_that_the_scanner_is_gone_and_stops_the_scan_when_it_is_back(
    service: Any, running: Any, context: Any, tmp_path: Path
) -> None:
    link = tmp_path / "scanner-port"
    simulator = running.simulator("step", "--link", link)
    session_id = service.create(**device(simulator, port=str(link), line_rate_hz=6.0, rearm=True))
    service.start(session_id)
    page = viewer_page(context, service)
    page.until("viewer.points > 1000")
    assert (page.text("#session-state"), page.text("#start"), page.text("#notice")) == ("scanning", "", "")

    simulator.tell("unplug")
    page.until("document.querySelector('#session-state').textContent === 'paused'")
    assert "waiting for it to return" in page.text("#message")
    picture, banner = (page.tab.locator(name).bounding_box() for name in ("#view", "#message"))
    assert picture["y"] < banner["y"] < picture["y"] + picture["height"] / 4, "the message stands above the picture"
    before = page.number("points")
    simulator.tell("replug")
    page.until("document.querySelector('#message').hidden")
    page.until(f"viewer.points > {before}")  # the cloud grows before the eyes

    page.tab.click("#stop")
    page.until("viewer.connection === 'finished'")
    status = service.status(session_id)
    assert (status["state"], page.text("#session-state")) == ("stopped", "stopped")
    assert page.number("points") == status["points"]
    assert 0 < status["progress"] < 1
    assert (page.text("#stop"), page.text("#start")) == ("", ""), "a device's session is scanned once"
    assert page.complaints == []
    page.tab.close()


def pushed_lines(count: int) -> list[dict[str, Any]]:
    return [
        {
            "line_index": i,
            "points_mm": [[0.15 * k, 0.2 * i, 0.0] for k in range(40)],
            "laser_mm": [3.0, 0.2 * i, 100.0],
            "plane_normal": [0, 1, 0],
            "travel": [0, 1, 0],
            "line_spacing_mm": 0.2,
        }
        for i in range(count)
    ]


def test_the_page_starts_a_session_misses_a_service_that_ends_and_finds_it_again(running: Any, context: Any) -> None:
    service = running.service()
    session_id = service.create(kind="push")
    page = viewer_page(context, service)
    page.until("!document.querySelector('#start').hidden")
    assert (page.text("#notice"), page.text("#stop")) == ("Not scanning. Start begins the scan.", "")
    page.tab.click("#start")
    page.until("document.querySelector('#session-state').textContent === 'scanning'")
    url = f"/api/v1/sessions/{session_id}/scanlines"
    assert service.client.post(url, json={"lines": pushed_lines(20)}).status_code == 200
    page.until("viewer.points === 800")

    service.kill()
    page.until("viewer.connection === 'waiting'")
    page.until("document.querySelector('#message').textContent.includes('does not answer')")
    page.until("document.querySelector('#connection-text').textContent.startsWith('Connection lost. Trying again in')")
    assert page.number("points") == 800, "what is known stays in sight"

    command = [sys.executable, "-m", "scanner_service", "serve", "--json", "--data", str(running.data)]
    port = str(urlsplit(service.url).port)
    with subprocess.Popen([*command, "--port", port], stdout=subprocess.PIPE, text=True, cwd=ROOT) as again:
        try:
            viewer = json.loads(again.stdout.readline())["viewer"]  # type: ignore[union-attr]
            page.tab.click("#retry")
            page.until("document.querySelector('#message').textContent.startsWith('Not signed in')")
            elsewhere = Page.opened(context, viewer, urlsplit(service.url).netloc)  # logins end with the process
            page.tab.bring_to_front()
            page.until("viewer.connection === 'open' && viewer.points === 800")
            page.until("document.querySelector('#session-state').textContent === 'interrupted'")
            page.until("document.querySelector('#message').hidden")
            assert page.text("#start") == "Go on"
            assert [said for said in elsewhere.complaints if "503" not in said] == []  # it asked whether all is ready
        finally:
            again.terminate()
    page.tab.close()


def test_a_record_that_is_dropped_on_the_page_is_played_and_shown(running: Any, context: Any, tmp_path: Path) -> None:
    path = tmp_path / "brought.sqlite"
    with Record.open(path) as record:
        book = SessionBook(record)
        lines = surface_scan(lambda x, y: 0.2 * np.sin(x), lines=30, points=60)
        made = book.create("brought", PushSpec(), SessionSettings(max_points=9000), source=ReplaySource(lines, 30))
        made.start()
        assert made.wait_until_over(60)
        book.close()
    service = running.service()
    page = viewer_page(context, service)
    page.until("document.querySelector('#notice').textContent.startsWith('No session yet')")
    drop = """([name, base64]) => {
      const bytes = Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
      const carried = new DataTransfer();
      carried.items.add(new File([bytes], name));
      const event = { dataTransfer: carried, bubbles: true, cancelable: true };
      for (const kind of ["dragover", "drop"]) document.body.dispatchEvent(new DragEvent(kind, event));
    }"""
    page.tab.evaluate(drop, ["brought.sqlite", base64.b64encode(path.read_bytes()).decode()])
    page.until("viewer.connection === 'finished' && viewer.points === 1800")
    assert page.text("#session-name") == "brought.sqlite"
    shown = page.tab.evaluate("viewer.session")
    assert service.status(shown)["source"] == {"kind": "record", "session": made.row.session_id}
    assert [file["kind"] for file in service.client.get("/api/v1/files").json()["files"]] == ["record"]
    assert page.complaints == []
    odd = tmp_path / "odd.txt"
    odd.write_bytes(bytes(64))
    page.tab.set_input_files("#file", odd)
    page.until("document.querySelector('#message').textContent.includes('none of the kinds that are read')")
    assert [complaint for complaint in page.complaints if "422" not in complaint] == []
    assert page.tab.evaluate("viewer.session") == shown


def push(service: Any, session_id: str, lines: Iterable[Scanline]) -> None:
    """Send the scanlines as a client with a scanner in its hand does."""
    told = [
        {
            "pass_index": line.pass_index,
            "line_index": line.line_index,
            "points_mm": [point if np.isfinite(point).all() else None for point in line.points_mm.tolist()],
            "laser_mm": line.laser_mm.tolist(),
            "plane_normal": line.plane_normal.tolist(),
            "travel": line.travel.tolist(),
            "position_mm": line.position_mm,
            "line_spacing_mm": line.line_spacing_mm,
        }
        for line in lines
    ]
    answer = service.client.post(f"/api/v1/sessions/{session_id}/scanlines", json={"lines": told})
    assert answer.status_code == 200, answer.text


def along(order: dict[str, Any]) -> Callable[[float], Pose]:
    """Where the sensor is at each position of an ordered pass."""
    one = order["pass"]
    start, end = (np.array(one[name]["translation_mm"]) for name in ("start_pose", "end_pose"))
    rotation, length = np.array(one["start_pose"]["rotation"]), one["end_mm"] - one["start_mm"]
    return lambda at_mm: Pose(rotation, start + (at_mm - one["start_mm"]) / length * (end - start))


def test_what_is_asked_for_is_set_on_the_page_and_a_hand_is_guided_along_the_pass_that_it_needs(
    running: Any, context: Any
) -> None:
    service, posed = running.service(), PosedScanner(SCANNER, plate().surface, np.random.default_rng(1))
    session_id = service.create(kind="push")
    service.start(session_id)
    push(service, session_id, posed.scan(FROM_ABOVE.part_from_sensor, 4.0, 12.0, 0.5))
    where = f"/api/v1/sessions/{session_id}"
    assert service.client.post(f"{where}/stop").json()["requirement"]["density_per_mm2"] is None
    optics = {"laser_mm": SCANNER.laser_mm.tolist(), "camera_mm": SCANNER.camera_mm.tolist(),
              "range_mm": list(SCANNER.range_mm), "field_of_view_mm": SCANNER.field_of_view_mm,
              "points_per_line": SCANNER.points_per_line}  # fmt: skip
    rig = {"axis": "free_pose", "scanner": optics, "reach_low_mm": [-400] * 3, "reach_high_mm": [400] * 3}
    assert service.client.put(f"{where}/rig", json=rig).status_code == 200

    page = viewer_page(context, service)
    page.until("viewer.points > 1000 && document.querySelector('#requirement-said').textContent !== ''")
    assert page.text("#regions") == "No region needs another scan."
    page.tab.click("#requirement-fold > summary")
    page.tab.fill("#ask-noise_mm", "0.001")
    page.tab.click("#requirement-apply")
    page.until("document.querySelector('#why-noise_mm').textContent.includes('own noise')")
    page.tab.fill("#ask-noise_mm", "much")
    assert page.text("#why-noise_mm") == "This is no number."
    page.tab.fill("#ask-noise_mm", "")
    page.tab.fill("#ask-density_per_mm2", "24")
    page.tab.fill("#ask-coverage_share", "90")
    page.tab.click("#requirement-apply")
    page.until("document.querySelector('#judging-text').textContent.match(/^Judged: [0-9]+ region.* scan, coverage /)")
    page.until("document.querySelector('#requirement-said').textContent.startsWith('24 points/mm² · coverage 90')")
    page.until("document.querySelector('#requirement-holds').dataset.holds === 'false'")
    page.until("viewer.regions > 0")
    asked = service.status(session_id)["requirement"]
    assert (asked["density_per_mm2"], asked["coverage_share"], asked["preset"]) == (24.0, 0.9, None)
    assert sorted(page.number("outlined")) == sorted(region["id"] for region in regions_of(service, session_id))

    corners = [f"v {x} {y} {z}" for x in (-20, 20) for y in (0, 40) for z in (-6, 0)]
    sides = ("1 2 4 3", "5 7 8 6", "1 5 6 2", "3 4 8 7", "1 3 7 5", "2 6 8 4")
    mesh = {
        "name": "plate.obj",
        "mimeType": "model/obj",
        "buffer": "\n".join(corners + [f"f {side}" for side in sides]).encode(),
    }
    page.tab.set_input_files("#nominal-file", mesh)
    page.until("document.querySelector('#nominal-said').textContent === 'plate.obj, in mm'")
    page.until("document.querySelector('#figures').textContent.includes('Coverage of the nominal part')")
    page.tab.click("#nominal-none")
    page.until("document.querySelector('#figures').textContent.includes('Observed coverage')")

    page.tab.evaluate("""() => {
        globalThis.planNotes = [];
        const watched = document.querySelector("#plan-note");
        new MutationObserver(() => planNotes.push(watched.textContent)).observe(watched, { childList: true });
    }""")
    page.tab.click("#find-passes")
    page.until("document.querySelector('#passes .pass') !== null")
    notes = page.tab.evaluate("planNotes")
    assert notes[0].startswith("Planning passes…") and notes[-1] == ""  # said until the plan is there, and no longer
    for fate in ("cancelled", "running"):
        page.tab.click("#passes .pass:first-child button:has-text('Accept')")
        page.tab.click("#orders button:has-text('" + ("Cancel" if fate == "cancelled" else "Carry out") + "')")
        page.until(f"document.querySelector('#orders .badge')?.textContent === '{fate}'")
    first, order = service.client.get(f"{where}/pass-orders").json()["orders"]
    assert (first["status"], order["status"]) == ("cancelled", "running")
    lines = list(
        posed.scan(along(order), order["pass"]["start_mm"], order["pass"]["end_mm"], order["pass"]["line_spacing_mm"])
    )
    push(service, session_id, lines[: len(lines) // 2])
    page.until("document.querySelector('#guide .say')?.textContent.includes('mm to go')")
    push(service, session_id, lines[len(lines) // 2 :])
    page.tab.click("#stop")
    page.until("document.querySelector('#orders .badge')?.textContent === 'done'")
    page.until("document.querySelector('#guide').hidden")
    done = service.client.get(f"{where}/pass-orders/{order['order']}").json()["outcome"]
    assert done["reached_mm2"] > 0.7 * done["promised_mm2"] > 0
    assert "promised" in page.text("#orders .pass:first-child").lower()
    refused = service.client.get(f"{where}/pass-orders/{order['order']}/guidance")
    assert (refused.status_code, "is done" in refused.json()["detail"]) == (409, True)

    before = service.status(session_id)["points"]
    page.until("document.querySelector('#plan-note').textContent === ''")
    withdraw = page.tab.locator("#orders .pass:first-child button")
    withdraw.focus()
    page.tab.keyboard.press("Enter")
    assert withdraw.text_content() == "Press again: its points leave the map"
    page.tab.keyboard.press("Escape")
    assert withdraw.text_content() == "Withdraw"
    for _ in range(2):
        page.tab.keyboard.press("Enter")
    page.until("document.querySelector('#orders .badge')?.textContent === 'withdrawn'")
    assert service.status(session_id)["points"] < before - 1000
    assert "reached" not in page.text("#orders .pass:first-child")
    assert [complaint for complaint in page.complaints if "422" not in complaint and "409" not in complaint] == []
    page.tab.close()
