"""A process that stores lines is killed at any instant: every line it acknowledged is there, once and whole.

This proves what the process promises, not what the disk does: the page cache survives a killed process.
"""

import random
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from scanner_service.storage.record import Record
from tests.unit.storage.record_lines import bits, line_of

ROOT = Path(__file__).resolve().parents[2]
POINTS = 600
CHILD = f"""
import os, sys, threading
from pathlib import Path
from scanner_service.storage.record import Record
from scanner_service.storage.rows import Limits
from tests.unit.storage.record_lines import line_of

record = Record.open(Path(sys.argv[1]), limits=Limits(checkpoint_bytes=1 << 18, batch_lines=16))
session, first = sys.argv[2], int(sys.argv[3])

def acknowledge(index):
    def say(future):
        answer = future.result()
        os.write(1, f"{{index}} {{answer.line_number}} {{answer.outcome}}\\n".encode())
    return say

index = first
while True:
    record.append(session, line_of(index, points={POINTS}), timeout_s=60).add_done_callback(acknowledge(index))
    if index % 40 == 0:
        record.append_event(session, "mark", {{"index": index}})
    index += 1
"""


def kill_repeatedly(path: Path, kills: int, rng: random.Random) -> None:
    with Record.open(path) as record:
        session = record.create_session("killed").session_id
    acknowledged: dict[int, int] = {}
    for _ in range(kills):
        first = max(0, len(acknowledged) - 5)  # the last few again: they must be found, not stored twice
        said = say_until_killed([str(path), session, str(first)], rng.uniform(0, 0.15))
        with Record.open(path) as record:
            lines = [(number, line.line_index, bits(line)) for number, line in record.lines(session)]
            count = record.count(session).lines
            event_numbers = [event.number for event in record.events(session) if not event.damaged]
        assert [number for number, _, _ in lines] == list(range(count))
        number_of = {index: number for number, index, _ in lines}
        assert len(number_of) == len(lines), "a line is stored twice"
        for index, number, outcome in said:
            assert number_of[index] == number, f"acknowledged line {index} is lost"
            assert outcome == ("stored" if index not in acknowledged else "duplicate")
        assert all(number_of[index] == number for index, number in acknowledged.items())
        assert all(content == bits(line_of(index, points=POINTS)) for _, index, content in lines[first:])
        assert event_numbers == list(range(len(event_numbers)))
        acknowledged = number_of  # what is in the record now must stay, acknowledged before the kill or not
    assert len(acknowledged) >= kills


def say_until_killed(arguments: list[str], after_s: float) -> list[tuple[int, int, str]]:
    """What a child acknowledged before it was killed, `after_s` after its first acknowledgement."""
    with subprocess.Popen([sys.executable, "-c", CHILD, *arguments], stdout=subprocess.PIPE, cwd=ROOT) as child:
        assert child.stdout is not None
        said = [child.stdout.readline()]
        timer = threading.Timer(after_s, child.send_signal, [signal.SIGKILL])
        timer.start()
        said += child.stdout.readlines()
        timer.join()
        assert child.wait() == -signal.SIGKILL
    whole = [line.split() for line in said if line.endswith(b"\n")]
    return [(int(index), int(number), outcome.decode()) for index, number, outcome in whole]


def test_every_acknowledged_line_survives_a_few_kills(tmp_path: Path) -> None:
    kill_repeatedly(tmp_path / "record.sqlite", 5, random.Random(7))


@pytest.mark.long
@pytest.mark.timeout(3600)
def test_every_acknowledged_line_survives_hundreds_of_kills(tmp_path: Path) -> None:
    for part in range(30):  # a new record now and then, so that reading it all back stays quick
        kill_repeatedly(tmp_path / f"record-{part}.sqlite", 10, random.Random(part))
