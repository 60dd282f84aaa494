"""A scan lists the same regions to everybody: live, opened again, exported, and played again from its record."""

import json
import math

import numpy as np
import pytest

from scanner_service.rescan.judgement import REMEDIES, Reason
from scanner_service.rescan.region import RegionStatus, RescanRegion
from scanner_service.sessions.book import SessionBook
from scanner_service.sessions.fingerprint import verdict_sha256
from scanner_service.sessions.replay_source import ReplaySource
from scanner_service.sessions.settings import SessionSettings
from scanner_service.sessions.source_specs import PushSpec, RecordSpec
from scanner_service.sessions.stored import find_session, read_session
from scanner_service.storage.reader import RecordReader
from scanner_service.storage.record import Record
from tests.unit.analysis.scans import surface_scan

SETTINGS = SessionSettings(max_points=20_000)


def _cliff_and_steps(x, y):
    return np.where(x < 0.0, 0.0, 1.5) + 0.2 * np.sin(3 * y)


def _pass(number, spacing, seed):
    return surface_scan(
        _cliff_and_steps, lines=int(5.6 / spacing), points=40, spacing=spacing, rng=np.random.default_rng(seed),
        noise_mm=0.002, pass_index=number, boot_id=number + 1,
    )  # fmt: skip


def _told(results):
    """Everything that is listed of regions, as it is exported."""
    told = results.regions_dict()
    return json.loads(json.dumps({name: told[name] for name in ("regions", "resolved")}, allow_nan=False))


def _stored(path):
    reader = RecordReader.open(path)
    try:
        return read_session(reader, find_session(reader, "latest")).results
    finally:
        reader.close()


def _played_again(path, kept):
    reader = RecordReader.open(path)
    with Record.open(kept) as record:
        book = SessionBook(record)
        spec = RecordSpec.find(reader, None)
        settings = SessionSettings.from_dict(spec.session.settings)
        session = book.create("again", spec, settings, spec.session.origin_mm)
        session.start()
        assert session.wait_until_over(60)
        found = session.results()
        book.close()
    reader.close()
    return found


@pytest.fixture
def scanned(tmp_path):
    """A record of two passes, after the first of which a shadow was listed that the last report does not have."""
    path = tmp_path / "record.sqlite"
    with Record.open(path) as record:
        book = SessionBook(record)
        first = _pass(0, 0.4, 1)
        session = book.create("two passes", PushSpec(), SETTINGS, source=ReplaySource(first, len(first)))
        session.start()
        assert session.wait_until_over(60)
        _list_a_wall_that_no_later_report_has(session)
        second = _pass(1, 0.2, 2)
        session.carry_out(lambda: ReplaySource(second, len(second)))
        assert session.wait_until_over(60)
        live = session.fresh_results()
        session_id = session.row.session_id
        book.close()
    return path, session_id, live


def _list_a_wall_that_no_later_report_has(session):
    """A report with one region more: a high wall through the middle of the plate, where nothing is measured."""
    results = session.results()
    wall = RescanRegion(
        number=1,
        reason=Reason.SHADOW,
        outline_mm=(
            np.array([[x, y, z] for x, z in ((-1.0, 0.0), (1.0, 0.0), (1.0, 40.0), (-1.0, 40.0)) for y in (0.0,)]),
        ),
        area_mm2=18.0,
        centroid_mm=np.array([0.0, 0.0, 20.0]),
        normal=np.full(3, math.nan),
        measured_per_mm2=0.0,
        required_per_mm2=math.nan,
        counting_error_per_mm2=math.nan,
        priority=0.4,
        point_count=2,
        remedy=REMEDIES[Reason.SHADOW],
        point_rows=np.array([300, 301]),
    )
    session._judgement._regions.follow(results.snapshot, (*results.report.regions, wall))


def test_the_same_regions_are_listed_live_stored_reopened_and_replayed(scanned, tmp_path):
    path, session_id, live = scanned
    extra = [region for region in live.resolved if region.reason is Reason.SHADOW and region.area_mm2 == 18.0]
    assert [region.status for region in extra] == [
        RegionStatus.RESOLVED
    ]  # of which the last report alone knows nothing
    stored, again = _stored(path), _played_again(path, tmp_path / "again.sqlite")
    assert verdict_sha256(stored) == verdict_sha256(again) == verdict_sha256(live)
    assert _told(stored) == _told(live)
    assert _told(again) == _told(live)
    assert _told(_stored(tmp_path / "again.sqlite")) == _told(live)
    with Record.open(path) as record:
        book = SessionBook(record)
        reopened = book.get(session_id)
        assert _told(reopened.fresh_results()) == _told(live)
        book.close()


def test_what_is_said_of_a_region_after_the_scan_is_in_every_list(scanned, tmp_path):
    path, session_id, live = scanned
    chosen = live.regions[-1].region_id
    with Record.open(path) as record:
        book = SessionBook(record)
        session = book.get(session_id)
        session.fresh_results()
        session.mark_region(chosen, RegionStatus.UNREACHABLE, "no pose sees it")
        marked = session.results()
        assert len(marked.regions) == len(live.regions)
        book.close()
    status = {region.region_id: region.status for region in marked.regions}
    assert status[chosen] is RegionStatus.UNREACHABLE
    assert _told(_stored(path)) == _told(marked)
    assert _told(_played_again(path, tmp_path / "again.sqlite")) == _told(marked)


def test_a_pass_withdrawn_after_the_scan_leaves_one_list(scanned):
    path, session_id, live = scanned
    with Record.open(path) as record:
        book = SessionBook(record)
        session = book.get(session_id)
        session.fresh_results()
        assert session.withdraw_pass(("A", 2, 1)) > 0
        left = session.results()
        book.close()
    assert verdict_sha256(left) != verdict_sha256(live)
    assert _told(_stored(path)) == _told(left)
