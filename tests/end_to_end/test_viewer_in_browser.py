"""The viewer page in a real browser, before a stand-in service that speaks the live stream of docs/live-stream.md."""

import asyncio
import contextlib
import io
import json
import re
import socket
import struct
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
import uvicorn
from matplotlib.image import imread
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket, WebSocketDisconnect

from scanner_service.web import CONTENT_SECURITY_POLICY, INDEX_HTML, STATIC_DIR
from tests.end_to_end.browsing import NEEDS_CHROMIUM, Page, chromium, wait

pytestmark = NEEDS_CHROMIUM

ORIGIN_MM = np.array([100.0, 50.0, 20.0])
SPARSE_PER_MM2, DENSE_PER_MM2 = 3.0, 18.0


def height_mm(x: Any, y: Any) -> Any:
    """The wavy surface, relative to the origin."""
    return 6 * np.sin(x / 9) * np.cos(y / 12)


@dataclass
class Cloud:
    """A made-up map: a wavy plate, a disc of it sparse, a disc steep and unreliable."""

    xyz: np.ndarray
    density: np.ndarray
    normal: np.ndarray
    state: np.ndarray
    per_line: int

    @classmethod
    def wavy(cls, lines: int = 180, per_line: int = 220) -> "Cloud":
        y, x = np.meshgrid(np.linspace(-32, 32, lines), np.linspace(-45, 45, per_line), indexing="ij")
        x, y = x.ravel(), y.ravel()
        slope = np.stack(
            [-6 / 9 * np.cos(x / 9) * np.cos(y / 12), 6 / 12 * np.sin(x / 9) * np.sin(y / 12), 1 + 0 * x], 1
        )
        normal = slope / np.linalg.norm(slope, axis=1, keepdims=True)
        sparse = np.hypot(x - 20, y - 8) < 9
        steep = np.hypot(x + 22, y + 12) < 7
        density = np.where(sparse, SPARSE_PER_MM2, DENSE_PER_MM2 * (0.75 + 0.25 * normal[:, 2]))
        state = np.full(len(x), 0b11, np.uint32)
        state[sparse] |= 0b1000 | 2 << 16
        state[steep] = 0b1010 | 2 << 8 | 1 << 16
        normal[steep] = np.nan
        keep = ~sparse | (np.random.default_rng(1).random(len(x)) < 0.35)
        order = np.flatnonzero(keep)
        return cls(np.stack([x, y, height_mm(x, y)], 1)[order], density[order], normal[order], state[order], per_line)

    def message(
        self, ids: np.ndarray, version: int, base: int, total: int, *, snapshot: bool, skipped: int = 0
    ) -> bytes:
        """Rows `ids` as the stream carries them."""
        header = struct.pack("<4sHHQQIIII", b"SLV1", 1, int(snapshot), version, base, len(ids), skipped, total, 0)
        parts = (ids.astype("<u4"), self.xyz[ids].astype("<f4"), self.density[ids].astype("<f4"))
        return header + b"".join(
            p.tobytes() for p in (*parts, self.normal[ids].astype("<f4"), self.state[ids].astype("<u4"))
        )


def ring(x: float, y: float, radius: float) -> list[list[float]]:
    """An outline on the surface, in the part frame."""
    turn = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    px, py = x + radius * np.cos(turn), y + radius * np.sin(turn)
    return [[float(v) for v in row] for row in np.stack([px, py, height_mm(px, py)], 1) + ORIGIN_MM]


def region(number: int, reason: str, x: float, y: float, radius: float, measured: float, remedy: str) -> dict[str, Any]:
    """A region as the service describes it."""
    return {
        "id": number,
        "number": number,
        "reason": reason,
        "area_mm2": np.pi * radius**2,
        "centroid_mm": [float(v) for v in np.array([x, y, height_mm(x, y)]) + ORIGIN_MM],
        "normal": [0.0, 0.0, 1.0],
        "measured_per_mm2": measured,
        "required_per_mm2": 9.0,
        "priority": 0.9 - 0.3 * number,
        "outline_mm": [ring(x, y, radius)],
        "remedy": remedy,
    }


