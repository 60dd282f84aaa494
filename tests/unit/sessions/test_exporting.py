"""A session written out tells the truth of the record, and goes elsewhere without losing a bit."""

import json
import struct
import sys
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest

from drivers.scanline import SensorGeometry
from scanner_service.sessions.book import SessionBook
from scanner_service.sessions.errors import SourceUnusable
from scanner_service.sessions.exporting import FORMATS, RECORD_FILE, export_session
from scanner_service.sessions.fingerprint import raw_sha256, verdict_sha256
from scanner_service.sessions.references import open_reference
from scanner_service.sessions.replay_source import ReplaySource
from scanner_service.sessions.reporting import report_of
from scanner_service.sessions.settings import SessionSettings
from scanner_service.sessions.source_specs import PushSpec, RecordSpec, ReplaySpec
from scanner_service.sessions.stored import find_session, pass_ends, read_session
from scanner_service.storage.exports.errors import ExtraMissing, FormatNotWritten, NotExportable
from scanner_service.storage.exports.manifest import verify_folder
from scanner_service.storage.exports.report_html import report_html
from scanner_service.storage.exports.report_pdf import report_pdf
from scanner_service.storage.formats import open_cloud, open_recording
from scanner_service.storage.formats.recording import ReadOptions
from scanner_service.storage.formats.reference_mesh import ReferenceSpec
from scanner_service.storage.reader import RecordReader
from scanner_service.storage.record import Record
from tests.unit.analysis.scans import surface_scan
from tests.unit.rescan.test_reference import block
from tests.unit.storage.record_lines import bits

SETTINGS = SessionSettings(max_points=20_000)
OPTICS = SensorGeometry(np.array([0.0, 0.0, 90.0]), np.array([30.0, 0.0, 90.0]), (-9.0, 9.0), 0.01)
NOW = datetime(2026, 11, 26, 9, 0, tzinfo=UTC)


def two_passes():
    """A bumpy plate, coarse at first, then its middle once more and finer."""

    def height(x, y):
        return 0.3 * np.sin(3 * x) + np.where(np.abs(x) < 0.5, 0.0, 0.2)

    coarse = surface_scan(height, lines=14, points=40, spacing=0.4, rng=np.random.default_rng(1), noise_mm=0.002)
    fine = surface_scan(
        height, lines=20, points=40, spacing=0.2, rng=np.random.default_rng(2), noise_mm=0.002, pass_index=1, boot_id=2
    )
    return coarse + fine


@pytest.fixture(scope="module")
def scanned(tmp_path_factory):
    """A record with one session of two passes; its path, id and the live verdict's hash."""
    path = tmp_path_factory.mktemp("record") / "record.sqlite"
    lines = two_passes()
    with Record.open(path) as record:
        book = SessionBook(record)
        session = book.create("two passes", PushSpec(), SETTINGS, (1.0, 2.0, 3.0), ReplaySource(lines, len(lines)))
        session.start()
        assert session.wait_until_over(60)
        live = verdict_sha256(session.results())
        book.close()
    return path, session.row.session_id, live


def read(path, wanted="latest", **options):
    reader = RecordReader.open(path)
    try:
        return read_session(reader, find_session(reader, wanted), **options)
    finally:
        reader.close()


def export(path, formats, folder, wanted="latest"):
    reader = RecordReader.open(path)
    told = []
    try:
        row = find_session(reader, wanted)
        return export_session(reader, row, formats, folder, NOW, lambda what, share: told.append((what, share)))
    finally:
        reader.close()
        assert all(0 <= share <= 1 for _, share in told)


def replayed(path, kept):
    """The session of a record played through the live pipeline into another record; the verdict's hash."""
    reader = RecordReader.open(path)
    with Record.open(kept) as record:
        book = SessionBook(record)
        spec = RecordSpec.find(reader, None)
        settings = SessionSettings.from_dict(spec.session.settings)
        session = book.create("again", spec, settings, spec.session.origin_mm)
        session.start()
        assert session.wait_until_over(60)
        found = verdict_sha256(session.results())
        book.close()
    reader.close()
    return found


