"""Points in other programs' formats, read back by those programs' own libraries, are the stored points exactly."""

import csv
import json

import numpy as np
import pytest

from scanner_service.rescan.judgement import Reason
from scanner_service.storage.exports import optional
from scanner_service.storage.exports.about import About
from scanner_service.storage.exports.errors import ExtraMissing, FormatNotWritten
from scanner_service.storage.exports.point_files import POINT_FORMATS, point_format
from scanner_service.storage.exports.point_stream import BLOCK_POINTS, stream_of
from scanner_service.storage.exports.points_csv import device_name
from scanner_service.storage.formats import open_cloud, open_recording
from tests.unit.storage.map_snapshots import plate

ABOUT = About("session1", "a näme,\nof two lines", "2026-11-26T07:00:00.000Z", {"noise_mm": 0.01}, "ab" * 32, "9.9.9")


def written(name, folder, snapshot=None, judged=True):
    """A file of that format; the snapshot and the verdict that it was made from."""
    snapshot = plate() if snapshot is None else snapshot
    rescan = np.arange(len(snapshot)) % 4 == 0
    reason = (np.arange(len(snapshot)) % 8).astype(np.uint8)
    stream = stream_of(snapshot, rescan, reason) if judged else stream_of(snapshot)
    one = point_format(name)
    path = folder / one.file_name
    one.write(path, stream, ABOUT)
    assert [item.name for item in folder.iterdir()] == [one.file_name]
    return path, snapshot, rescan, reason


def normals_of(snapshot):
    return np.where(snapshot.reliable[:, None], snapshot.normals, np.nan)


@pytest.mark.parametrize("name", ["laz", "las"])
def test_las_holds_the_stored_integers_and_the_names_that_others_know(tmp_path, name):
    laspy = pytest.importorskip("laspy")
    path, snapshot, rescan, reason = written(name, tmp_path)
    with laspy.open(path) as opened:
        assert opened.header.are_points_compressed == (name == "laz")
    las = laspy.read(path)
    assert str(las.header.version) == "1.4"
    assert las.header.point_format.id == 6
    assert las.header.global_encoding.wkt
    np.testing.assert_array_equal(las.xyz, snapshot.points_mm)
    np.testing.assert_array_equal(las.header.scales, 2.0**-13)
    np.testing.assert_array_equal(las.header.mins, snapshot.points_mm.min(axis=0))
    np.testing.assert_array_equal(las.header.maxs, snapshot.points_mm.max(axis=0))
    for axis, letter in enumerate("XYZ"):
        np.testing.assert_array_equal(las[f"Normal{letter}"], normals_of(snapshot)[:, axis].astype(np.float32))
        np.testing.assert_array_equal(las[f"Laser{letter}"], snapshot.lines.laser_mm[snapshot.line, axis])
    np.testing.assert_array_equal(las["Density"], snapshot.density_per_mm2.astype(np.float32))
    for dimension, values in (
        ("ScanLine", snapshot.line),
        ("Rescan", rescan),
        ("Reason", reason),
        ("Neighbours", snapshot.neighbours),
        ("Reliable", snapshot.reliable),
        ("point_source_id", snapshot.lines.pass_number[snapshot.line] + 1),
        ("return_number", np.ones(len(snapshot))),
    ):
        np.testing.assert_array_equal(las[dimension], values)
    (note,) = [vlr for vlr in las.vlrs if vlr.user_id == "scanner_service"]
    assert json.loads(note.record_data) == ABOUT.to_dict()


