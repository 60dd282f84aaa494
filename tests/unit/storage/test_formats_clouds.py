"""PCD, LAS, LAZ and E57 as other programs write them; and nothing that a header declares is believed."""

import json
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scanner_service.storage.exports.about import About
from scanner_service.storage.exports.point_files import POINT_FORMATS
from scanner_service.storage.exports.point_stream import stream_of
from scanner_service.storage.formats import (
    ContentDamaged,
    FileEmpty,
    FileTooLarge,
    FileTruncated,
    FormatError,
    HeaderDamaged,
    LibraryAbsent,
    NoScanlines,
    ReadOptions,
    open_cloud,
    open_recording,
)
from scanner_service.storage.formats.lzf import LzfDamaged, decompressed
from tests.unit.storage.map_snapshots import plate

ROOT = Path(__file__).resolve().parents[3]
POINTS = np.array([[1.5, -2.25, 3.0], [4.0, 5.0, -6.125], [0.0, 1e3, 2.0]])


def pcd(encoding, body, *, fields="x y z", sizes="4 4 4", kinds="F F F", counts="1 1 1", points=3, extra=()):
    head = ["# .PCD v0.7 - Point Cloud Data file format", *extra, "VERSION 0.7", f"FIELDS {fields}", f"SIZE {sizes}"]
    head += [f"TYPE {kinds}", f"COUNT {counts}", f"WIDTH {points}", "HEIGHT 1", "VIEWPOINT 0 0 0 1 0 0 0"]
    return ("\n".join([*head, f"POINTS {points}", f"DATA {encoding}"]) + "\n").encode() + body


def kept(tmp_path, name, data, **options):
    path = tmp_path / name
    path.write_bytes(data)
    return open_cloud(path, ReadOptions(**options))


def literal_lzf(data):
    """LZF of literal runs alone, as the format allows."""
    return b"".join(bytes([len(run) - 1]) + run for run in (data[at : at + 32] for at in range(0, len(data), 32)))


# -- PCD --------------------------------------------------------------------------------------------------------------


def test_every_encoding_of_pcd_gives_the_same_points(tmp_path):
    rows = POINTS.astype("<f4")
    packed = literal_lzf(rows.T.tobytes())
    for encoding, body in (
        ("ascii", "\n".join(" ".join(map(repr, row)) for row in POINTS.tolist()).encode() + b"\n"),
        ("binary", rows.tobytes()),
        ("binary_compressed", struct.pack("<II", len(packed), rows.nbytes) + packed),
    ):
        cloud = kept(tmp_path, "a.pcd", pcd(encoding, body))
        np.testing.assert_array_equal(cloud.points_mm, POINTS)
        assert cloud.format == "pcd"
        assert cloud.notes == (
            "lengths are read as millimetres, since the file names no unit; give the units if they are not",
        )


def test_pcd_fields_of_any_order_width_and_padding_are_stepped_over(tmp_path):
    row = np.dtype([("normal_z", "<f8"), ("_", "u1", 3), ("z", "<f8"), ("y", "<f4"), ("x", "<i2"), ("rgb", "<u4"),
                    ("normal_x", "<f4"), ("normal_y", "<f4")])  # fmt: skip
    table = np.zeros(2, row)
    table["x"], table["y"], table["z"], table["normal_z"] = [1, -2], [3.5, np.nan], [4.25, 5], [1, 1]
    data = pcd(
        "binary", table.tobytes(), fields="normal_z _ z y x rgb normal_x normal_y", sizes="8 1 8 4 2 4 4 4",
        kinds="F U F F I U F F", counts="1 3 1 1 1 1 1 1", points=2,
    )  # fmt: skip
    cloud = kept(tmp_path, "a.pcd", data, units="m")
    np.testing.assert_array_equal(cloud.points_mm, [[1000, 3500, 4250]])
    np.testing.assert_array_equal(cloud.normals, [[0, 0, 1]])
    assert (cloud.points_declared, cloud.dropped) == (2, {"not_finite": 1})


