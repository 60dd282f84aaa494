"""The picture of the density map: what is seen, in the right place and in the right colour."""

import struct
import zlib
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scanner_service.analysis.cloud import analyse_cloud
from scanner_service.storage.exports.density_png import density_figure, density_png
from scanner_service.storage.exports.density_raster import rasterise, view_along
from scanner_service.storage.exports.label_places import label_places
from tests.unit.storage.map_snapshots import plate

DOWN = np.array([0.0, 0.0, -1.0])


@dataclass(frozen=True)
class Region:
    number: int
    reason: str
    outline_mm: tuple


def pixels(png):
    """Height, width and RGBA of a PNG, decoded by hand (filters 0 to 4, 8 bits, no interlace)."""
    assert png.startswith(b"\x89PNG\r\n\x1a\n")
    at, data, size = 8, b"", (0, 0)
    while at < len(png):
        length, kind = struct.unpack_from(">I4s", png, at)
        chunk = png[at + 8 : at + 8 + length]
        if kind == b"IHDR":
            size = struct.unpack(">II", chunk[:8])
            assert chunk[8:] == bytes([8, 6, 0, 0, 0])
        data += chunk if kind == b"IDAT" else b""
        at += length + 12
    width, height = size
    raw = zlib.decompress(data)
    assert len(raw) == height * (1 + 4 * width)
    return height, width


@given(st.lists(st.floats(-1, 1), min_size=3, max_size=3).filter(lambda v: np.linalg.norm(v) > 1e-3))
def test_a_view_is_a_right_handed_frame_that_looks_where_it_is_told(direction):
    view = view_along(np.array(direction))
    frame = np.stack([view.right, view.up, view.back])
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(frame) == pytest.approx(1.0)
    np.testing.assert_allclose(-view.back, np.array(direction) / np.linalg.norm(direction), atol=1e-12)


def test_seen_from_above_x_is_to_the_right_and_y_up():
    view = view_along(DOWN)
    assert (view.right.tolist(), view.up.tolist()) == ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    with pytest.raises(ValueError, match="direction"):
        view_along(np.zeros(3))


def test_each_judged_point_is_seen_where_it_lies_with_its_own_density():
    snapshot = plate()
    raster = rasterise(snapshot, view_along(DOWN), 300)
    column = ((snapshot.points_mm[:, 0] - raster.left_mm) / raster.pixel_mm).astype(int)
    row = ((snapshot.points_mm[:, 1] - raster.bottom_mm) / raster.pixel_mm).astype(int)
    good = snapshot.settled & snapshot.reliable
    seen = raster.density_per_mm2[row, column]
    np.testing.assert_allclose(seen[good], snapshot.density_per_mm2[good])
    assert np.isnan(seen[~good]).all()
    assert raster.seen[row, column].all()


def test_nothing_is_shown_further_than_the_reach_from_a_point():
    snapshot = plate()
    raster = rasterise(snapshot, view_along(DOWN), 200)
    rows, columns = np.nonzero(raster.seen)
    centre = np.column_stack([columns + 0.5, rows + 0.5]) * raster.pixel_mm + [raster.left_mm, raster.bottom_mm]
    distance = np.linalg.norm(centre[:, None] - snapshot.points_mm[None, :, :2], axis=2).min(axis=1)
    assert distance.max() <= raster.reach_mm + raster.pixel_mm
    assert not raster.seen.all()


def test_of_two_sheets_the_nearer_one_is_seen_from_either_side():
    upper = plate()
    both = {name: getattr(upper, name) for name in upper.__slots__}
    for name, value in both.items():
        if isinstance(value, np.ndarray) and len(value) == len(upper):
            both[name] = np.concatenate([value, value])
    n = len(upper)
    down = np.where(np.arange(2 * n)[:, None] < n, 1.0, -1.0)
    both["points_mm"] = both["points_mm"] - np.where(np.arange(2 * n)[:, None] < n, 0.0, [0.0, 0.0, 0.8])
    both["normals"] = both["normals"] * down
    both["density_per_mm2"] = np.where(np.arange(2 * n) < n, 5.0, 50.0)
    both["settled"] = np.ones(2 * n, bool)
    thin_wall = type(upper)(**both)
    for direction, density in ((DOWN, 5.0), (-DOWN, 50.0)):
        shown = rasterise(thin_wall, view_along(direction), 100).density_per_mm2
        turned = shown[np.isfinite(shown)]
        assert len(turned) > 1000
        assert np.mean(turned == density) > 0.99


