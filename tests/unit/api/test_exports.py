"""Exported files are passed through: whatever a client asks for, nothing stays behind."""

import anyio
import pytest

from scanner_service.api.routes.results import PassingFile


@pytest.mark.parametrize("range_asked", [None, b"bytes=0-1", b"bytes=nonsense", b"bytes=99-"])
def test_an_export_leaves_nothing_behind(tmp_path, range_asked):
    folder = tmp_path / "export"
    folder.mkdir()
    (folder / "summary.json").write_text("{}")
    sent = []

    async def receive():
        await anyio.sleep_forever()

    async def send(message):
        sent.append(message)

    headers = [] if range_asked is None else [(b"range", range_asked)]
    scope = {"type": "http", "method": "GET", "path": "/", "headers": headers, "asgi": {"spec_version": "2.4"}}
    anyio.run(PassingFile(folder / "summary.json"), scope, receive, send)
    assert sent[0]["status"] in (200, 206, 400, 416)
    assert not folder.exists()
