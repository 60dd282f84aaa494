"""The loop that a newcomer watches: a simulated arm carries out what the service orders, over REST alone."""

import subprocess
import sys

import pytest

from scanner_service.commands.demo_loop import watch_loop
from tests.end_to_end.running import ROOT


def test_a_simulated_arm_carries_out_what_the_loop_orders_and_its_passes_bring_what_they_promise(service, capsys):
    session_id = watch_loop(service.client, "step", seed=1)
    told = capsys.readouterr().err.splitlines()
    assert told[0].startswith("one coarse pass from above: observed coverage ")
    assert told[-1] == "The loop ended: the observed coverage of 97.0% is reached."
    where = f"/api/v1/sessions/{session_id}"
    orders = service.client.get(f"{where}/pass-orders").json()["orders"]
    fates = [said for said in told if said.startswith("pass ") and "under way" not in said]
    for order, said in zip(orders, fates, strict=True):
        outcome = order["outcome"]
        assert order["status"] == "done" and order["reached_end"] and outcome["doubt"] is None
        assert said.startswith(f"pass {order['order']}, ") and f"promised {outcome['promised_mm2']:.0f} mm²" in said
    first = orders[0]["outcome"]
    assert first["reached_mm2"] > 0.75 * first["promised_mm2"] > 10.0
    assert f"{service.status(session_id)['coverage']:.1%}" in fates[-1]


@pytest.mark.long
def test_the_demo_part_is_mended_while_one_watches(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "scanner_service", "demo", "--loop", "--out", str(tmp_path / "out")],
        capture_output=True, text=True, cwd=ROOT, timeout=3000, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    passes = [line for line in done.stderr.splitlines() if line.startswith("pass ") and "under way" not in line]
    assert len(passes) >= 3
    assert "The loop ended: the observed coverage of 97.0% is reached." in done.stderr
    assert float(passes[-1].split()[-1].rstrip("%")) >= 97.0
    assert (tmp_path / "out" / "points.ply").exists()
