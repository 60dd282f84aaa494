"""The live stream's binary messages, read back by hand."""

import numpy as np

from scanner_service.analysis.live_map import LiveMap
from scanner_service.analysis.map_settings import MapSettings
from scanner_service.api.live_frames import FLAG_FULL, HEADER, MAGIC, point_message
from scanner_service.sessions.results import Verdict
from scanner_service.sessions.updates import VerdictBook, changes_since, read_page
from tests.unit.analysis.scans import surface_scan


def scanned():
    live = LiveMap(MapSettings(noise_mm=0.01, max_points=10_000), np.array([100.0, 200.0, 300.0]))
    for line in surface_scan(lambda x, y: 0.2 * x, lines=8):
        live.add(line)
    return live


def read(message):
    head = HEADER.unpack_from(message)
    n, at = head[5], HEADER.size
    rows = np.frombuffer(message, "<u4", n, at)
    xyz = np.frombuffer(message, "<f4", 3 * n, at + 4 * n).reshape(n, 3)
    density = np.frombuffer(message, "<f4", n, at + 16 * n)
    normal = np.frombuffer(message, "<f4", 3 * n, at + 20 * n).reshape(n, 3)
    state = np.frombuffer(message, "<u4", n, at + 32 * n)
    assert len(message) == at + 36 * n
    return head, rows, xyz, density, normal, state


def test_pages_together_say_what_the_map_says_and_only_the_last_carries_the_new_version():
    live, verdicts = scanned(), VerdictBook()
    rescan = np.arange(240) % 3 == 0
    live.refresh()
    verdicts.replace(Verdict(rescan, np.full(240, 5, dtype=np.uint8)), live.version, live)
    changes = changes_since(live, 0)
    messages = [point_message(read_page(live, verdicts, changes, start, 100)) for start in range(0, 240, 100)]
    heads = [read(message)[0] for message in messages]
    assert [head[0] for head in heads] == [MAGIC] * 3
    assert [head[2] for head in heads] == [FLAG_FULL, 0, 0]
    assert [head[3] for head in heads] == [0, 0, live.version]
    assert [head[4] for head in heads] == [0, 0, 0]
    parts = [np.concatenate(column) for column in zip(*(read(message)[1:] for message in messages), strict=True)]
    rows, xyz, density, normal, state = parts
    snapshot = live.snapshot()
    np.testing.assert_array_equal(rows, np.arange(240))
    np.testing.assert_array_equal(xyz, (snapshot.points_mm - live.origin_mm).astype("f4"))
    np.testing.assert_array_equal(density, snapshot.density_per_mm2.astype("f4"))
    np.testing.assert_array_equal(normal, snapshot.normals.astype("f4"))
    np.testing.assert_array_equal(state & 1, snapshot.reliable)
    np.testing.assert_array_equal(state >> 3 & 1, rescan)
    assert (state >> 16 & 255 == 5).all()
    np.testing.assert_array_equal(state >> 8 & 255, snapshot.unreliable)


def test_a_later_update_holds_exactly_what_changed_and_an_empty_map_one_empty_message():
    live, verdicts = scanned(), VerdictBook()
    before = changes_since(live, 0)
    live.add(surface_scan(lambda x, y: 0.2 * x, lines=9)[-1])
    changes = changes_since(live, before.version)
    head, rows, *_ = read(point_message(read_page(live, verdicts, changes, 0, 1000)))
    assert (head[3], head[4]) == (changes.version, before.version)
    assert set(range(240, 270)) <= set(rows.tolist())
    assert len(rows) < 270
    empty = LiveMap(MapSettings(max_points=1000))
    head, rows, *_ = read(point_message(read_page(empty, verdicts, changes_since(empty, 0), 0, 1000)))
    assert (head[2], head[5], head[7]) == (FLAG_FULL, 0, 0)
