"""Lines that are lost behind the last one of a pass: nothing lies behind them that a region could show beside."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.protocols.native import Decoder
from drivers.protocols.native_messages import Chunk
from drivers.scanline import DeviceInfo, SensorGeometry
from scanner_service.sessions.book import SessionBook
from scanner_service.sessions.lost_ends import LOST_END, lost_behind, unseen_behind
from scanner_service.sessions.source_specs import DeviceSpec
from scanner_service.storage.record import Record
from simulators.devices.native import NativeDevice
from simulators.pty_port import PtyPort

BAUD, POINTS = 4_000_000, 60
SPACING_MM, START_MM, END_MM = 0.25, 10.0, 20.0
LINES = 41


class EndSwallowed(NativeDevice):
    """A device on whose wire the chunks of all lines from one on get lost; the end of the pass gets through."""

    first_lost = LINES
    _held = b""  # the beginning of a frame, or sound frames for which there is no room yet
    _sound = b""

    def transmit(self, now_s: float, room_bytes: int) -> bytes:
        *frames, self._held = (self._held + super().transmit(now_s, room_bytes)).split(b"\0")
        for frame in frames:
            found = Decoder().receive(b"\0" + frame + b"\0")
            if not any(isinstance(item, Chunk) and item.line_index >= self.first_lost for item in found):
                self._sound += frame + b"\0"
        sent, self._sound = self._sound[:room_bytes], self._sound[room_bytes:]
        return sent

    def next_due_s(self, now_s: float) -> float | None:
        return now_s if self._sound else super().next_due_s(now_s)


def scene(stage_mm: float) -> tuple[np.ndarray, np.ndarray]:
    x_mm = np.linspace(-6, 6, POINTS)
    return x_mm, 0.1 * np.sin(x_mm + stage_mm)


@pytest.mark.parametrize(("reaches", "lost"), [(LINES, 0), (LINES - 1, 1), (30, 11), (0, LINES)])
def test_lines_lost_at_the_end_of_a_pass_are_counted_and_told_where(tmp_path, reaches, lost):
    geometry = SensorGeometry(np.array([0.0, 0.0, 90.0]), np.array([0.0, 40.0, 90.0]), (-9.0, 9.0), 0.01)
    info = DeviceInfo("SN-1", "M", "F", "C", 77, POINTS, geometry)
    device = EndSwallowed(info, scene, rng=np.random.default_rng(3), buffer_bytes=4_000_000, dead_man_s=60.0)
    device.first_lost = reaches
    with Record.open(tmp_path / "record.sqlite") as record, PtyPort(device, BAUD) as port:
        book = SessionBook(record)
        session = book.create("end", DeviceSpec(str(port.path), BAUD, SPACING_MM, START_MM, END_MM, 200.0))
        session.start()
        assert session.wait_until_over(120.0)
        said = session.status().message
        told = [event.details for event in record.events(session.row.session_id) if event.kind == LOST_END]
        (account,), device = session.losses()["passes"], session.losses()["device"]
        book.close()
    assert account["lines"]["sent"] == LINES
    assert account["lines"]["stored"] == LINES - lost
    assert sum(account["lines"]["lost"].values()) == lost
    assert device["largest_pause_s"] > 0.0 and device["late_reads"] >= 0  # also when the port is closed
    if not lost:
        assert (said, told) == (None, [])
        return
    (found,) = told
    assert found["lines"] == lost
    assert found["from_mm"] == pytest.approx(START_MM + SPACING_MM * reaches)
    assert found["to_mm"] == pytest.approx(END_MM)
    assert said == found["message"] and "lost" in said


@given(
    st.integers(1, 400), st.integers(0, 400), st.floats(0.01, 3.0), st.floats(-50.0, 50.0), st.sampled_from((1, -1)),
    st.floats(-0.05, 0.05),
)  # fmt: skip
def test_what_is_missing_at_the_end_is_what_was_not_read(lines, read, spacing_mm, start_mm, sign, off):
    """A pass of `lines` lines, of which the first `read` came; the encoder is right to a twentieth of a spacing."""
    read, step_mm = min(read, lines), sign * spacing_mm
    next_mm, end_mm = start_mm + step_mm * (read + off), start_mm + step_mm * (lines - 1)
    found = lost_behind(next_mm, end_mm, step_mm, lines)
    assert (0 if found is None else found.lines) == lines - read
    if found is not None:
        assert found.from_mm == next_mm
        assert found.to_mm == pytest.approx(end_mm, abs=0.1 * spacing_mm)
        assert lost_behind(next_mm, end_mm, step_mm, found.lines - 1) != found  # the accounts bound it


def test_a_scanner_with_a_time_of_its_own_may_measure_its_last_line_a_little_before_the_end():
    assert unseen_behind(58.6, 60.0, 0.6) is None
    found = unseen_behind(40.0, 60.0, 0.5)
    assert found is not None and (found.lines, found.from_mm, found.to_mm) == (40, 40.5, 60.0)
    found = unseen_behind(20.0, 10.0, 0.5)
    assert found is not None and (found.lines, found.from_mm, found.to_mm) == (20, 19.5, 10.0)
