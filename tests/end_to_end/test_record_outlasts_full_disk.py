"""A file size limit of the operating system stands for a full disk: nothing acknowledged is lost, work resumes."""

import subprocess
import sys
from pathlib import Path

import pytest

from scanner_service.storage.record import Record
from tests.unit.storage.record_lines import bits, line_of

ROOT = Path(__file__).resolve().parents[2]
CHILD = """
import resource, sys
from pathlib import Path
from scanner_service.storage.errors import RecordBusy
from scanner_service.storage.record import Record
from scanner_service.storage.rows import Limits
from tests.unit.storage.record_lines import line_of

record = Record.open(Path(sys.argv[1]), limits=Limits(checkpoint_bytes=1 << 18, spool_bytes=1 << 18))
session = record.create_session("full").session_id
resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 20, resource.RLIM_INFINITY))
taken, refused = [], 0
while not refused:
    try:
        taken.append(record.append(session, line_of(len(taken), points=600), timeout_s=1.0))
    except RecordBusy:
        refused += 1
state = record.writer_state()
durable = sum(future.done() for future in taken)
readable = sum(1 for _ in record.lines(session))
assert state.state == "failing", state
assert durable == readable == state.stored, (durable, readable, state)
assert 0 < state.waiting_lines == len(taken) - durable, (durable, len(taken), state)
resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
assert [future.result(timeout_s=30).line_number for future in taken] == list(range(len(taken)))
state = record.writer_state()
assert (state.state, state.stored, state.duplicates, state.refused) == ("ok", len(taken), 0, 1), state
record.append(session, line_of(len(taken), points=600)).result(timeout_s=30)
record.close()
print(session, len(taken) + 1)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="needs a POSIX file size limit")
def test_a_full_disk_holds_up_lines_loses_none_and_work_goes_on_when_there_is_room(tmp_path: Path) -> None:
    command = [sys.executable, "-c", CHILD, str(tmp_path / "record.sqlite")]
    child = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT, timeout=100)
    assert child.returncode == 0, child.stderr
    session, count = child.stdout.split()
    with Record.open(tmp_path / "record.sqlite") as record:
        read = [bits(line) for _, line in record.lines(session)]
        assert read == [bits(line_of(index, points=600)) for index in range(int(count))]
        assert record.verify(session).problems == ()
