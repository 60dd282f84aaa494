"""Files that are brought over the network: what is refused in a sentence, and let go of."""

import os
from pathlib import Path

import httpx
import pytest

from scanner_service.api.app import make_app
from scanner_service.api.keys import Role
from scanner_service.api.server import ServerThread
from scanner_service.api.service import Service
from scanner_service.sessions.readiness import warm_up
from scanner_service.sessions.settings import SessionSettings
from scanner_service.storage.errors import RecordUnusable
from scanner_service.storage.record import Record


@pytest.fixture
def operator(tmp_path):
    (tmp_path / "data").mkdir()
    warm_up()  # compiling and describing routes both play with the list of warnings, which is one for all threads
    service = Service.open(tmp_path / "data")
    key = service.access.create_key(Role.OPERATOR, "bringer")
    with (
        ServerThread(make_app(service)) as listening,
        httpx.Client(
            base_url=listening.url, headers={"Authorization": f"Bearer {key}"}, timeout=60, trust_env=False
        ) as client,
    ):
        yield client
    service.close()


def test_a_side_file_of_sqlite_is_refused_in_a_sentence(operator):
    for name in ("scan.sqlite-journal", "scan.sqlite-wal", "scan.sqlite-shm"):
        refused = operator.put(f"/api/v1/files/{name}", content=b"1 2 3\n4 5 6\n")
        assert refused.status_code == 422
        assert name in refused.json()["detail"] and ".sqlite" in refused.json()["detail"]
    assert operator.get("/api/v1/files").json() == {"files": []}


@pytest.mark.parametrize("odd", [{"of_tomorrow": 1}, {"target": 7}, {"reference": {"nobody": 1}}])
def test_a_record_with_settings_that_nobody_knows_is_refused_and_let_go_of(operator, tmp_path, odd):
    with Record.open(tmp_path / "odd.sqlite") as record:
        record.create_session("odd", settings={**SessionSettings().to_dict(), **odd})
    assert operator.put("/api/v1/files/odd.sqlite", content=(tmp_path / "odd.sqlite").read_bytes()).status_code == 201
    refused = operator.post("/api/v1/sessions", json={"source": {"kind": "replay", "file": "odd.sqlite"}})
    assert refused.status_code == 422, refused.text
    assert "settings of the recorded session" in refused.json()["detail"]
    held = [os.path.realpath(one) for one in Path("/proc/self/fd").iterdir()]
    assert not [one for one in held if one.endswith("odd.sqlite")]


def test_a_file_where_the_folder_of_the_data_should_be_is_named(tmp_path):
    taken = tmp_path / "taken"
    taken.write_text("")
    with pytest.raises(RecordUnusable, match="taken cannot be the folder of the data: File exists"):
        Service.open(taken)
