"""Range grids: every vertex leaves exactly once, and what was derived is true."""

from math import nan
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from scanner_service.storage.formats import (
    ContentDamaged,
    FileEmpty,
    FormatError,
    HeaderDamaged,
    LaserUnknown,
    OptionRefused,
    ReadOptions,
    Recording,
    SpacingUnknown,
    open_cloud,
    open_recording,
)
from scanner_service.storage.formats.parallel_lines import fit_parallel_lines
from scanner_service.storage.formats.ply import read_vertices
from scanner_service.storage.formats.range_grid import recording_of_grid
from scanner_service.storage.formats.spacing import median_point_spacing_mm, nominal_line_spacing_mm
from tests.unit.storage.ply_files import grid_file

BUNNY = Path(__file__).resolve().parents[4] / "shared" / "data" / "bunny"
LASER = ReadOptions(laser_mm=(0.0, 0.0, 500.0), units="mm")


def read(data, options=LASER) -> Recording:
    return recording_of_grid(read_vertices(data, "grid.ply", options.units), "grid.ply", options)


def points_of(recording):
    stacked = np.concatenate([line.points_mm for line in recording.lines])
    return stacked[np.isfinite(stacked).all(axis=1)]


def sloping_grid(rows=5, columns=4, spacing=0.5):
    """One column a line, `spacing` apart along x; y along the line, a wavy height."""
    return [
        (spacing * column, 0.8 * row, 3.0 + 0.3 * row * row + 0.2 * column)
        for row in range(rows)
        for column in range(columns)
    ]


@given(st.integers(1, 6), st.integers(1, 6), st.data())
@settings(max_examples=80)
def test_every_vertex_is_in_one_line_or_counted_under_one_reason(rows, columns, data):
    coordinate = st.sampled_from([0.0, 1.0, 2.5, float("nan"), float("inf")])
    vertices = data.draw(st.lists(st.tuples(coordinate, coordinate, coordinate), min_size=1, max_size=12))
    index = st.integers(0, len(vertices) - 1)
    cells = data.draw(st.lists(st.lists(index, max_size=3), min_size=rows * columns, max_size=rows * columns))
    along = data.draw(st.sampled_from(["column", "row"]))
    options = ReadOptions(laser_mm=(0.0, 0.0, 500.0), units="mm", line_spacing_mm=0.5, line_along=along)
    try:
        recording = read(grid_file("ascii", vertices, cells, rows, columns), options)
    except FileEmpty:
        assert not any(np.isfinite(vertices[cell[0]]).all() for cell in cells if cell)
        return
    assert recording.points_declared == len(vertices)
    assert recording.points + sum(recording.dropped.values()) == len(vertices)
    assert len(points_of(recording)) == recording.points
    unnamed = set(range(len(vertices))) - {item for cell in cells for item in cell}
    assert recording.dropped.get("unreferenced", 0) == sum(np.isfinite(vertices[item]).all() for item in unnamed)


def test_a_column_is_a_line_and_a_row_its_place():
    vertices = sloping_grid()
    cells = [[i] for i in range(20)]
    cells[6] = []  # row 1, column 2
    recording = read(grid_file("ascii", vertices, cells, 5, 4))
    assert [line.line_index for line in recording.lines] == [0, 1, 2, 3]
    for column, line in enumerate(recording.lines):
        for row in range(5):
            if (row, column) == (1, 2):
                assert np.isnan(line.points_mm[row]).all()
            else:
                assert line.points_mm[row].tolist() == list(vertices[4 * row + column])
    assert recording.dropped == {"unreferenced": 1}


def test_rows_can_be_the_lines_instead():
    vertices = [(y, x, z) for x, y, z in sloping_grid(rows=4, columns=5)]
    by_row = [vertices[5 * row + column] for row in range(4) for column in range(5)]
    options = ReadOptions(laser_mm=(0.0, 0.0, 500.0), units="mm", line_along="row")
    recording = read(grid_file("ascii", by_row, [[i] for i in range(20)], 4, 5), options)
    assert len(recording.lines) == 4
    assert recording.lines[2].points_mm.tolist() == [list(point) for point in by_row[10:15]]