REGIONS = [
    region(2, "steep", -22, -12, 7, 5.2, "another direction: tilt the part by about 30°"),
    region(1, "sparse", 20, 8, 9, SPARSE_PER_MM2, "the same pass, line spacing 0.2 mm"),
]


@dataclass
class StandIn:
    """A service of one session whose map grows by itself; every socket has its own credit."""

    cloud: Cloud = field(default_factory=Cloud.wavy)
    lines_at_once: int = 12
    state: str = "scanning"
    session_id: str = "s-1"
    sessions: list[dict[str, Any]] | None = None
    touch: list[int] = field(default_factory=list)  # rows to send once more when the map is whole
    gap: bool = False  # send one update that builds on a version nobody has
    overdrawn: int = 0
    snapshots: int = 0
    commands: list[str] = field(default_factory=list)

    def listed(self) -> list[dict[str, Any]]:
        """The sessions of the list, the oldest first."""
        if self.sessions is not None:
            return self.sessions
        old = {"id": "s-0", "name": "Bracket, first try", "state": "stopped", "lines": 812, "points": 790211}
        new = {
            "id": self.session_id,
            "name": "Bracket 4711, left",
            "state": self.state,
            "lines": 180,
            "points": len(self.cloud.xyz),
        }
        return [old | {"created": "2026-11-20T09:12:00Z"}, new | {"created": "2026-11-21T14:03:00Z"}]

    def app(self) -> Starlette:
        """The routes that the page uses."""
        secure = {"content-security-policy": CONTENT_SECURITY_POLICY}
        base = "/api/v1/sessions"

        async def page(_: Request) -> Response:
            return FileResponse(INDEX_HTML, headers=secure)

        async def listing(_: Request) -> Response:
            return JSONResponse({"sessions": self.listed(), "next": None})

        async def command(request: Request) -> Response:
            self.commands.append(request.path_params["verb"])
            problem = {"type": "about:blank", "title": "Conflict", "status": 409, "detail": "the stage is still moving"}
            return JSONResponse(problem, 409, media_type="application/problem+json")

        async def ready(_: Request) -> Response:
            return JSONResponse({"checks": {"kernels": True}, "preparing": None})

        async def orders(_: Request) -> Response:
            return JSONResponse({"orders": []})

        async def loop(_: Request) -> Response:
            return JSONResponse({"loop": None})

        async def export(request: Request) -> Response:
            return PlainTextResponse(f"the file {request.path_params['file']}")

        return Starlette(
            routes=[
                Route("/", page),
                Route("/readyz", ready),
                Mount("/static", StaticFiles(directory=STATIC_DIR)),
                Route(base, listing),
                Route(f"{base}/{{id}}/pass-orders", orders),
                Route(f"{base}/{{id}}/rescan", loop),
                Route(f"{base}/{{id}}/{{verb:str}}", command, methods=["POST"]),
                Route(f"{base}/{{id}}/export/{{file}}", export),
                WebSocketRoute(f"{base}/{{id}}/live", self.live),
            ]
        )

    async def live(self, socket: WebSocket) -> None:
        """One client: status, regions, a snapshot of the first lines, then the rest as credit allows."""
        await socket.accept()
        if socket.path_params["id"] not in {self.session_id, "s-0"}:
            await socket.close(4404, "there is no such session")
            return
        credit = 0

        async def listen() -> None:
            nonlocal credit
            while True:
                credit += json.loads(await socket.receive_text())["credit"]

        listener = asyncio.create_task(listen())
        try:
            step, total, version, sent_at = self.lines_at_once * self.cloud.per_line, len(self.cloud.xyz), 0, -1.0
            end = 0
            while not listener.done():
                if time.monotonic() - sent_at > 0.4:
                    sent_at = time.monotonic()
                    await socket.send_json(self.status(end, total))
                    known = REGIONS if end == total else []
                    order = sorted(region["id"] for region in known)
                    await socket.send_json({"type": "regions", "order": order, "regions": known})
                rows = np.arange(end, min(end + step, total))
                if end == total and self.touch:
                    rows, self.touch = np.array(self.touch), []
                if len(rows) and credit > 0:
                    credit -= 1
                    end = max(end, int(rows[-1]) + 1)
                    base = 999 if self.gap and version == 3 else version
                    self.gap = self.gap and version != 3
                    self.snapshots += version == 0
                    await socket.send_bytes(self.cloud.message(rows, version + 1, base, end, snapshot=version == 0))
                    version += 1
                await asyncio.sleep(0.01)
        except WebSocketDisconnect:
            pass
        finally:
            self.overdrawn += credit < 0
            listener.cancel()
            with contextlib.suppress(asyncio.CancelledError, WebSocketDisconnect):
                await listener

    def status(self, end: int, total: int) -> dict[str, Any]:
        """What the service says twice a second."""
        dropped = {"dropout": 214, "missing": 64}
        points = {"places": end + 278, "counted": end, "dropped": dropped, "left_out": {}}
        received = end // self.cloud.per_line
        lines = {"received": received, "pending": 0, "stored": received - 2, "duplicates": 0, "conflicts": 0}
        losses = {"points": points, "lines": lines | {"refused": {"invalid": 2}}, "device": None}
        return {
            "type": "status",
            "state": self.state,
            "lines": end // self.cloud.per_line,
            "points": end,
            "points_per_s": 128000.0,
            "coverage": 0.934,
            "losses": losses,
            "progress": end / total,
            "origin_mm": ORIGIN_MM.tolist(),
            "message": None,
        }