def test_e57_is_in_metres_and_holds_the_stored_coordinates(tmp_path):
    pye57 = pytest.importorskip("pye57")
    path, snapshot, rescan, reason = written("e57", tmp_path)
    with pye57.E57(str(path)) as e57:
        scan = e57.read_scan(0)
        header = e57.get_header(0)
        assert header.point_count == len(snapshot)
        assert json.loads(header["description"].value()) == ABOUT.to_dict()
        read = np.column_stack([scan[f"cartesian{axis}"] for axis in "XYZ"])
        np.testing.assert_allclose(1000 * read, snapshot.points_mm, rtol=0, atol=1e-12)
        lib, image = pye57.libe57, e57.image_file
        columns = {name: np.zeros(len(snapshot), np.float32) for name in ("nor:normalX", "nor:normalZ", "sq:density")}
        columns |= {name: np.zeros(len(snapshot), "b") for name in ("sq:rescan", "sq:reason")}
        buffers = lib.VectorSourceDestBuffer()
        for name, array in columns.items():
            buffers.append(lib.SourceDestBuffer(image, name, array, len(snapshot), True, True))
        assert header.points.reader(buffers).read() == len(snapshot)
    np.testing.assert_array_equal(columns["nor:normalX"], normals_of(snapshot)[:, 0].astype(np.float32))
    np.testing.assert_array_equal(columns["nor:normalZ"], normals_of(snapshot)[:, 2].astype(np.float32))
    np.testing.assert_array_equal(columns["sq:density"], snapshot.density_per_mm2.astype(np.float32))
    np.testing.assert_array_equal(columns["sq:rescan"], rescan)
    np.testing.assert_array_equal(columns["sq:reason"], reason)