def test_spacing_travel_and_plane_are_found_in_the_data():
    recording = read(grid_file("ascii", sloping_grid(), [[i] for i in range(20)], 5, 4))
    assert recording.line_spacing_mm == pytest.approx(0.5, abs=1e-12)
    for column, line in enumerate(recording.lines):
        assert line.travel.tolist() == line.plane_normal.tolist() == [1.0, 0.0, 0.0]
        assert line.position_mm == pytest.approx(0.5 * column, abs=1e-12)
        assert line.step_mm == pytest.approx(0.5, abs=1e-12) or column == 0
    assert any("line spacing 0.5000 mm, fitted" in note for note in recording.notes)


def test_columns_that_run_backwards_travel_backwards():
    vertices = [(-x, y, z) for x, y, z in sloping_grid()]
    recording = read(grid_file("ascii", vertices, [[i] for i in range(20)], 5, 4))
    assert recording.lines[0].travel.tolist() == [-1.0, 0.0, 0.0]
    assert recording.line_spacing_mm == pytest.approx(0.5)
    assert [line.position_mm for line in recording.lines] == pytest.approx([0.0, 0.5, 1.0, 1.5])


def test_an_open_laser_coordinate_is_the_place_of_the_line():
    options = ReadOptions(laser_mm=(nan, 10.0, 500.0), units="mm")
    recording = read(grid_file("ascii", sloping_grid(), [[i] for i in range(20)], 5, 4), options)
    assert [line.laser_mm.tolist() for line in recording.lines] == [[0.5 * i, 10.0, 500.0] for i in range(4)]
    with pytest.raises(OptionRefused, match="laser's y may be left open only"):
        read(
            grid_file("ascii", sloping_grid(), [[i] for i in range(20)], 5, 4),
            ReadOptions(laser_mm=(0.0, nan, 500.0), units="mm"),
        )


def test_a_given_spacing_is_taken_and_the_difference_said():
    options = ReadOptions(laser_mm=(0.0, 0.0, 500.0), units="mm", line_spacing_mm=0.25)
    recording = read(grid_file("ascii", sloping_grid(), [[i] for i in range(20)], 5, 4), options)
    assert {line.line_spacing_mm for line in recording.lines} == {0.25}
    assert any("as given, although the data say 0.5000 mm" in note for note in recording.notes)


def test_what_cannot_be_known_is_asked_for():
    cells = [[i] for i in range(20)]
    with pytest.raises(LaserUnknown, match="--laser"):
        read(grid_file("ascii", sloping_grid(), cells, 5, 4), ReadOptions(units="mm"))
    with pytest.raises(SpacingUnknown, match="--line-spacing"):
        read(grid_file("ascii", sloping_grid(20, 1), cells, 20, 1))
    with pytest.raises(HeaderDamaged, match="20 cells"):
        read(grid_file("ascii", sloping_grid(), cells, 5, 5))
    with pytest.raises(HeaderDamaged, match="num_cols"):
        read(grid_file("ascii", sloping_grid(), cells, 5, 4).replace(b"num_cols", b"num_kols"))
    with pytest.raises(ContentDamaged, match="names vertex 20"):
        read(grid_file("ascii", sloping_grid(), [*cells[:-1], [20]], 5, 4))


@pytest.mark.parametrize("spacing", [0.0, -1.0, nan, float("inf")])
def test_a_line_spacing_must_be_a_length(spacing):
    with pytest.raises(OptionRefused, match="greater than 0 mm"):
        ReadOptions(line_spacing_mm=spacing)


def test_other_options_that_cannot_be_meant_are_refused():
    for options in ({"units": "furlong"}, {"line_along": "diagonal"}, {"laser_mm": (nan, nan, 1.0)}):
        with pytest.raises(OptionRefused):
            ReadOptions(**options)