class Host:
    """The stand-in behind a real port, in a thread; may be taken away and brought back on the same port."""

    def __init__(self, service: StandIn) -> None:
        self.service = service
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = int(probe.getsockname()[1])
        self.start()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}/"

    def start(self) -> None:
        options: dict[str, Any] = {
            "log_level": "error",
            "ws": "websockets-sansio",
            "ws_per_message_deflate": False,
            "timeout_graceful_shutdown": 1,
        }
        self.server = uvicorn.Server(uvicorn.Config(self.service.app(), host="127.0.0.1", port=self.port, **options))
        self.thread = threading.Thread(target=self.server.run, daemon=True)
        self.thread.start()
        wait(lambda: self.server.started)

    def stop(self) -> None:
        self.server.should_exit = True
        self.thread.join(10)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as made:
        yield made


@pytest.fixture
def service() -> StandIn:
    return StandIn()


@pytest.fixture
def host(service: StandIn) -> Iterator[Host]:
    made = Host(service)
    yield made
    made.stop()


@pytest.fixture
def page(browser: Any, host: Host) -> Iterator[Page]:
    made = Page.opened(browser, host.url, f"127.0.0.1:{host.port}", calm=True)
    yield made
    made.tab.close()


@pytest.fixture(scope="module")
def shown(browser: Any) -> Iterator[tuple[Page, Host]]:
    """A page on which everything has arrived, for those who only look; each of them chooses its view itself."""
    host = Host(StandIn())
    page = Page.opened(browser, host.url, f"127.0.0.1:{host.port}", calm=True)
    all_arrived(page, host)
    page.until("document.querySelector('#legend').hidden === false")
    yield page, host
    page.tab.close()
    host.stop()


def all_arrived(page: Page, host: Host) -> None:
    """Until every point has arrived and the regions are listed."""
    page.until(f"viewer.points === {len(host.service.cloud.xyz)} && viewer.regions === 2")


