"""Recordings of a log scanner: what a hand-made file says is what is read, and the real one whole."""

import gzip
import math
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scanner_service.storage.formats import ReadOptions, open_recording
from scanner_service.storage.formats.errors import (
    ContentDamaged,
    FileEmpty,
    FileTooLarge,
    FileTruncated,
    FormatError,
    LaserUnknown,
    OptionRefused,
    SpacingUnknown,
)
from scanner_service.storage.formats.joescan import is_joescan, read_joescan

REAL = Path(__file__).resolve().parents[4] / "shared" / "data" / "joescan" / "testlog.raw"
GIVEN = ReadOptions(line_spacing_mm=8.0)


def record(encoder, head, camera, points, time_ns=0, encoders=1):
    data = struct.pack("<iiIHi", 0x010203, 0, 0, 100, encoders) + struct.pack(f"<{encoders}q", *[encoder] * encoders)
    data += struct.pack("<IQIIii", 0, time_ns, head, camera, 0, len(points))
    return data + b"".join(struct.pack("<hhB", x, y, 7) for x, y in points)


ABOVE, BELOW = [(-100, 500), (0, 510), (100, 500)], [(100, -500), (0, -510)]
COUNTS = [0, 100, 200, 200, 199, 300]


def small_file():
    return b"".join(
        record(count, 0, 0, ABOVE, 1_000_000 * k + 5) + record(count, 1, 0, BELOW, 1_000_000 * k + 900)
        for k, count in enumerate(COUNTS)
    )


@pytest.mark.parametrize("pack", [bytes, gzip.compress])
def test_what_a_file_says_is_what_is_read(pack, tmp_path):
    path = tmp_path / "log.raw"
    path.write_bytes(pack(small_file()))
    recording = open_recording(path, GIVEN)
    assert recording.format == "joescan"
    assert (recording.points, recording.points_declared, len(recording.lines)) == (30, 30, 12)
    upper = [line for line in recording.lines if line.device_id == "log-head0-camera0"]
    assert [line.line_index for line in upper] == list(range(6))
    # 100 counts are the line spacing; standing and reversed steps are measured as they are.
    assert [line.position_mm for line in upper] == pytest.approx([0, 8, 16, 16, 15.92, 24])
    assert [line.step_mm for line in upper[1:]] == pytest.approx([8, 8, 0, -0.08, 8.08])
    assert math.isnan(upper[0].step_mm)
    assert all(line.line_spacing_mm == 8.0 for line in upper)
    assert [line.device_time_s for line in upper] == pytest.approx([0.001 * k for k in range(6)])
    np.testing.assert_allclose(upper[1].points_mm, [[-25.4, 8, 127], [0, 8, 129.54], [25.4, 8, 127]])
    assert upper[1].laser_mm[2] > 1000
    assert recording.lines[1].laser_mm[2] < -1000
    assert any("0.08 mm" in note for note in recording.notes)


def test_a_laser_that_was_given_is_every_line_s(tmp_path):
    recording = read_joescan(small_file(), "log.raw", ReadOptions(line_spacing_mm=8.0, laser_mm=(1.0, math.nan, 900.0)))
    np.testing.assert_allclose([line.laser_mm for line in recording.lines[:3]], [[1, 0, 900], [1, 0, 900], [1, 8, 900]])
    with pytest.raises(OptionRefused, match="only y"):
        read_joescan(small_file(), "log.raw", ReadOptions(line_spacing_mm=8.0, laser_mm=(math.nan, 0.0, 900.0)))


def test_floating_points_are_read_in_their_own_unit():
    floating = struct.pack("<iB", 0x010204, 0) + record(100, 0, 0, [])[4:-4] + struct.pack("<i", 1)
    floating += struct.pack("<fff", 1.0, 2.0, 3.0)
    recording = read_joescan(small_file() + floating, "log.raw", GIVEN)
    np.testing.assert_allclose(recording.lines[-1].points_mm, [[25.4, 8.0, 50.8]])


@pytest.mark.parametrize(
    ("data", "options", "error", "said"),
    [
        (small_file(), ReadOptions(), SpacingUnknown, "--line-spacing"),
        (small_file()[:-1], GIVEN, FileTruncated, "middle of profile 11"),
        (small_file() + b"\0\0\0\0", GIVEN, ContentDamaged, "no mark of a profile"),
        (record(0, 0, 0, ABOVE), GIVEN, SpacingUnknown, "never moves"),
        (record(0, 0, 0, ABOVE) + record(9, 0, 0, ABOVE), GIVEN, LaserUnknown, "--laser"),
        (record(0, 0, 0, []) + record(9, 0, 0, []), GIVEN, FileEmpty, "no point"),
        (record(0, 0, 0, ABOVE, encoders=65), GIVEN, ContentDamaged, "65 encoders"),
        (record(0, 0, 0, [])[:-4] + struct.pack("<i", 2**31 - 1), GIVEN, ContentDamaged, "2147483647 points"),
        (gzip.compress(small_file())[:-9], GIVEN, FileTruncated, "compressed"),
        (gzip.compress(small_file()), ReadOptions(line_spacing_mm=8.0, max_bytes=300), FileTooLarge, "expands to more"),
        (small_file(), ReadOptions(line_spacing_mm=8.0, units="m"), OptionRefused, "hundredths"),
    ],
)
def test_what_is_wrong_is_told(data, options, error, said):
    assert is_joescan(data)
    with pytest.raises(error, match=said):
        read_joescan(data, "log.raw", options)


@given(st.data())
def test_a_damaged_file_is_read_or_refused_and_never_more(data):
    content = bytearray(small_file())
    for _ in range(data.draw(st.integers(1, 6))):
        content[data.draw(st.integers(4, len(content) - 1))] = data.draw(st.integers(0, 255))
    with np.errstate(all="ignore"):
        try:
            read_joescan(bytes(content), "log.raw", GIVEN)
        except FormatError as error:
            assert str(error)


@pytest.mark.skipif(not REAL.exists(), reason="the real scans are not beside this checkout")
def test_the_real_log_is_read_whole_with_its_stops_and_reversals():
    recording = open_recording(REAL, ReadOptions(line_spacing_mm=8.26))
    assert len(recording.lines) == 11_231
    assert recording.points == recording.points_declared == 1_062_200
    devices = {line.device_id for line in recording.lines}
    assert len(devices) == 6
    for device in devices:
        steps = np.array([line.step_mm for line in recording.lines if line.device_id == device])[1:]
        assert 960 <= (steps == 0).sum() <= 980
        assert 20 <= (steps < 0).sum() <= 40
        assert np.median(steps[steps > 4]) == pytest.approx(8.26, rel=0.01)
    # Each laser stands outside, before the points that its head sees.
    for line in recording.lines[::500]:
        if len(line.points_mm) > 20:
            towards = line.laser_mm - np.nanmedian(line.points_mm, axis=0)
            assert float(towards @ np.nanmedian(line.points_mm - [11.4, line.position_mm, 165.0], axis=0)) > 0