@given(st.integers(0, 2**32 - 1), st.floats(0.05, 2.0))
@settings(max_examples=40)
def test_parallel_planes_are_found_in_any_direction(seed, spacing):
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(rng=rng).as_matrix()
    number = np.arange(3, 23)
    line = np.repeat(np.arange(20), 30)
    along = np.tile(np.linspace(-8, 8, 30), 20)
    points = np.column_stack([along, spacing * number[line], 0.05 * along**2 + rng.normal(0, 1e-3, len(along))])
    fit = fit_parallel_lines(points @ rotation.T, line, number)
    assert fit is not None
    assert fit.normal @ rotation[:, 1] > np.cos(np.radians(0.6))
    assert fit.spacing_mm == pytest.approx(spacing, rel=0.02)


def test_lines_in_all_directions_have_no_common_plane():
    rng = np.random.default_rng(3)
    line = np.repeat(np.arange(12), 40)
    points = []
    for _ in range(12):
        flat = np.column_stack([np.linspace(-5, 5, 40), np.zeros(40), 0.1 * np.linspace(-5, 5, 40) ** 2])
        points.append(flat @ Rotation.random(rng=rng).as_matrix().T)
    assert fit_parallel_lines(np.concatenate(points), line, np.arange(12)) is None


def test_spacings_step_over_what_is_not_there():
    line = np.array([[0.0, 0, 0], [nan, nan, nan], [2.0, 0, 0], [3.0, 0, 0], [4.0, 0, 0]])
    assert median_point_spacing_mm([line]) == 1.0
    assert np.isnan(median_point_spacing_mm([line[:2]]))
    assert nominal_line_spacing_mm(np.array([0.0, 1, 2, 7]), np.array([0.0, 0.3, nan, 2.1])) == pytest.approx(0.3)
    assert np.isnan(nominal_line_spacing_mm(np.array([4.0, 4.0]), np.array([0.0, 1.0])))


bunny_only = pytest.mark.skipif(not BUNNY.is_dir(), reason="the Stanford scans are not beside the project")


@bunny_only
@pytest.mark.parametrize(("name", "vertices"), [("bun000", 40256), ("bun045", 40097), ("bun180", 40251)])
def test_all_vertices_of_a_stanford_scan_come_out_exactly_once(name, vertices):
    path = BUNNY / f"{name}.ply"
    recording = open_recording(path)
    assert (recording.points, recording.points_declared, dict(recording.dropped)) == (vertices, vertices, {})
    body = path.read_text().split("end_header\n")[1].split("\n")[:vertices]
    truth = np.array([[1000.0 * float(word) for word in row.split()] for row in body])
    got = points_of(recording)
    np.testing.assert_array_equal(got[np.lexsort(got.T)], truth[np.lexsort(truth.T)])
    np.testing.assert_array_equal(open_cloud(path, ReadOptions(units="m")).points_mm, truth)


@bunny_only
@pytest.mark.parametrize("name", ["bun000", "bun045", "bun180"])
def test_spacing_and_laser_of_a_stanford_scan_are_what_is_known_of_it(name):
    recording = open_recording(BUNNY / f"{name}.ply")
    assert len(recording.lines) == 512
    assert recording.line_spacing_mm == pytest.approx(0.5, abs=1e-9)
    assert 0.72 < recording.point_spacing_mm < 0.9
    for column, line in enumerate(recording.lines):
        assert len(line.points_mm) == 400
        assert line.position_mm == pytest.approx(-127.375 + 0.5 * column, abs=1e-6)
        assert line.laser_mm == pytest.approx([line.position_mm, 178.0, 1330.0])
        offset = line.points_mm[np.isfinite(line.points_mm).all(axis=1), 0] - line.position_mm
        assert np.abs(offset).max(initial=0.0) < 0.125 + 1e-6


@bunny_only
def test_a_stanford_scan_cut_at_any_thousandth_byte_is_refused():
    whole = (BUNNY / "bun000.ply").read_bytes()
    options = ReadOptions()
    for length in [*range(0, 12_000, 1000), *range(12_000, len(whole), 97_000), len(whole) - 500_000, len(whole) - 3]:
        with pytest.raises(FormatError, match="cut"):
            read(whole[:length], options)