def test_the_newest_live_session_opens_by_itself_and_every_point_arrives_without_a_complaint(
    page: Page, host: Host
) -> None:
    all_arrived(page, host)
    assert page.number("session") == "s-1"
    assert page.tab.text_content("#session-state") == "scanning"
    assert page.tab.text_content("#connection-text") == "Live"
    page.until("document.querySelector('#figures').textContent.includes('93.4')")
    page.until("document.querySelector('#losses-count').textContent === '2 scanlines, 64 points lost'")
    page.tab.click("#losses-fold summary")
    told = re.sub(r"\s+", " ", page.tab.inner_text("#losses"))
    assert re.search(r"No return \S+ % 214 In a piece that never arrived \S+ % 64 Scanlines", told), told
    assert re.search(r"Refused: invalid \S+ % 2 None: on the way to the record, duplicates, conflicts", told), told
    assert [page.tab.text_content(f"#regions li:nth-child({i}) .reason") for i in (1, 2)] == ["Sparse", "Steep"]
    assert page.complaints == []
    assert host.service.overdrawn == 0


def test_a_change_of_few_rows_uploads_few_rows(page: Page, host: Host) -> None:
    all_arrived(page, host)
    page.until("document.querySelector('#legend').hidden === false")
    before, version = page.number("uploadedRows"), page.number("version")
    host.service.touch = [5, 9, 20000]
    page.until(f"viewer.version === {version + 1}")
    page.until(f"viewer.uploadedRows > {before}")
    assert page.number("uploadedRows") - before <= 2 * 1024
    assert page.number("points") == len(host.service.cloud.xyz)


def test_a_lost_service_is_said_and_found_again_with_the_whole_map(page: Page, host: Host) -> None:
    all_arrived(page, host)
    host.stop()
    page.until("viewer.connection === 'waiting'")
    page.until("document.querySelector('#connection-text').textContent.startsWith('Connection lost. Trying again in')")
    page.until("document.querySelector('#message').textContent.includes('does not answer')")
    assert page.number("points") == len(host.service.cloud.xyz)  # what is known stays in sight
    host.start()
    page.until("viewer.connection === 'open'")
    all_arrived(page, host)
    page.until("document.querySelector('#message').hidden")
    assert host.service.snapshots == 2


def test_an_update_that_does_not_follow_makes_the_page_ask_for_everything_again(browser: Any, host: Host) -> None:
    host.service.gap = True
    tab = browser.new_page()
    tab.goto(host.url)
    all_arrived(Page(tab, []), host)
    assert host.service.snapshots == 2
    tab.close()


def test_keys_choose_front_right_and_top_views_and_fit(shown: tuple[Page, Host]) -> None:
    page, _ = shown
    page.settle()
    for key, axis, sign in (("1", 1, -1), ("3", 0, 1), ("7", 2, 1)):
        page.tab.keyboard.press(key)
        page.settle()
        arm = np.array(page.number("eye")) - np.array(page.number("target"))
        assert sign * arm[axis] > 0.999 * np.linalg.norm(arm)
    page.tab.keyboard.press("+")
    page.tab.keyboard.press("-")
    page.tab.keyboard.press("+")
    page.tab.keyboard.press("+")
    page.settle()
    near = np.linalg.norm(np.array(page.number("eye")) - np.array(page.number("target")))
    page.tab.keyboard.press("f")
    page.settle()
    far = np.linalg.norm(np.array(page.number("eye")) - np.array(page.number("target")))
    assert far > 1.5 * near


def test_a_click_tells_coordinates_in_the_part_frame_that_lie_on_the_surface(shown: tuple[Page, Host]) -> None:
    page, host = shown
    page.tab.keyboard.press("7")
    page.settle()
    frame = page.tab.locator("#canvas").bounding_box()
    page.tab.mouse.click(frame["x"] + 0.55 * frame["width"], frame["y"] + 0.6 * frame["height"])
    page.until("viewer.inspected >= 0")
    text = page.tab.text_content("#inspector .vector").replace("−", "-")
    at = np.array([float(v) for v in re.findall(r"-?\d+\.\d+", text)]) - ORIGIN_MM
    assert at[2] == pytest.approx(height_mm(at[0], at[1]), abs=0.002)
    assert np.abs(at[:2]).max() < 45
    row = page.number("inspected")
    assert np.allclose(host.service.cloud.xyz[row], at, atol=6e-4)
    assert "points/mm²" in page.tab.text_content("#inspector")