def test_parquet_has_typed_columns_and_null_for_an_unknown_normal(tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    path, snapshot, rescan, reason = written("parquet", tmp_path)
    table = parquet.read_table(path)
    assert json.loads(table.schema.metadata[b"about"]) == ABOUT.to_dict()
    read = np.column_stack([table[f"{axis}_mm"].to_numpy() for axis in "xyz"])
    np.testing.assert_array_equal(read, snapshot.points_mm)
    assert table["nx"].null_count == (~snapshot.reliable).sum()
    np.testing.assert_array_equal(table["nx"].to_numpy(), normals_of(snapshot)[:, 0])
    np.testing.assert_array_equal(table["rescan"].to_numpy(), rescan)
    assert table["reason"].to_pylist() == [Reason(value).label for value in reason]
    assert set(table["device"].to_pylist()) == {"A"}
    np.testing.assert_array_equal(table["line"].to_numpy(), snapshot.lines.line_index[snapshot.line])


def test_pcd_is_float32_where_that_is_exact_and_float64_where_not(tmp_path):
    from dataclasses import replace

    near = plate()
    far = replace(near, origin_mm=near.origin_mm + 1e5, points_mm=near.points_mm + 1e5)
    for snapshot, kind in ((near, "<f4"), (far, "<f8")):
        path, *_ = written("pcd", tmp_path, snapshot)
        head, body = path.read_bytes().split(b"DATA binary\n")
        said = dict(line.split(" ", 1) for line in head.decode("ascii").splitlines() if not line.startswith("#"))
        names, sizes, kinds = (said[key].split() for key in ("FIELDS", "SIZE", "TYPE"))
        row = np.dtype([(n, f"<{k.lower()}{s}") for n, s, k in zip(names, sizes, kinds, strict=True)])
        table = np.frombuffer(body, row)
        assert row["x"].str == kind
        assert len(table) == int(said["POINTS"]) == int(said["WIDTH"]) == len(snapshot)
        for axis, letter in enumerate("xyz"):
            np.testing.assert_array_equal(table[letter], snapshot.points_mm[:, axis])
            np.testing.assert_array_equal(table[f"normal_{letter}"], normals_of(snapshot)[:, axis].astype(np.float32))
        path.unlink()


def test_csv_is_a_profile_table_that_is_read_back_as_the_same_scanlines(tmp_path):
    path, snapshot, rescan, reason = written("csv", tmp_path)
    recording = open_recording(path)
    np.testing.assert_array_equal(np.concatenate([line.points_mm for line in recording.lines]), snapshot.points_mm)
    np.testing.assert_array_equal([line.laser_mm for line in recording.lines], snapshot.lines.laser_mm)
    assert recording.line_spacing_mm == 0.25
    rows = list(csv.DictReader(line for line in path.read_text("utf-8").splitlines() if not line.startswith("#")))
    assert [row["nx"] == "" for row in rows] == (~snapshot.reliable).tolist()
    assert [row["rescan"] for row in rows] == [str(int(value)) for value in rescan]
    assert [row["reason"] for row in rows] == [Reason(value).label for value in reason]
    np.testing.assert_allclose([float(row["density_per_mm2"]) for row in rows], snapshot.density_per_mm2, rtol=1e-8)


@pytest.mark.parametrize("hostile", ['a,b"c\nd', "=1+1", "+x", "-x", "@x", "#x", ""])
def test_a_device_name_stays_one_field_and_no_formula(hostile):
    name = device_name(hostile)
    assert name
    assert not set(name) & set(',;\t\r\n"')
    assert name[0] not in "=+-@#"


def test_ply_is_read_by_another_library(tmp_path):
    plyfile = pytest.importorskip("plyfile")
    path, snapshot, rescan, _ = written("ply", tmp_path)
    vertex = plyfile.PlyData.read(str(path))["vertex"]
    np.testing.assert_array_equal(np.column_stack([vertex[axis] for axis in "xyz"]), snapshot.points_mm)
    np.testing.assert_array_equal(vertex["scalar_rescan"], rescan)


@pytest.mark.parametrize("name", POINT_FORMATS)
def test_without_a_verdict_no_file_claims_one(tmp_path, name):
    if missing := POINT_FORMATS[name].missing():
        pytest.skip(missing)
    path, *_ = written(name, tmp_path, judged=False)
    if name == "ply":
        assert np.isnan(__import__("trimesh").load(path).metadata["_ply_raw"]["vertex"]["data"]["scalar_rescan"]).all()
    elif name in ("las", "laz"):
        assert "Rescan" not in __import__("laspy").read(path).point_format.dimension_names
    elif name == "parquet":
        assert "rescan" not in __import__("pyarrow.parquet").parquet.read_schema(path).names
    elif name == "e57":
        e57 = __import__("pye57").E57(str(path))
        assert "sq:rescan" not in e57.get_header(0).point_fields
        e57.close()
    else:
        assert b"rescan" not in path.read_bytes()


@pytest.mark.parametrize("name", POINT_FORMATS)
def test_equal_data_give_equal_files_in_blocks_of_any_number(tmp_path, name):
    if missing := POINT_FORMATS[name].missing():
        pytest.skip(missing)
    snapshot = plate(lines=3, points=BLOCK_POINTS // 2)
    told = []
    for number in range(2):
        POINT_FORMATS[name].write(tmp_path / str(number), stream_of(snapshot).told(told.append), ABOUT)
    assert (tmp_path / "0").read_bytes() == (tmp_path / "1").read_bytes()
    assert told == 2 * [BLOCK_POINTS, len(snapshot)]


@pytest.mark.parametrize("name", POINT_FORMATS)
def test_a_session_without_points_is_a_file_without_points(tmp_path, name):
    if missing := POINT_FORMATS[name].missing():
        pytest.skip(missing)
    path, *_ = written(name, tmp_path, plate(lines=0))
    assert path.stat().st_size > 0


def test_an_absent_library_is_told_in_one_sentence_and_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pye57", None)
    monkeypatch.setitem(__import__("sys").modules, "lazrs", None)
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    for name, package in (("e57", "pye57"), ("laz", "lazrs"), ("parquet", "pyarrow")):
        with pytest.raises(ExtraMissing, match=rf"need {package}.*pip install -e '\.\["):
            point_format(name).write(tmp_path / "points", stream_of(plate()), ABOUT)
        assert package in (point_format(name).missing() or "")
    assert list(tmp_path.iterdir()) == []
    assert optional.__doc__


def test_an_unknown_format_is_refused_by_name():
    with pytest.raises(FormatNotWritten, match="obj; the formats are ply, laz"):
        point_format("obj")


def test_every_format_is_read_back_by_ourselves_where_it_is_read(tmp_path):
    for name in ("ply", "csv"):
        path, snapshot, *_ = written(name, tmp_path)
        np.testing.assert_array_equal(open_cloud(path).points_mm, snapshot.points_mm)
        path.unlink()