def test_what_was_said_live_is_said_again_of_the_record_of_its_copy_and_of_a_replay_of_that(scanned, tmp_path):
    path, session_id, live = scanned
    stored = read(path)
    assert verdict_sha256(stored.results) == live
    manifest = export(path, ["record"], tmp_path / "copy")
    copy = tmp_path / "copy" / RECORD_FILE
    there = read(copy, session_id)
    assert verdict_sha256(there.results) == live == manifest["verdict_sha256"]
    assert there.raw_sha256 == stored.raw_sha256 == manifest["raw_sha256"] == raw_sha256(two_passes())
    assert replayed(copy, tmp_path / "elsewhere.sqlite") == live


def test_the_hash_of_a_verdict_sees_the_last_bit(scanned):
    results = read(scanned[0]).results
    normals = results.snapshot.normals.copy()
    at = np.flatnonzero(results.snapshot.reliable)[0]
    normals[at, 0] = np.nextafter(normals[at, 0], 9)
    other = replace(results, snapshot=replace(results.snapshot, normals=normals))
    assert verdict_sha256(other) != verdict_sha256(results)
    assert verdict_sha256(replace(results, snapshot=replace(results.snapshot, version=99))) == verdict_sha256(results)


def test_a_copy_is_one_file_with_every_row_as_it_was(scanned, tmp_path):
    path, session_id, _ = scanned
    export(path, ["record"], tmp_path)
    assert {item.name for item in tmp_path.iterdir()} == {RECORD_FILE, "manifest.json"}
    ours, copy = RecordReader.open(path), RecordReader.open(tmp_path / RECORD_FILE)
    assert ours.get_session(session_id) == copy.get_session(session_id)
    assert list(ours.events(session_id)) == list(copy.events(session_id))
    lines = list(copy.lines(session_id))
    assert [bits(line) for _, line in lines] == [bits(line) for line in two_passes()]
    assert copy.verify(session_id).problems == ()
    assert copy.verify(session_id).damaged == ()
    copy.close()
    ours.close()
    with Record.open(tmp_path / RECORD_FILE) as record:  # and a service may work with it
        assert record.count(session_id).lines == 34


def test_every_format_is_written_listed_and_sound(scanned, tmp_path):
    path, session_id, _ = scanned
    try:
        manifest = export(path, FORMATS, tmp_path)
    except ExtraMissing as missing:
        pytest.skip(str(missing))
    assert verify_folder(tmp_path).problems == verify_folder(tmp_path).unlisted == ()
    assert manifest["session"] == session_id
    assert manifest["written_utc"] == "2026-11-26T09:00:00Z"
    assert manifest["settings"] == SETTINGS.to_dict()
    stored = read(path)
    assert manifest["points"] == len(stored.results.snapshot)
    np.testing.assert_array_equal(open_cloud(tmp_path / "points.csv").points_mm, stored.results.snapshot.points_mm)
    regions = json.loads((tmp_path / "regions.json").read_text())["regions"]
    assert len(regions) == len(stored.results.report.regions)


def test_stages_tell_what_was_known_after_each_pass(scanned):
    path, _, live = scanned
    stored = read(path, with_stages=True)
    assert [stage.lines for stage in stored.stages] == [14, 34]
    assert [stage.passes[0][2] for stage in stored.stages] == [0, 1]
    assert stored.pass_ends == 2
    assert verdict_sha256(stored.results) == live  # that somebody looked on the way changes nothing
    assert stored.first is not None
    assert len(stored.first.snapshot) == 14 * 40
    assert stored.stages[0].points < stored.stages[1].points


