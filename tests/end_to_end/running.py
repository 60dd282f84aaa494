"""Real processes for end-to-end tests: the service, and a simulated scanner behind a pseudo-terminal."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import httpx

from scanner_service.storage.reader import RecordReader

ROOT = Path(__file__).resolve().parents[2]
PATIENCE_S = 300.0


class RunningService:
    """`scanner serve` in a process of its own, and a client with its local key."""

    def __init__(self, data: Path):
        self.data = data
        command = [sys.executable, "-m", "scanner_service", "serve", "--data", str(data), "--port", "0", "--json"]
        self.log = (data.parent / f"{data.name}.log").open("ab")
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=self.log, text=True, cwd=ROOT)
        announced = self.process.stdout.readline()
        if not announced:
            self.end()
            raise RuntimeError(Path(self.log.name).read_text())
        where = json.loads(announced)
        self.url, self.viewer = where["url"], where["viewer"]
        self.key = (data / "local-key").read_text().strip()
        self.client = httpx.Client(
            base_url=self.url, headers={"Authorization": f"Bearer {self.key}"}, timeout=PATIENCE_S
        )
        wait_for(lambda: self.client.get("/readyz").status_code == 200, "the service to be ready")

    def kill(self):
        """Pull the plug: no time to write or to say anything."""
        self.process.send_signal(signal.SIGKILL)
        self.end()

    def end(self):
        with contextlib.suppress(ProcessLookupError):
            self.process.terminate()
        self.process.wait(PATIENCE_S)
        self.process.stdout.close()
        self.log.close()
        if hasattr(self, "client"):
            self.client.close()

    def create(self, **source):
        answer = self.client.post("/api/v1/sessions", json={"name": "test", "source": source})
        assert answer.status_code == 201, answer.text
        return answer.json()["id"]

    def start(self, session_id):
        answer = self.client.post(f"/api/v1/sessions/{session_id}/start")
        assert answer.status_code == 200, answer.text

    def stop_all(self):
        for session in self.client.get("/api/v1/sessions", params={"limit": 1000}).json()["sessions"]:
            if session["state"] in ("created", "scanning", "paused"):
                answer = self.client.post(f"/api/v1/sessions/{session['id']}/stop")
                assert answer.status_code == 200, answer.text

    def status(self, session_id):
        answer = self.client.get(f"/api/v1/sessions/{session_id}")
        assert answer.status_code == 200, answer.text
        return answer.json()

    def kept_account(self, session_id):
        """The account of losses that the record holds of a session; empty before the first."""
        with contextlib.closing(RecordReader.open(self.data / "record.sqlite")) as reader:
            return reader.ledger(session_id) or {}

    def wait_until_kept(self, session_id):
        """Wait until the record holds the account of losses that the service tells."""

        def is_kept():
            kept, told = self.kept_account(session_id), self.status(session_id)["losses"]
            return all(kept.get(part) == told[part] for part in ("lines", "points", "passes"))

        wait_for(is_kept, f"the account of session {session_id} to be in the record")

    def wait_for_state(self, session_id, state):
        wait_for(lambda: self.status(session_id)["state"] == state, f"session {session_id} to be {state}")
        return self.status(session_id)


class RunningSimulator:
    """`python -m simulators` in a process of its own; commands go in, announcements come out."""

    def __init__(self, part="plate", *arguments):
        patient = ["--dead-man", "60"]  # a busy machine is no host that is gone; a later argument says otherwise
        over = ["--turntable"] if part == "turntable" else ["--part", part]
        command = [sys.executable, "-m", "simulators", *over, *patient, *map(str, arguments)]
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT, env=os.environ
        )
        self.ready = json.loads(self.process.stdout.readline())
        self.port = self.ready["port"]

    def tell(self, command):
        self.process.stdin.write(command + "\n")
        self.process.stdin.flush()
        return json.loads(self.process.stdout.readline())

    def end(self):
        self.process.terminate()
        self.process.wait(PATIENCE_S)
        self.process.stdin.close()
        self.process.stdout.close()


def wait_for(condition, what, patience_s=PATIENCE_S, seen=lambda: "nothing"):
    """Poll until the condition holds; fails with a sentence, and with what was seen last, when it never does."""
    deadline_s = time.monotonic() + patience_s
    while not condition():
        if time.monotonic() > deadline_s:
            raise AssertionError(f"waited {patience_s:g} s for {what}; last seen: {seen()}")
        time.sleep(0.05)
