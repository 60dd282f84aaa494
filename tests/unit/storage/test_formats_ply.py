"""PLY: one content, many spellings; and a header is never believed."""

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scanner_service.storage.formats import (
    Cloud,
    ContentDamaged,
    FileEmpty,
    FileNotReadable,
    FileTooLarge,
    FileTruncated,
    FormatError,
    FormatUnknown,
    HeaderDamaged,
    NoScanlines,
    ReadOptions,
    Recording,
    open_cloud,
    open_recording,
)
from scanner_service.storage.formats.ply import read_vertices
from scanner_service.storage.formats.range_grid import recording_of_grid
from tests.unit.storage.ply_files import XYZ, grid_file, ply

ENCODINGS = ["ascii", "binary_little_endian", "binary_big_endian"]
numbers = st.floats(allow_nan=False, allow_infinity=False, width=32)


def cloud_from(data, tmp_path, **options) -> Cloud:
    path = tmp_path / "cloud.ply"
    path.write_bytes(data)
    return open_cloud(path, ReadOptions(**options))


def read_anything(data: bytes) -> Recording | FormatError:
    """What the scanline reader makes of any bytes: a recording or a plain refusal."""
    options = ReadOptions(laser_mm=(0.0, 0.0, 100.0), line_spacing_mm=1.0)
    try:
        return recording_of_grid(read_vertices(data, "any.ply", None), "any.ply", options)
    except FormatError as error:
        return error


@given(
    st.lists(st.tuples(numbers, numbers, numbers), min_size=1, max_size=8),
    st.permutations([("x", "float"), ("y", "double"), ("z", "float"), ("red", "uchar"), ("tags", "uchar", "short")]),
    st.data(),
)
@settings(max_examples=60)
def test_every_encoding_and_order_of_properties_gives_the_same_vertices(points, properties, data):
    rows = []
    for x, y, z in points:
        row = {"x": x, "y": y, "z": z, "red": 7, "tags": data.draw(st.lists(st.integers(-9, 9), max_size=3))}
        rows.append([row[label] for label, *_ in properties])
    for encoding in ENCODINGS:
        for end in ("\n", "\r\n"):
            vertices = read_vertices(ply(encoding, [("vertex", properties, rows)], end=end), "a.ply", "mm")
            np.testing.assert_array_equal(vertices.points_mm, np.array(points))


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_elements_before_and_after_the_vertices_do_not_disturb_them(encoding, tmp_path):
    faces = [([0, 1, 2],), ([0, 1, 2, 0],), ([],)]
    elements = [
        ("face", [("vertex_indices", "uchar", "int")], faces),
        ("vertex", [*XYZ, ("nx", "float"), ("ny", "float"), ("nz", "float")], [(1.0, 2.0, 3.0, 0.0, 0.0, 1.0)]),
        ("camera", [("f", "double")], [(0.5,)]),
    ]
    cloud = cloud_from(ply(encoding, elements), tmp_path)
    assert cloud.points_mm.tolist() == [[1.0, 2.0, 3.0]]
    assert cloud.normals is not None
    assert cloud.normals.tolist() == [[0.0, 0.0, 1.0]]


@pytest.mark.parametrize(("units", "factor"), [("mm", 1.0), ("m", 1000.0), ("inch", 25.4), ("auto", 1.0), (None, 1.0)])
def test_lengths_become_millimetres_and_a_note_says_from_what(units, factor, tmp_path):
    cloud = cloud_from(ply("ascii", [("vertex", XYZ, [(1.0, 2.0, 4.0)])]), tmp_path, units=units)
    assert cloud.points_mm.tolist() == [[factor, 2 * factor, 4 * factor]]
    assert "lengths are read as" in cloud.notes[0]