@pytest.mark.parametrize(
    ("data", "error"),
    [
        (pcd("binary", POINTS.astype("<f4").tobytes()[:-1]), FileTruncated),
        (pcd("binary", POINTS.astype("<f4").tobytes() + b"more"), ContentDamaged),
        (pcd("ascii", b"1 2 3\n4 5 6\n"), FileTruncated),
        (pcd("ascii", b"1 2 3\n4 5 6\n7 8\n"), ContentDamaged),
        (pcd("ascii", b"1 2 3\n4 5 6\n7 8 x\n"), ContentDamaged),
        (pcd("ascii", b"1 2 3\n4 5 6\n7 8 9\n1 1 1\n"), ContentDamaged),
        (pcd("binary_compressed", struct.pack("<II", 10, 36)), FileTruncated),
        (pcd("binary_compressed", struct.pack("<II", 3, 35) + b"abc"), HeaderDamaged),
        (pcd("binary_compressed", struct.pack("<II", 3, 36) + b"\xff\xff\xff"), ContentDamaged),
        (pcd("binary", b"", points=10**14), FileTruncated),
        (pcd("ascii", b"1 2 3\n", points=10**14), FileTruncated),
        (pcd("binary_compressed", struct.pack("<II", 4, 2**32 - 1) + b"abcd", points=2**32 // 12), HeaderDamaged),
        (pcd("binary", b"", sizes="4 4 3"), HeaderDamaged),
        (pcd("binary", b"", counts="1 1 99999"), HeaderDamaged),
        (pcd("binary", b"", fields="x y w"), HeaderDamaged),
        (pcd("binary", b"", fields="x y"), HeaderDamaged),
        (pcd("binary", b"", counts="2 1 1", points=0), HeaderDamaged),
        (pcd("binary", b"", points=0), FileEmpty),
        (pcd("secret", b""), HeaderDamaged),
        (b"VERSION 0.7\nFIELDS x y z\n", HeaderDamaged),
        (pcd("binary", b"").replace(b"HEIGHT 1", b"HEIGHT 2"), HeaderDamaged),
        (pcd("binary", b"").replace(b"POINTS 3", b"POINTS -3"), HeaderDamaged),
        (pcd("ascii", b"nan nan nan\n" * 3), FileEmpty),
    ],
    ids=range(23),
)
def test_pcd_files_that_are_wrong_are_refused_in_one_sentence(tmp_path, data, error):
    with pytest.raises(error, match=r"^a\.pcd"):
        kept(tmp_path, "a.pcd", data)


@settings(deadline=None)
@given(st.lists(st.tuples(st.binary(min_size=1, max_size=40), st.integers(1, 300), st.integers(1, 40)), max_size=12))
def test_lzf_gives_back_what_a_plain_packer_packed(pieces):
    whole, packed = bytearray(), bytearray()
    for literal, wanted, distance in pieces:
        whole += literal
        packed += literal_lzf(literal)
        length, back = max(3, min(264, wanted)), min(distance, len(whole))
        for _ in range(length):  # what a copy means, a byte at a time
            whole.append(whole[-back])
        code, high, low = length - 2, (back - 1) >> 8, (back - 1) & 255
        packed += bytes([code << 5 | high, low] if code < 7 else [7 << 5 | high, code - 7, low])
    assert decompressed(bytes(packed), len(whole)) == bytes(whole)


@pytest.mark.parametrize(
    "packed",
    [b"\x05ab", b"\x20", b"\x20\x00", b"\xe0\xff", b"\x00a\x20\x05", b"\x01ab", b"\x03abcd", b""],
    ids=range(8),
)
def test_lzf_that_is_wrong_is_refused(packed):
    with pytest.raises(LzfDamaged):
        decompressed(packed, 3)


def test_lzf_allocates_nothing_on_a_declared_size():
    with pytest.raises(LzfDamaged, match="cannot hold"):
        decompressed(b"\x00a", 2**40)


# -- LAS and LAZ ------------------------------------------------------------------------------------------------------


def las_by_laspy(path, version="1.2", point_format=3, compressed=False, normals=False):
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(version=version, point_format=point_format)
    header.scales, header.offsets = np.array([0.001, 0.002, 0.004]), np.array([10.0, 0.0, -5.0])
    if normals:
        header.add_extra_dims(
            [laspy.ExtraBytesParams("tags", "3u2")] + [laspy.ExtraBytesParams(f"Normal{axis}", "f8") for axis in "XYZ"]
        )
    las = laspy.LasData(header)
    las.x, las.y, las.z = POINTS.T
    if normals:
        las.NormalX, las.NormalY, las.NormalZ = np.zeros(3), np.array([0, 0.6, 1]), np.array([1, 0.8, 0])
    las.write(path, do_compress=compressed)
    return np.column_stack([las.x, las.y, las.z])


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize(("version", "point_format"), [("1.2", 0), ("1.2", 3), ("1.4", 6), ("1.4", 7)])
def test_las_by_another_library_is_read_in_metres(tmp_path, version, point_format, compressed):
    path = tmp_path / ("a.laz" if compressed else "a.las")
    written = las_by_laspy(path, version, point_format, compressed)
    cloud = open_cloud(path)
    np.testing.assert_allclose(cloud.points_mm, 1000 * written, rtol=0, atol=1e-9)
    assert cloud.normals is None
    assert cloud.format == path.suffix[1:]
    assert "metres" in cloud.notes[0]
    np.testing.assert_array_equal(open_cloud(path, ReadOptions(units="mm")).points_mm, written)


@pytest.mark.parametrize("compressed", [False, True])
def test_normals_are_found_among_other_extra_bytes(tmp_path, compressed):
    path = tmp_path / "a.laz"
    las_by_laspy(path, "1.4", 6, compressed, normals=True)
    np.testing.assert_array_equal(open_cloud(path).normals, [[0, 0, 1], [0, 0.6, 0.8], [0, 1, 0]])


@pytest.mark.parametrize(
    ("at", "number", "error"),
    [
        (107, "<I", FileTruncated),  # points
        (96, "<I", FileTruncated),  # where they begin
        (100, "<I", HeaderDamaged),  # variable length records
        (105, "<H", FileTruncated),  # bytes a point
        (94, "<H", FileTruncated),  # bytes of the header
    ],
)
@pytest.mark.parametrize("compressed", [False, True])
def test_las_headers_that_promise_more_than_the_file_holds_are_refused(tmp_path, at, number, error, compressed):
    path = tmp_path / "a.las"
    las_by_laspy(path, compressed=compressed)
    data = bytearray(path.read_bytes())
    size = struct.calcsize(number)
    data[at : at + size] = b"\xff" * size
    with pytest.raises((error, HeaderDamaged)):
        kept(tmp_path, "a.las", bytes(data))


def test_a_laz_file_cut_anywhere_is_refused(tmp_path):
    path = tmp_path / "whole.laz"
    las_by_laspy(path, "1.4", 6, True)
    whole = path.read_bytes()
    for length in range(0, len(whole), 7):
        with pytest.raises(FormatError):
            kept(tmp_path, "a.laz", whole[:length])


def test_a_file_that_would_need_too_much_memory_is_refused(tmp_path):
    path = tmp_path / "a.las"
    las_by_laspy(path)
    with pytest.raises(FileTooLarge):
        open_cloud(path, ReadOptions(max_bytes=50))


def test_laz_and_e57_without_their_libraries_are_refused_with_what_to_install(tmp_path, monkeypatch):
    las_by_laspy(tmp_path / "a.laz", compressed=True)
    e57_by_pye57(tmp_path / "a.e57", [(POINTS, None)])
    monkeypatch.setitem(sys.modules, "lazrs", None)
    monkeypatch.setitem(sys.modules, "pye57", None)
    with pytest.raises(LibraryAbsent, match=r"lazrs.*pip install -e '\.\[las\]'"):
        open_cloud(tmp_path / "a.laz")
    with pytest.raises(LibraryAbsent, match=r"pye57.*pip install -e '\.\[e57\]'"):
        open_cloud(tmp_path / "a.e57")


# -- E57 --------------------------------------------------------------------------------------------------------------


def e57_by_pye57(path, scans):
    """A file of scans (points, pose) as pye57 writes them; a pose is a quaternion and a translation."""
    pye57 = pytest.importorskip("pye57")
    with pye57.E57(str(path), mode="w") as e57:
        for points, pose in scans:
            data = {f"cartesian{axis}": points[:, i].copy() for i, axis in enumerate("XYZ")}
            data["cartesianInvalidState"] = (np.arange(len(points)) == 1).astype("b")
            rotation, translation = pose or (np.array([1, 0, 0, 0]), np.zeros(3))
            e57.write_scan_raw(data, rotation=rotation, translation=translation)


def test_e57_scans_are_moved_by_their_poses_and_invalid_points_counted(tmp_path):
    pye57 = pytest.importorskip("pye57")
    half = np.sqrt(0.5)
    turned = (np.array([half, 0, 0, half]), np.array([1.0, 2.0, 3.0]))  # a quarter turn about z
    e57_by_pye57(tmp_path / "a.e57", [(POINTS, None), (POINTS, turned)])
    cloud = open_cloud(tmp_path / "a.e57")
    with pye57.E57(str(tmp_path / "a.e57")) as e57:
        theirs = [e57.read_scan(number) for number in range(2)]
    expected = np.concatenate([np.column_stack([one[f"cartesian{a}"] for a in "XYZ"]) for one in theirs])
    np.testing.assert_allclose(cloud.points_mm, 1000 * expected, rtol=0, atol=1e-9)
    assert (cloud.points_declared, cloud.dropped) == (6, {"invalid": 2})
    np.testing.assert_allclose(cloud.points_mm[2], [3250, 3500, 6000], atol=1e-9)
    assert cloud.notes == ("lengths are read as metres, as E57 says", "2 scans are read as one cloud")


def test_our_own_e57_comes_back_with_its_normals(tmp_path):
    pytest.importorskip("pye57")
    snapshot = plate()
    POINT_FORMATS["e57"].write(tmp_path / "a.e57", stream_of(snapshot), About("s"))
    cloud = open_cloud(tmp_path / "a.e57")
    np.testing.assert_allclose(cloud.points_mm, snapshot.points_mm, rtol=0, atol=1e-10)
    normals = np.where(snapshot.reliable[:, None], snapshot.normals, np.nan)
    np.testing.assert_array_equal(cloud.normals, normals.astype(np.float32))


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b'recordCount="3"', b'recordCount="9999999999"'),
        (b'recordCount="3"', b'recordCount="-3"'),
        (b'recordCount="3"', b'recordCount="x"'),
        (b"<data3D ", b"<data4D "),
        (b"<?xml", b"<!DOCTYPE a [<!ENTITY b 'c'>]><?xml"),
    ],
    ids=range(5),
)
def test_e57_that_declares_nonsense_is_refused_before_the_library_sees_it(tmp_path, monkeypatch, old, new):
    from tests.unit.storage.fuzzed_files import sealed

    e57_by_pye57(tmp_path / "whole.e57", [(POINTS, None)])
    data = (tmp_path / "whole.e57").read_bytes()
    assert old in data
    changed = data.replace(old, new)
    xml_bytes = struct.unpack_from("<Q", data, 32)[0] + len(new) - len(old)
    changed = bytearray(changed[: len(data)])
    struct.pack_into("<Q", changed, 32, xml_bytes)
    monkeypatch.setitem(sys.modules, "pye57", None)
    with pytest.raises(FormatError) as refused:
        kept(tmp_path, "a.e57", sealed(bytes(changed)))
    assert not isinstance(refused.value, LibraryAbsent)


