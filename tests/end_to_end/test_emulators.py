"""Our Marlin driver against a printer that others wrote: OctoPrint's virtual Marlin, with its scripted errors.

It runs in an interpreter of its own (`make .venv/emulators`), behind a pseudo-terminal.
"""

import subprocess

import pytest

from drivers.errors import StageRefused
from tests.end_to_end.running import ROOT
from tests.end_to_end.stages import open_stage

PYTHON = ROOT / ".venv" / "octoprint" / "bin" / "python"
SCRIPT = ROOT / "tests" / "end_to_end" / "clients" / "octoprint_printer.py"
COUNTS_PER_MM = 100.0  # the virtual printer's step counts are hundredths of a millimetre, whatever its M92 says


@pytest.fixture
def printer():
    """Start a virtual printer with scripted errors, and return its port."""
    if not PYTHON.exists():
        pytest.skip("OctoPrint is not installed; `make .venv/emulators` does it")
    started = []

    def start(*errors):
        process = subprocess.Popen([PYTHON, "-W", "ignore", SCRIPT, *errors], stdout=subprocess.PIPE, text=True)
        started.append(process)
        path = process.stdout.readline().strip()
        assert path, "the virtual printer did not start"
        return path

    yield start
    for process in started:
        process.kill()
        process.wait()
        process.stdout.close()


def test_octoprint_s_virtual_marlin_homes_moves_and_is_believed_through_its_scripted_errors(printer):
    port = printer("30:resend", "45:checksum_mismatch", "60:missing_lineno")
    with open_stage("marlin", port, steps_per_unit=COUNTS_PER_MM) as stage:
        assert stage.home().position_mm == 0.0
        for number in range(14):  # some seventy lines: all three errors are among them
            target_mm = 1.0 + 0.37 * (number % 5)
            assert stage.move_to(target_mm, 20.0).position_mm == pytest.approx(target_mm, abs=0.011)
        assert stage.position_known
        assert stage._host._sent.number > 62
        assert stage.stage_events() == []


def test_a_motion_that_the_virtual_marlin_counted_but_never_carried_out_is_told_to_have_failed(printer):
    port = printer("10:resend_with_timeout")  # the line of the first motion
    with open_stage("marlin", port, steps_per_unit=COUNTS_PER_MM) as stage:
        stage.home()
        first = stage._host._sent.number
        outcomes = []
        for target_mm in (2.0, 3.0, 2.0):
            try:
                outcomes.append(stage.move_to(target_mm, 20.0).position_mm == pytest.approx(target_mm, abs=0.011))
            except StageRefused as refusal:
                assert "instead of" in str(refusal)
                outcomes.append("refused")
        assert first < 10 < stage._host._sent.number
        assert outcomes.count("refused") <= 1  # a lost motion, or only a lost question, whichever was line 10
        assert all(outcome == "refused" or outcome for outcome in outcomes)
        assert outcomes[-1] is not False


def test_a_stop_reaches_octoprint_s_virtual_marlin_and_it_must_home_again(printer):
    with open_stage("marlin", printer(), steps_per_unit=COUNTS_PER_MM) as stage:
        stage.home()
        stage.start_move(40.0, 10.0)
        stage.stop()
        assert not stage.position_known
        stage.home()
        assert stage.move_to(5.0, 20.0).position_mm == pytest.approx(5.0, abs=0.011)
