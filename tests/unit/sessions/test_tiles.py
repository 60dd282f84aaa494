"""A session read in slabs says of every point what a map of the whole session says."""

import numpy as np
import pytest

from scanner_service.sessions.settings import SessionSettings
from scanner_service.sessions.stored import find_session, read_session
from scanner_service.sessions.tiles import read_in_tiles
from scanner_service.storage.exports.errors import NotExportable
from scanner_service.storage.reader import RecordReader
from scanner_service.storage.record import Record
from tests.unit.analysis.scans import surface_scan

COLUMNS = (
    *(
        "points_mm",
        "line",
        "index",
        "radius_mm",
        "radius_rule",
        "neighbours",
        "same_side",
        "density_per_mm2",
        "normals",
    ),
    *("unreliable", "settled", "isolated", "offset", "residual_mm", "normal_error_rad"),
)


def height(x, y):
    """Waves, and a step that is steep enough for radii to grow."""
    return 0.4 * np.sin(2 * x) + np.where(np.abs(x) < 0.7, 3.0, 0.0) + np.where(y > 4, 2.5 * (y - 4), 0.0)


def recorded(path, settings, withdraw=False):
    rng = np.random.default_rng(3)
    lines = surface_scan(height, lines=30, points=70, spacing=0.25, rng=rng, noise_mm=0.003)
    lines += surface_scan(height, lines=45, points=50, spacing=0.15, rng=rng, noise_mm=0.003, pass_index=1, boot_id=2)
    lines += surface_scan(height, lines=12, points=40, spacing=0.3, along=0.5, pass_index=2, boot_id=3, rng=rng)
    with Record.open(path) as record:
        row = record.create_session("s", state="stopped", settings=settings.to_dict(), origin_mm=(5.0, 0.25, -3.0))
        for number, line in enumerate(lines):
            record.append(row.session_id, line).result(10)
            if number == 20:  # a scan that ended within its pass, and went on
                record.append_event(row.session_id, "losses", {}).result(10)
        if withdraw:
            named = {"device_id": "A", "boot_id": 2, "pass_index": 1}
            record.append_event(row.session_id, "pass_withdrawn", named).result(10)


@pytest.mark.parametrize("points_at_once", [1, 1500, 10**6])
@pytest.mark.parametrize(("rule", "withdraw"), [("line", False), ("line", True), ("flexible", False)])
def test_slabs_of_any_size_say_what_the_whole_says(tmp_path, rule, withdraw, points_at_once):
    recorded(tmp_path / "record.sqlite", SessionSettings(radius_rule=rule, max_points=20_000), withdraw)
    reader = RecordReader.open(tmp_path / "record.sqlite")
    row = find_session(reader, "latest")
    whole = read_session(reader, row)
    tiled = read_in_tiles(reader, row, points_at_once)
    blocks = list(tiled.stream.blocks())
    reader.close()
    assert tiled.raw_sha256 == whole.raw_sha256
    assert (tiled.slabs == 1) == (points_at_once == 10**6)
    assert tiled.stream.total == sum(len(block) for block in blocks) == len(whole.results.snapshot)
    for name in COLUMNS:
        joined = np.concatenate([getattr(block.points, name) for block in blocks])
        order = np.lexsort([np.concatenate([getattr(b.points, key) for b in blocks]) for key in ("index", "line")])
        np.testing.assert_array_equal(joined[order], getattr(whole.results.snapshot, name), err_msg=name)
    box = (tiled.stream.low_q, tiled.stream.high_q)
    q = (whole.results.snapshot.points_mm - whole.results.snapshot.origin_mm) * 2**13
    np.testing.assert_array_equal(box, [q.min(axis=0), q.max(axis=0)])


def test_one_radius_for_all_cannot_be_told_from_parts(tmp_path):
    recorded(tmp_path / "record.sqlite", SessionSettings(radius_rule="global", max_points=20_000))
    reader = RecordReader.open(tmp_path / "record.sqlite")
    with pytest.raises(NotExportable, match="one radius for the whole cloud"):
        read_in_tiles(reader, find_session(reader, "latest"), 100)
    reader.close()