def test_choosing_a_region_turns_the_view_about_it_and_names_its_remedy(shown: tuple[Page, Host]) -> None:
    page, _ = shown
    page.tab.click("#regions button:has-text('Steep')")
    page.settle()
    steep = np.array(REGIONS[0]["centroid_mm"]) - ORIGIN_MM
    assert np.allclose(page.number("target"), steep, atol=1e-6)
    assert page.tab.get_attribute("#regions button:has-text('Steep')", "aria-pressed") == "true"
    assert page.tab.locator("#regions .remedy:visible").text_content() == REGIONS[0]["remedy"]
    assert sorted(page.tab.locator("#labels .region-label").all_text_contents()) == ["1", "2"]


def test_blue_is_dense_red_is_sparse_and_grey_is_unreliable(shown: tuple[Page, Host]) -> None:
    page, _ = shown
    page.tab.select_option("#scale", "bgyr")
    page.tab.click("summary:has-text('Display')")
    page.tab.uncheck("#shaded")
    page.tab.uncheck("#show-regions")
    page.tab.fill("#point-size", "2.5")
    page.tab.mouse.click(400, 700)
    page.tab.keyboard.press("Escape")
    page.tab.keyboard.press("7")
    page.settle()
    dense, sparse, unreliable = (colour_at(page, x, y) for x, y in ((0, -20), (20, 8), (-22, -12)))
    assert dense[2] > dense[0] + 60
    assert sparse[0] > sparse[2] + 60
    assert max(unreliable) - min(unreliable) < 12


def colour_at(page: Page, x: float, y: float) -> tuple[int, ...]:
    """The commonest bright colour around a place of the surface, seen from the top: the page's own screenshot tells."""
    middle = page.number("middle")
    frame = page.tab.locator("#canvas").bounding_box()
    eye, target = np.array(page.number("eye")), np.array(page.number("target"))
    px_per_mm = frame["height"] / (2 * (eye[2] - height_mm(x, y)) * np.tan(np.radians(16)))
    cx = frame["x"] + middle[0] + (x - target[0]) * px_per_mm
    cy = frame["y"] + middle[1] - (y - target[1]) * px_per_mm
    clip = {"x": cx - 10, "y": cy - 10, "width": 20, "height": 20}
    pixels = (imread(io.BytesIO(page.tab.screenshot(clip=clip)), format="png")[..., :3] * 255).round().astype(int)
    bright = pixels.reshape(-1, 3)
    bright = bright[bright.max(axis=1) > 90]
    values, counts = np.unique(bright, axis=0, return_counts=True)
    return tuple(int(v) for v in values[counts.argmax()])


def test_a_refused_command_is_told_in_the_service_s_own_words(page: Page, host: Host) -> None:
    all_arrived(page, host)
    page.tab.click("#stop")
    page.until("document.querySelector('#message').textContent === 'The stage is still moving'")
    assert host.service.commands == ["stop"]


def test_the_list_offers_every_session_and_the_address_names_the_one_that_is_open(page: Page, host: Host) -> None:
    all_arrived(page, host)
    page.tab.keyboard.press("s")
    page.tab.wait_for_selector("#session-list button")
    assert page.tab.locator("#session-list .name").all_text_contents() == ["Bracket 4711, left", "Bracket, first try"]
    page.tab.click("#session-list button:has-text('first try')")
    page.until("viewer.session === 's-0'")
    assert page.tab.url.endswith("?session=s-0")
    links = [page.tab.locator("#export-links a").nth(i).get_attribute("href") for i in range(4)]
    names = ["points.ply", "density.png", "regions.json", "summary.json"]
    assert links == [f"{host.url}api/v1/sessions/s-0/export/{name}" for name in names]


def test_a_session_that_does_not_exist_is_said_and_not_asked_for_again(browser: Any, host: Host) -> None:
    tab = browser.new_page()
    tab.goto(f"{host.url}?session=nowhere")
    Page(tab, []).until("viewer.connection === 'absent'")
    assert tab.text_content("#notice") == "there is no such session"
    tab.close()
