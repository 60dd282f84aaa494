"""Profile tables (CSV) and text clouds: grouped whatever their order, refused by row number."""

from math import nan

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scanner_service.storage.formats import (
    ContentDamaged,
    FileEmpty,
    FileTooLarge,
    FormatError,
    FormatUnknown,
    HeaderDamaged,
    LaserUnknown,
    NoScanlines,
    OptionRefused,
    ReadOptions,
    SpacingUnknown,
    open_cloud,
    open_recording,
)
from scanner_service.storage.formats.csv_profiles import read_csv_recording
from scanner_service.storage.formats.xyz import read_xyz

HEADER = "line,x_mm,y_mm,z_mm,laser_x_mm,laser_y_mm,laser_z_mm,line_spacing_mm,pass,device,time_s,index"


def rows(lines=4, points=5, spacing=0.3, first_line=0):
    """Rows of a table over a gently curved surface; each names its place."""
    return [
        f"{first_line + i},{0.2 * k},{spacing * i},{0.05 * k * k},0,{spacing * i},150,{spacing},0,A,{0.01 * i},{k}"
        for i in range(lines)
        for k in range(points)
    ]


def read(text, **options):
    return read_csv_recording(text, "table.csv", ReadOptions(**options))


def same(a, b):
    """Two recordings hold the same lines, bit by bit."""
    assert len(a.lines) == len(b.lines)
    for one, other in zip(a.lines, b.lines, strict=True):
        for name in one.__slots__:
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)


def test_a_table_becomes_its_lines():
    recording = read("\n".join([HEADER, *rows()]))
    assert [line.line_index for line in recording.lines] == [0, 1, 2, 3]
    line = recording.lines[2]
    assert line.points_mm.tolist() == [[0.2 * k, 0.6, 0.05 * k * k] for k in range(5)]
    assert line.laser_mm.tolist() == [0.0, 0.6, 150.0]
    assert (line.device_id, line.pass_index, line.device_time_s, line.line_spacing_mm) == ("A", 0, 0.02, 0.3)
    assert line.plane_normal.tolist() == line.travel.tolist() == [0.0, 1.0, 0.0]
    assert line.position_mm == pytest.approx(0.6)
    assert line.step_mm == pytest.approx(0.3)
    assert (recording.points, recording.points_declared, recording.dropped) == (20, 20, {})


@given(st.permutations(rows()))
@settings(max_examples=40)
def test_the_order_of_the_rows_does_not_matter(shuffled):
    same(read("\n".join([HEADER, *shuffled])), read("\n".join([HEADER, *rows()])))


def test_without_an_index_the_order_within_the_line_is_the_order_of_the_rows():
    text = "line;x_mm;y_mm;z_mm\n1;0;0;0\n2;0;1;0\n# a remark\n\n1;1;0;0.2\n2;1;1;0.2\n1;2;0;0\n2;2;1;0\n"
    recording = read(text, laser_mm=(0.0, nan, 100.0))
    assert [line.points_mm[:, 0].tolist() for line in recording.lines] == [[0, 1, 2], [0, 1, 2]]
    assert [line.laser_mm[1] for line in recording.lines] == [0.0, 1.0]
    assert recording.line_spacing_mm == pytest.approx(1.0)
    assert recording.lines[0].device_id == "table"


def test_dropouts_keep_their_place_and_are_counted():
    text = (
        "line,x_mm,y_mm,z_mm,index\n0,0,0,0,0\n0,nan,nan,nan,1\n0,2,0,0,2\n0,,,,3\n0,4,inf,0,4\n1,0,1,0,0\n1,1,1,0,1\n"
    )
    recording = read(text, laser_mm=(0.0, 0.0, 100.0))
    assert recording.dropped == {"dropout": 2, "not_finite": 1}
    assert recording.points + 3 == recording.points_declared == 7
    assert np.isnan(recording.lines[0].points_mm[:, 0]).tolist() == [False, True, False, True, True]


def test_a_table_without_a_last_line_break_says_that_it_may_be_cut():
    text = "\n".join([HEADER, *rows()])
    assert any("no line break" in note for note in read(text).notes)
    assert not any("no line break" in note for note in read(text + "\n").notes)