@pytest.mark.parametrize("colours", ["viridis", "blue-red"])
def test_a_picture_is_a_png_whatever_names_and_regions_there_are(colours):
    square = np.array([[100.0, -7.0, 0.0], [102.0, -7.0, 0.0], [102.0, -5.5, 0.0]])
    regions = [Region(1, "steep", (square,)), Region(2, "no $such$ thing_", (square[:1],)), Region(3, "sparse", ())]
    png = density_png(
        plate(),
        regions,
        session_name="a$b^{$ \n 測定 \x07",
        when="today",
        coverage=0.9999,
        required_per_mm2=12.0,
        colours=colours,
        dpi=60,
    )
    height, width = pixels(png)
    assert 390 <= width <= 660
    assert 252 <= height <= 495


def test_of_many_regions_the_most_urgent_are_named_and_the_picture_says_how_many_are_not():
    square = np.array([[0.0, 0.0, 0.0], [0.2, 0.0, 0.0], [0.2, 0.2, 0.0], [0.0, 0.2, 0.0]])
    for count in (3, 62):
        corners = [np.array([0.3 * (k % 8), 0.3 * (k // 8), 0.0]) for k in range(count)]
        regions = [Region(100 + k, "sparse", (square + corner,)) for k, corner in enumerate(corners)]
        figure = density_figure(plate(), regions, session_name="crowd")
        named = [text.get_text() for text in figure.axes[0].texts]
        assert named == [str(region.number) for region in regions[:24]]
        lines = [line for line in figure.axes[0].lines if line.get_path_effects()]
        assert len(lines) == count  # all are outlined, those without a name more thinly
        assert {line.get_linewidth() > 1.0 for line in lines[24:]} <= {False}
        (legend,) = figure.legends
        remark = legend.get_title().get_text()
        assert ("of 62 regions the 24 most urgent are named, the 38 others" in remark) == (count == 62)


def test_an_empty_map_and_a_single_point_have_a_picture_too():
    snapshot = plate()
    for count in (0, 1):
        part = {name: getattr(snapshot, name) for name in snapshot.__slots__}
        for name, value in part.items():
            if isinstance(value, np.ndarray) and len(value) == len(snapshot):
                part[name] = value[:count].copy()
        pixels(density_png(type(snapshot)(**part), session_name="first light", dpi=40))


def test_the_region_s_outline_is_drawn_and_unknown_colours_are_refused():
    snapshot = plate()
    square = np.array([[100.5, -7.0, 0.0], [102.0, -7.0, 0.0], [102.0, -5.5, 0.0], [100.5, -5.5, 0.0]])
    without = density_png(snapshot, session_name="s", dpi=40)
    assert density_png(snapshot, [Region(1, "steep", (square,))], session_name="s", dpi=40) != without
    with pytest.raises(ValueError, match="viridis or blue-red"):
        density_png(snapshot, session_name="s", colours="jet")


def test_threads_that_draw_at_once_draw_the_same():
    snapshot = plate()
    with ThreadPoolExecutor(4) as pool:
        pictures = set(pool.map(lambda _: density_png(snapshot, session_name="s", dpi=40), range(8)))
    assert len(pictures) == 1


@given(st.lists(st.tuples(st.floats(-50, 50), st.floats(-50, 50)), max_size=12))
def test_few_labels_never_cover_each_other(anchors):
    places = label_places(anchors, [(0.0, 0.0)] * len(anchors), (4.0, 3.0))
    for i, one in enumerate(places):
        for other in places[:i]:
            assert abs(one[0] - other[0]) >= 4.0 or abs(one[1] - other[1]) >= 3.0


@pytest.mark.parametrize("scale", [1e-2, 1.0, 1e2])
def test_a_plain_cloud_is_drawn_closed_whatever_its_size(scale):
    """Points of unknown spacing reach as far as their neighbourhoods say: neither dust nor one blot."""
    x, y = np.meshgrid(np.arange(20.0), np.arange(20.0))
    cloud = np.column_stack([x.ravel(), y.ravel(), np.zeros(400)]) * scale
    hole = (abs(cloud[:, 0] - 9.5 * scale) < 4 * scale) & (abs(cloud[:, 1] - 9.5 * scale) < 4 * scale)
    snapshot = analyse_cloud(cloud[~hole], "flexible", uncertainty_mm=0.1 * scale).snapshot
    raster = rasterise(snapshot, view_along(DOWN), 200)
    assert 0.6 * scale < raster.reach_mm < 1.5 * scale
    row, column = (int((9.5 * scale - low) / raster.pixel_mm) for low in (raster.bottom_mm, raster.left_mm))
    assert not raster.seen[row, column]
    row, column = (int((1.5 * scale - low) / raster.pixel_mm) for low in (raster.bottom_mm, raster.left_mm))
    assert raster.seen[row, column]