def test_a_session_scanned_from_several_sides_is_judged_the_same_live_reopened_and_exported(tmp_path):
    lines = two_passes()
    path = tmp_path / "record.sqlite"

    def source_of(part, towards):
        source = ReplaySource(part, len(part))
        source.geometry, source.towards_sensor = OPTICS, np.array(towards)
        return source

    with Record.open(path) as record:
        book = SessionBook(record)
        spec = ReplaySpec(tmp_path / "scan.ply", ReadOptions())
        session = book.create("sides", spec, SETTINGS, source=source_of(lines[:14], [0.0, 0.0, 1.0]))
        session.start()
        assert session.wait_until_over(60)
        after_one = verdict_sha256(session.results())
        session.carry_out(lambda: source_of(lines[14:], [0.0, 0.6, 0.8]))
        assert session.wait_until_over(60)
        live = session.fresh_results()
        book.close()
    with Record.open(path) as record:
        book = SessionBook(record)
        reopened = book.get(session.row.session_id)
        assert reopened.source.towards_sensor is None
        again = reopened.fresh_results()
        book.close()
    stored = read(path, with_stages=True)
    assert verdict_sha256(again) == verdict_sha256(live) == verdict_sha256(stored.results)
    assert verdict_sha256(stored.first) == after_one
    assert stored.row.calibration["towards_sensor"] == [0.0, 0.0, 1.0]
    told = [
        [(region.region_id, region.area_mm2) for region in found.regions] for found in (live, again, stored.results)
    ]
    assert told[0] == told[1] == told[2] and told[0]


def test_a_reference_mesh_is_in_verdict_and_report_or_said_to_be_missing(tmp_path):
    meshes = tmp_path / "meshes"
    meshes.mkdir()
    corners = (block((8.0, 8.0, 1.0)) - [4.0, 1.0, 0.0]).astype("<f4")
    triangles = b"".join(bytes(12) + corner.tobytes() + bytes(2) for corner in corners)
    (meshes / "nominal.stl").write_bytes(bytes(80) + struct.pack("<I", len(corners)) + triangles)
    surface, named = open_reference(ReferenceSpec("nominal.stl"), meshes)
    settings = replace(SETTINGS, reference=named)
    lines = two_passes()
    path = tmp_path / "record.sqlite"
    with Record.open(path) as record:
        book = SessionBook(record, meshes=meshes)
        source = ReplaySource(lines, len(lines))
        session = book.create("nominal", PushSpec(), settings, source=source, reference=surface)
        session.start()
        assert session.wait_until_over(60)
        live = session.results()
        book.close()
    assert live.reference is not None
    stored = read(path, meshes=meshes)
    assert stored.results.share == live.share
    assert stored.results.regions_dict()["regions"] == live.regions_dict()["regions"]
    assert {region.reason.label for region in stored.results.regions} >= {"untouched"}
    without = read(path)
    assert verdict_sha256(stored.results) == verdict_sha256(live) != verdict_sha256(without.results)
    assert "without the reference mesh" in without.results.reference_refused
    content = report_of(stored, NOW)
    assert dict(content.headlines)["coverage of the nominal part"] == f"{100 * live.share:.1f} %"
    assert b"untouched" in report_html(content)
    assert report_pdf(content)
    (meshes / "nominal.stl").unlink()
    with Record.open(path) as record:
        book = SessionBook(record, meshes=meshes)
        reopened = book.get(session.row.session_id)
        assert reopened.fresh_results().reference is None
        assert "put the reference mesh there" in reopened.status().message
        book.close()


def test_a_withdrawn_pass_is_in_no_stage_and_stays_in_the_copy(scanned, tmp_path):
    lines = two_passes()
    path = tmp_path / "record.sqlite"
    with Record.open(path) as record:
        book = SessionBook(record)
        session = book.create("withdrawn", PushSpec(), SETTINGS, source=ReplaySource(lines, len(lines)))
        session.start()
        assert session.wait_until_over(60)
        assert session.withdraw_pass(("A", 1, 0)) == 560
        live = verdict_sha256(session.fresh_results())
        book.close()
    stored = read(path, with_stages=True)
    assert verdict_sha256(stored.results) == live
    assert [stage.lines for stage in stored.stages] == [34]
    assert stored.first is None
    export(path, ["record"], tmp_path / "copy")
    assert verdict_sha256(read(tmp_path / "copy" / RECORD_FILE).results) == live