def test_missing_line_numbers_stay_missing_and_do_not_widen_the_spacing():
    text = "\n".join([HEADER.replace("line_spacing_mm", "other"), *(row for row in rows() if not row.startswith("1,"))])
    recording = read(text)
    assert [line.line_index for line in recording.lines] == [0, 2, 3]
    assert recording.line_spacing_mm == pytest.approx(0.3)
    assert recording.lines[1].step_mm == pytest.approx(0.6)


def test_passes_that_count_from_anew_are_numbered_through():
    second = [row.replace(",0.3,0,A,", ",0.3,1,A,") for row in rows()]
    recording = read("\n".join([HEADER, *rows(), *second]))
    indices = sorted((line.pass_index, line.line_index) for line in recording.lines)
    assert indices == [(0, 0), (0, 1), (0, 2), (0, 3), (1, 4), (1, 5), (1, 6), (1, 7)]
    assert "line numbers begin anew in each pass; they are numbered through" in recording.notes


def test_a_flat_plate_is_understood_from_the_way_its_lines_follow_each_other():
    text = "line,x_mm,y_mm,z_mm\n" + "\n".join(f"{i},{x},{0.25 * i},0" for i in range(5) for x in range(9))
    recording = read(text, laser_mm=(4.0, 0.5, 100.0))
    assert recording.lines[0].travel.tolist() == [0.0, 1.0, 0.0]
    assert recording.line_spacing_mm == pytest.approx(0.25)
    assert recording.point_spacing_mm == 1.0


@pytest.mark.parametrize(
    ("text", "fact", "words"),
    [
        ("line,x_mm,y_mm\n0,0,0\n", HeaderDamaged, "no column z_mm"),
        ("line,x_mm,y_mm,z_mm,x_mm\n0,0,0,0,0\n", HeaderDamaged, "column x_mm twice"),
        ("line,x_mm,y_mm,z_mm,laser_x_mm\n0,0,0,0,0\n", HeaderDamaged, "all three"),
        ("line,x_mm,y_mm,z_mm\n", FileEmpty, "no row"),
        ("line,x_mm,y_mm,z_mm\n0,nan,nan,nan\n", FileEmpty, "no point"),
        ("line,x_mm,y_mm,z_mm\n0,0,0,0\n0,0,0\n", ContentDamaged, "row 3 has 3 cells"),
        ("# remark\nline,x_mm,y_mm,z_mm\n0,0,0,0\n0,0,zero,0\n", ContentDamaged, "row 4 has 'zero' in column y_mm"),
        ("line,x_mm,y_mm,z_mm\n0.5,0,0,0\n", ContentDamaged, "row 2 has '0.5' in column line"),
        ("line,x_mm,y_mm,z_mm\n-1,0,0,0\n", ContentDamaged, "row 2 has '-1' in column line"),
        ("line,x_mm,y_mm,z_mm,index\n0,0,0,0,3\n0,1,0,0,3\n", ContentDamaged, "row 3 gives index 3"),
        ("line,x_mm,y_mm,z_mm,index\n0,0,0,0,999999999\n", FileTooLarge, "places empty"),
        ("line,x_mm,y_mm,z_mm,line_spacing_mm\n0,0,0,0,0\n", ContentDamaged, "row 2: line spacing must be greater"),
        ("line,x_mm,y_mm,z_mm,line_spacing_mm\n0,0,0,0,1\n0,1,0,0,2\n", ContentDamaged, "row 3 gives line 0 another"),
        ("line,x_mm,y_mm,z_mm\n0,0,0,0\n", SpacingUnknown, "--line-spacing"),
        ('line,x_mm,y_mm,z_mm\n0,"0,0,0\n0,0,0,0\n', ContentDamaged, "row"),
    ],
)
def test_a_bad_table_is_refused_with_the_row(text, fact, words):
    with pytest.raises(fact, match=words):
        read(text, laser_mm=(0.0, 0.0, 100.0))


def test_units_that_contradict_the_columns_are_refused():
    with pytest.raises(OptionRefused, match="they are millimetres"):
        read("\n".join([HEADER, *rows()]), units="m")


