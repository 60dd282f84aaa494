"""A service that was just installed compiles its kernels for a minute or two: whoever wants a session is told so."""

import json
import os
import subprocess
import sys
import time

import httpx
import pytest

from scanner_service.sessions.readiness import STEPS
from tests.end_to_end.running import PATIENCE_S, ROOT


@pytest.fixture
def fresh(tmp_path):
    """A client of a service in a process of its own that finds no compiled kernel."""
    data = tmp_path / "data"
    command = [sys.executable, "-m", "scanner_service", "serve", "--data", str(data), "--port", "0", "--json"]
    environment = os.environ | {"XDG_CACHE_HOME": str(tmp_path / "cache")}
    environment.pop("NUMBA_CACHE_DIR", None)
    with (
        (tmp_path / "log").open("wb") as log,
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True, cwd=ROOT, env=environment) as process,
    ):
        try:
            url = json.loads(process.stdout.readline())["url"]
            key = {"Authorization": f"Bearer {(data / 'local-key').read_text().strip()}"}
            with httpx.Client(base_url=url, headers=key, timeout=PATIENCE_S) as client:
                yield client
        finally:
            process.kill()


def test_whoever_wants_a_session_before_all_is_compiled_is_told_when_to_come_again(fresh):
    refused = fresh.post("/api/v1/sessions", json={"source": {"kind": "push"}})
    assert refused.status_code == 503, refused.text  # and not 201 when all is compiled
    assert int(refused.headers["Retry-After"]) >= 1
    problem = refused.json()
    assert problem["type"] == "/problems/kernels-compiling"
    assert "compil" in problem["detail"] and "/readyz" in problem["detail"]
    assert fresh.get(problem["type"]).status_code == 200  # it explains itself
    ready = fresh.get("/readyz")
    assert (ready.status_code, ready.json()["checks"]["kernels"]) == (503, False)
    told = ready.json()["preparing"]
    assert told["what"] == STEPS[told["step"] - 1] and told["of"] == len(STEPS) and told["seconds"] >= 0.0
    while not told["compiles"]:  # nothing is in the cache: the first kernel says so
        time.sleep(0.1)
        told = fresh.get("/readyz").json()["preparing"]
        assert told is not None, "all is ready, and nothing was said to be compiled"
    assert fresh.get("/api/v1/sessions").json()["sessions"] == []  # none was made, and the list does not wait