def test_units_named_in_the_header_are_taken(tmp_path):
    data = ply("ascii", [("vertex", XYZ, [(1.0, 2.0, 4.0)])], ["comment units: inches"])
    assert cloud_from(data, tmp_path).points_mm[0, 0] == 25.4


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_nan_and_infinite_vertices_are_counted_and_the_others_kept(encoding, tmp_path):
    rows = [(0.0, 0.0, 0.0), (float("nan"), 1.0, 1.0), (1.0, float("inf"), 1.0), (2.0, 2.0, 2.0)]
    cloud = cloud_from(ply(encoding, [("vertex", XYZ, rows)]), tmp_path)
    assert cloud.points_mm.tolist() == [[0.0, 0.0, 0.0], [2.0, 2.0, 2.0]]
    assert cloud.dropped == {"not_finite": 2}
    assert cloud.points_declared == 4


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("count", [3, 10**9, 10**17])
def test_a_header_that_declares_more_than_there_is_is_refused_before_anything_is_allocated(encoding, count, tmp_path):
    data = ply(encoding, [("vertex", XYZ, [(0.0, 0.0, 0.0)] * 2)]).replace(b"vertex 2", b"vertex %d" % count)
    tracemalloc.start()
    with pytest.raises(FileTruncated, match="cut short or its header is wrong"):
        cloud_from(data, tmp_path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1 << 20


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_header_that_declares_less_than_there_is_is_refused_too(encoding, tmp_path):
    data = ply(encoding, [("vertex", XYZ, [(0.0, 1.0, 2.0)] * 3)]).replace(b"vertex 3", b"vertex 2")
    with pytest.raises(ContentDamaged, match="more than its header declares"):
        cloud_from(data, tmp_path)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_list_that_claims_to_be_huge_is_refused(encoding):
    data = grid_file(encoding, [(0.0, 0.0, 0.0)], [[0], [], [], []], 2, 2)
    data = data.replace(b"list uchar int", b"list uint int")
    result = read_anything(data)
    if encoding == "ascii":
        assert isinstance(result, Recording)
    else:
        assert isinstance(result, FileTruncated)


@pytest.mark.parametrize(
    ("before", "after", "fact"),
    [
        (b"end_header\n", b"", HeaderDamaged),
        (b"format ascii 1.0\n", b"", HeaderDamaged),
        (b"format ascii 1.0", b"format ascii 2.0", HeaderDamaged),
        (b"element vertex 2", b"element vertex -2", HeaderDamaged),
        (b"element vertex 2", b"element vertex two", HeaderDamaged),
        (b"property double y", b"property quadruple y", HeaderDamaged),
        (b"property double y", b"property double x", HeaderDamaged),
        (b"property double y", b"property list float int y", HeaderDamaged),
        (b"property double y", b"property double w", HeaderDamaged),
        (b"element vertex 2\n", b"", HeaderDamaged),
        (b"element vertex 2", b"element vertex 0", FileEmpty),
        (b"0.0 1.0 2.0", b"0.0 1.0", ContentDamaged),
        (b"0.0 1.0 2.0", b"0.0 1.0 2.0 3.0", ContentDamaged),
        (b"0.0 1.0 2.0", b"0.0 1.0 2_0", ContentDamaged),
        (b"0.0 1.0 2.0", b"0.0 1.0 zwei", ContentDamaged),
        (b"0.0 1.0 2.0", b"nan 1.0 2.0", None),
    ],
)
def test_damage_is_named_in_one_sentence_with_the_file(before, after, fact, tmp_path):
    data = ply("ascii", [("vertex", XYZ, [(0.0, 1.0, 2.0), (3.0, 4.0, 5.0)])])
    assert before in data
    data = data.replace(before, after, 1)
    if fact is None:
        assert len(cloud_from(data, tmp_path).points_mm) == 1
        return
    with pytest.raises(fact, match=r"cloud\.ply") as refused:
        cloud_from(data, tmp_path)
    assert "\n" not in str(refused.value)


def test_the_line_of_a_damaged_value_is_named(tmp_path):
    data = ply("ascii", [("vertex", XYZ, [(0.0, 1.0, 2.0)] * 4)]) + b"\n"
    broken = data.replace(b"0.0 1.0 2.0\n0.0 1.0 2.0\n\n", b"0.0 1.0 2.0\n0.0 x 2.0\n\n")
    number = 1 + broken.split(b"\n").index(b"0.0 x 2.0")
    with pytest.raises(ContentDamaged, match=f"line {number} holds 'x'"):
        cloud_from(broken, tmp_path)


def test_what_is_no_scan_is_refused_for_what_it_is(tmp_path):
    for name, content, fact in [
        ("empty.ply", b"", FileEmpty),
        ("blank.ply", b" \n\n", FileEmpty),
        ("picture.ply", b"\x89PNG\r\n\x1a\n\x00\x00", FormatUnknown),
        ("text.xyz", b"once upon a time\n", FormatUnknown),
        ("record.db", b"SQLite format 3\x00" + bytes(100), FormatUnknown),
    ]:
        (tmp_path / name).write_bytes(content)
        for open_it in (open_cloud, open_recording):
            with pytest.raises(fact, match=name):
                open_it(tmp_path / name)
    with pytest.raises(FileNotReadable, match="does not exist"):
        open_cloud(tmp_path / "absent.ply")
    with pytest.raises(FileNotReadable, match="is not a file"):
        open_cloud(tmp_path)
    with pytest.raises(FileNotReadable):
        open_cloud(Path("a\0b"))


def test_a_plain_cloud_has_no_scanlines_and_a_large_file_is_refused(tmp_path):
    path = tmp_path / "cloud.txt"  # the name does not matter
    path.write_bytes(ply("ascii", [("vertex", XYZ, [(0.0, 1.0, 2.0)])]))
    with pytest.raises(NoScanlines, match="analyse"):
        open_recording(path)
    with pytest.raises(FileTooLarge, match="at most 10"):
        open_cloud(path, ReadOptions(max_bytes=10))


GRID = [(1.0 * (i % 4), 1.0 * (i // 4), 0.1 * i) for i in range(24)]
CELLS = [[i] if i % 5 else [] for i in range(24)]


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_file_cut_anywhere_is_refused(encoding):
    whole = grid_file(encoding, GRID, CELLS, 6, 4)
    assert isinstance(read_anything(whole), Recording)
    for length in range(len(whole)):
        result = read_anything(whole[:length])
        if isinstance(result, Recording):  # only in the last number of a text, and then it is said
            assert encoding == "ascii"
            assert length >= len(whole.rstrip()) - 1
            assert any("no line break" in note for note in result.notes)


@given(st.sampled_from(ENCODINGS), st.data())
@settings(max_examples=400)
def test_any_change_of_bytes_gives_a_recording_that_balances_or_a_plain_refusal(encoding, data):
    content = bytearray(grid_file(encoding, GRID, CELLS, 6, 4))
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(content) - 1))
        size = data.draw(st.integers(0, 4))
        content[at : at + size] = data.draw(st.binary(max_size=4) | st.sampled_from([b"9999999", b"-1", b"nan", b"\n"]))
    result = read_anything(bytes(content))
    if isinstance(result, Recording):
        assert result.points + sum(result.dropped.values()) == result.points_declared
        assert result.points == sum(int(np.isfinite(line.points_mm).all(axis=1).sum()) for line in result.lines)
    else:
        assert "\n" not in str(result)


header_lines = st.sampled_from(
    [
        "format ascii 1.0",
        "format binary_little_endian 1.0",
        "element vertex 3",
        "element vertex 999999999999",
        "element range_grid 4000000000",
        "element nothing 123456789012345678",
        "property float x",
        "property double y",
        "property uchar z",
        "property list uint double vertex_indices",
        "property list uchar int vertex_indices",
        "obj_info num_rows 2000000000",
        "obj_info num_cols 2",
        "comment units m",
        "end_header",
        "",
    ]
)


@given(st.lists(header_lines, max_size=14), st.binary(max_size=80))
@settings(max_examples=400)
def test_no_header_makes_the_reader_fail_otherwise_or_allocate(lines, body):
    data = "\n".join(["ply", *lines, "end_header", ""]).encode() + body
    tracemalloc.start()
    result = read_anything(data)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert isinstance(result, Recording | FormatError)
    assert peak < 1 << 20