def test_a_laser_that_nobody_names_is_asked_for():
    with pytest.raises(LaserUnknown, match="--laser"):
        read("line,x_mm,y_mm,z_mm\n0,0,0,0\n1,0,1,0\n")
    text = "line,x_mm,y_mm,z_mm,laser_x_mm,laser_y_mm,laser_z_mm\n0,0,0,0,0,0,9\n0,1,0,0,0,0,8\n"
    with pytest.raises(ContentDamaged, match="row 3 gives line 0 another laser position"):
        read(text)


@given(st.text(alphabet='0123456789.,-;\n"naeinf_ \tx', max_size=120))
@settings(max_examples=400)
def test_any_text_under_a_header_gives_lines_or_a_plain_refusal(body):
    try:
        recording = read("line,x_mm,y_mm,z_mm,index\n" + body, laser_mm=(0.0, 0.0, 100.0), line_spacing_mm=1.0)
    except FormatError as error:
        assert "\n" not in str(error)
        return
    assert recording.points + sum(recording.dropped.values()) == recording.points_declared


@pytest.mark.parametrize("delimiter", [" ", ",", "\t", ";", " , "])
@pytest.mark.parametrize("first", ["", "# a cloud of x y z points\n", "// two\n\n# remarks\n", "\ufeff"])
def test_text_clouds_of_every_delimiter_are_the_same(delimiter, first, tmp_path):
    table = np.random.default_rng(1).normal(size=(7, 6))
    path = tmp_path / "cloud.dat"
    lines = "\n".join(delimiter.join(repr(float(value)) for value in row) for row in table)
    path.write_text(first + lines + "\n", encoding="utf-8")
    cloud = open_cloud(path)
    assert cloud.normals is not None
    np.testing.assert_array_equal(np.hstack([cloud.points_mm, cloud.normals]), table)
    assert cloud.notes == ("lengths are read as mm, since the file names no unit; give the units if they are not",)
    with pytest.raises(NoScanlines):
        open_recording(path)


def test_named_columns_are_found_wherever_they_stand():
    for first in ("nx ny nz intensity z y x", "//NX,NY,NZ,I,Z,Y,X"):
        cloud = read_xyz(f"{first}\n0 0 1 9 3 2 1\n".encode(), "a.txt", "m")
        assert cloud.points_mm.tolist() == [[1000.0, 2000.0, 3000.0]]
        assert cloud.normals is not None
        assert cloud.normals.tolist() == [[0.0, 0.0, 1.0]]


def test_bad_text_clouds_are_refused_with_the_line():
    for text, fact, words in [
        ("1 2\n", ContentDamaged, "line 1 has 2 values"),
        ("# x\n1 2 3\n\n1 2\n", ContentDamaged, "line 4 has 2 values"),
        ("1 2 3\n1 2 three\n", ContentDamaged, "line 2 holds 'three'"),
        ("nan 2 3\n", FileEmpty, "no point"),
        ("# nothing\n", FileEmpty, "no point"),
        ("x y z w\n1 2 3\n", HeaderDamaged, "names 4 columns"),
    ]:
        with pytest.raises(fact, match=words):
            read_xyz(text.encode(), "a.xyz", None)
    cloud = read_xyz(b"1 2 3 4\nnan 0 0 0\n1 2 3 4", "a.xyz", None)
    assert cloud.dropped == {"not_finite": 1}
    assert len(cloud.points_mm) + 1 == cloud.points_declared
    assert any("only the first 3 of 4" in note for note in cloud.notes)
    assert any("no line break" in note for note in cloud.notes)


def test_a_profile_table_is_a_cloud_too_and_is_told_by_its_header(tmp_path):
    path = tmp_path / "anything.xyz"
    path.write_text("\n".join(["# remark", HEADER, *rows()]))
    assert len(open_cloud(path).points_mm) == 20
    assert len(open_recording(path).lines) == 4
    path.write_bytes(b"line,x_mm,y_mm,z_mm\n0,1,2,\xff\n")
    with pytest.raises(FormatUnknown, match="UTF-8"):
        open_cloud(path)