def test_a_damaged_line_is_left_out_and_told(scanned, tmp_path):
    import sqlite3

    path, _, _ = scanned
    export(path, ["record"], tmp_path)
    copy = tmp_path / RECORD_FILE
    with sqlite3.connect(copy) as connection:
        connection.execute("UPDATE lines SET encoded = zeroblob(length(encoded)) WHERE line_number = 5")
    connection.close()
    manifest = export(copy, ["ply", "record"], tmp_path / "again")
    assert manifest["damaged_lines"] == ["line 5: its checksum does not match what is stored"]
    assert manifest["lines"] == 33
    twice = RecordReader.open(tmp_path / "again" / RECORD_FILE)  # rot is copied, not hidden
    assert len(twice.verify(manifest["session"]).damaged) == 1
    twice.close()


def test_a_session_is_named_by_id_first_letters_or_latest(scanned):
    path, session_id, _ = scanned
    reader = RecordReader.open(path)
    for wanted in (session_id, session_id[:6], session_id.upper()[:8], "latest"):
        assert find_session(reader, wanted).session_id == session_id
    with pytest.raises(SourceUnusable, match="no session zzz; it holds 1"):
        find_session(reader, "zzz")
    assert pass_ends(reader, find_session(reader, "latest"), ()) == [14, 34]
    reader.close()


@pytest.mark.parametrize("formats", [[], ["obj"], ["ply", "xyz"]])
def test_formats_that_do_not_exist_are_refused_before_any_work(scanned, tmp_path, formats):
    with pytest.raises(FormatNotWritten, match="the formats are ply, laz"):
        export(scanned[0], formats, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_all_writes_what_it_can_and_says_what_it_left_out_and_why(scanned, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "laspy", None)  # as on a computer where it is not installed
    manifest = export(scanned[0], ["all"], tmp_path / "whole")
    left_out = manifest["left_out"]
    assert {"laz", "las"} <= set(left_out) and "pip install" in left_out["laz"]
    assert {"points.ply", "points.csv", "report.html", "session.sqlite"} <= set(manifest["files"])
    reader = RecordReader.open(scanned[0])
    row = find_session(reader, "latest")
    manifest = export_session(reader, row, ["all"], tmp_path / "slabs", NOW, points_at_once=500)
    reader.close()
    assert {"results", "report"} <= set(manifest["left_out"]) and "report.html" not in manifest["files"]
    assert {"points.ply", "session.sqlite"} <= set(manifest["files"])
    assert verify_folder(tmp_path / "slabs").manifest["left_out"] == manifest["left_out"]


def test_a_session_of_more_points_than_allowed_is_written_in_slabs_without_a_verdict(scanned, tmp_path):
    path, _, _ = scanned
    reader = RecordReader.open(path)
    row = find_session(reader, "latest")
    manifest = export_session(reader, row, ["ply", "csv", "record"], tmp_path / "slabs", NOW, points_at_once=500)
    with pytest.raises(NotExportable, match="leave out results and report"):
        export_session(reader, row, ["report"], tmp_path / "report", NOW, points_at_once=500)
    reader.close()
    assert not (tmp_path / "report").exists()
    assert verify_folder(tmp_path / "slabs").problems == ()
    assert manifest["verdict_sha256"] is None
    export(path, ["ply"], tmp_path / "whole")
    theirs, ours = (open_cloud(tmp_path / name / "points.ply") for name in ("whole", "slabs"))
    assert manifest["points"] == len(theirs.points_mm)
    orders = [np.lexsort(cloud.points_mm.T) for cloud in (theirs, ours)]
    np.testing.assert_array_equal(ours.points_mm[orders[1]], theirs.points_mm[orders[0]])
    np.testing.assert_array_equal(ours.normals[orders[1]], theirs.normals[orders[0]])
    lines = open_recording(tmp_path / "slabs" / "points.csv").lines
    assert sum(len(line.points_mm) for line in lines) == manifest["points"]
