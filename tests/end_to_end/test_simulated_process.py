"""The simulated scanner as its own process: told by its parent, spoken to over its terminal, gone when it should be."""

import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import serial

from drivers.protocols.native import Decoder, encode
from drivers.protocols.native_messages import (
    NM_PER_MM,
    NO_RETURN,
    TENTH_UM_PER_MM,
    Chunk,
    EndOfPass,
    EndReason,
    Hello,
    HelloRequest,
    Keepalive,
    Laser,
    Message,
    Start,
)

BAUD = 3_000_000


@contextmanager
def simulator(*arguments: str) -> Iterator[tuple[subprocess.Popen[str], dict[str, Any]]]:
    """A simulator and what it announced; its input is a pipe."""
    process = subprocess.Popen(
        [sys.executable, "-m", "simulators", *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    try:
        line = process.stdout.readline()
        assert line, process.communicate()[1]
        yield process, json.loads(line)
    finally:
        process.kill()
        process.communicate()


def tell(process: subprocess.Popen[str], command: str) -> dict[str, Any]:
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write(command + "\n")
    process.stdin.flush()
    answer: dict[str, Any] = json.loads(process.stdout.readline())
    return answer


class Host:
    """Just enough of a host: says commands, collects messages, holds the dead-man off."""

    def __init__(self, port: str) -> None:
        self.line = serial.Serial(port, BAUD, timeout=0.05)
        self.decoder = Decoder()
        self.messages: list[Message] = []
        self.damaged = 0

    def until(self, kind: type[Message], patience_s: float = 30.0) -> Any:
        deadline = time.monotonic() + patience_s
        while time.monotonic() < deadline:
            self.line.write(encode(Keepalive(999)))
            for item in self.decoder.receive(self.line.read(16_384)):
                if isinstance(item, Message):
                    self.messages.append(item)
                else:
                    self.damaged += 1
                if isinstance(item, kind):
                    return item
        raise AssertionError(f"no {kind.__name__} came")

    def scan(self, first_mm: float, last_mm: float, spacing_mm: float) -> Any:
        self.line.write(encode(Laser(2, True)))
        span = round(spacing_mm * NM_PER_MM), round(first_mm * NM_PER_MM), round(last_mm * NM_PER_MM)
        self.line.write(encode(Start(3, *span, line_rate_mhz=50_000)))
        return self.until(EndOfPass)


def test_a_scan_of_the_plate_comes_out_of_the_terminal_as_the_plate() -> None:
    with simulator("--part", "plate", "--seed", "3") as (_, ready):
        host = Host(ready["port"])
        host.line.write(encode(HelloRequest(1)))
        hello: Hello = host.until(Hello)
        assert (hello.info.device_id, hello.info.boot_id) == ("SIM-0001", ready["boot_id"])
        assert hello.info.points_per_line == 400
        np.testing.assert_allclose(hello.info.geometry.laser_mm, [0.0, 0.0, 150.0])
        end = host.scan(10.0, 20.0, 0.5)
        host.line.close()
    assert end.status.end_reason == EndReason.REACHED_END
    assert host.damaged == 0
    chunks = [message for message in host.messages if isinstance(message, Chunk)]
    assert sorted({chunk.line_index for chunk in chunks}) == list(range(21))
    assert sum(len(chunk.points) for chunk in chunks) == 21 * 400
    xz_mm = np.concatenate([chunk.points[chunk.points[:, 0] != NO_RETURN] for chunk in chunks]) / TENTH_UM_PER_MM
    # The plate is 40 mm of the fan's 50; its noise is 0.01 mm.
    assert len(xz_mm) == pytest.approx(21 * 400 * 40 / 50, rel=0.02)
    assert np.abs(xz_mm[:, 0]).max() < 20.1
    assert np.std(xz_mm[:, 1]) == pytest.approx(0.01, rel=0.1)


def test_faults_given_on_the_command_line_damage_the_stream() -> None:
    with simulator("--part", "plate", "--bit-error-rate", "1e-4") as (_, ready):
        host = Host(ready["port"])
        host.scan(10.0, 20.0, 0.5)
        host.line.close()
    assert host.damaged > 0


def test_the_cable_can_be_pulled_and_the_scanner_rebooted_by_the_parent(tmp_path: Path) -> None:
    link = tmp_path / "scanner"
    with simulator("--link", str(link)) as (process, ready):
        assert ready["port"] == str(link)
        assert tell(process, "unplug")["port"] is None
        assert not link.is_symlink()
        assert tell(process, "replug")["port"] == str(link)
        assert tell(process, "reboot")["boot_id"] != ready["boot_id"]
        assert "no command" in tell(process, "jump")["reason"]
        host = Host(str(link))
        host.line.write(encode(HelloRequest(1)))
        assert host.until(Hello).info.boot_id != ready["boot_id"]
        host.line.close()
        assert tell(process, "stop")["event"] == "stop"
        assert process.wait(10.0) == 0
    assert not link.is_symlink()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_it_with_success_and_takes_the_link_away(tmp_path: Path, number: signal.Signals) -> None:
    link = tmp_path / "scanner"
    with simulator("--link", str(link)) as (process, _):
        process.send_signal(number)
        assert process.wait(10.0) == 0
    assert not link.is_symlink()


def test_it_ends_when_its_parent_is_gone() -> None:
    with simulator() as (process, _):
        assert process.stdin is not None
        process.stdin.close()
        assert process.wait(10.0) == 0
        process.stdin = None


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--mesh", "absent.stl"], "there is no mesh file"),
        (["--bit-error-rate", "2"], "chance between 0 and 1"),
        (["--baud", "0"], "baud rate must be greater than 0"),
    ],
)
def test_bad_input_is_told_in_one_sentence(arguments: list[str], said: str) -> None:
    run = subprocess.run([sys.executable, "-m", "simulators", *arguments], capture_output=True, text=True, check=False)
    assert run.returncode == 1
    assert said in run.stderr
    assert run.stderr.count("\n") == 1