def test_a_flipped_bit_in_an_e57_page_is_seen(tmp_path):
    e57_by_pye57(tmp_path / "whole.e57", [(np.random.default_rng(1).normal(size=(500, 3)), None)])
    data = bytearray((tmp_path / "whole.e57").read_bytes())
    data[1500] ^= 4
    with pytest.raises(ContentDamaged, match="libE57"):
        kept(tmp_path, "a.e57", bytes(data))


# -- all --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [name for name in POINT_FORMATS if name != "parquet"])
def test_what_we_write_we_read_in_millimetres_point_for_point(tmp_path, name):
    if missing := POINT_FORMATS[name].missing():
        pytest.skip(missing)
    snapshot = plate()
    path = tmp_path / f"a.{name}"
    POINT_FORMATS[name].write(path, stream_of(snapshot), About("s"))
    np.testing.assert_allclose(open_cloud(path).points_mm, snapshot.points_mm, rtol=0, atol=1e-10)
    if name not in ("csv", "ply"):
        with pytest.raises(NoScanlines, match="analyse it as a cloud"):
            open_recording(path)


def fuzz(folder, count, seed):
    """Read so many damaged files in a process of its own, which a library might take down; what it told."""
    for name, one in POINT_FORMATS.items():
        if missing := one.missing():
            pytest.skip(missing)
        if name != "parquet":
            one.write(folder / f"whole.{name}", stream_of(plate(lines=40, points=50)), About("s"))
    command = [
        sys.executable,
        "-W",
        "error",
        "-m",
        "tests.unit.storage.fuzzed_files",
        str(folder),
        str(count),
        str(seed),
    ]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    told = json.loads(done.stdout)
    assert told["faults"] == []
    assert told["largest_mb"] <= 64
    assert sum(told["ends"].values()) == count
    return told["ends"]


def test_damaged_files_are_read_or_refused_in_one_sentence(tmp_path):
    ends = fuzz(tmp_path, 600, seed=7)
    assert len({end.split()[0] for end in ends}) == 6
    assert any(end.endswith(" read") for end in ends)


@pytest.mark.long
@pytest.mark.timeout(3600)
def test_many_damaged_files_are_read_or_refused_in_one_sentence(tmp_path):
    fuzz(tmp_path, 50_000, seed=8)
