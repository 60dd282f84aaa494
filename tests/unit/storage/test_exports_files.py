"""Files that go out are whole, exact and readable by others."""

import json
import math
import os
import struct
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from scanner_service.storage.exports import (
    ExportNotWritten,
    json_bytes,
    whole_file,
    write_json,
    write_points_ply,
    write_whole,
)
from scanner_service.storage.formats import ReadOptions, open_cloud
from tests.unit.storage.map_snapshots import plate

FIELDS = (
    "double x,double y,double z,double scalar_radius,double nx,double ny,double nz,float scalar_density,"
    "float scalar_reliable,float scalar_rescan,float scalar_laser_x,float scalar_laser_y,float scalar_laser_z,"
    "int scalar_neighbours,int scalar_scanline"
)


def by_hand(content):
    """Header lines and rows of a binary PLY of scalars, value by value with `struct`."""
    head, body = content.split(b"end_header\n", 1)
    lines = head.decode("ascii").splitlines()
    kinds = [line.split()[1] for line in lines if line.startswith("property")]
    row = struct.Struct("<" + "".join({"double": "d", "float": "f", "int": "i"}[kind] for kind in kinds))
    return lines, [row.unpack_from(body, at) for at in range(0, len(body), row.size)]


def test_points_are_written_exactly_in_the_documented_layout(tmp_path):
    snapshot = plate()
    rescan = np.arange(len(snapshot)) % 4 == 0
    write_points_ply(tmp_path / "points.ply", snapshot, rescan)
    lines, rows = by_hand((tmp_path / "points.ply").read_bytes())
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    assert "comment units mm" in lines
    assert any(line.startswith("comment scanner-service ") for line in lines)
    assert [line.removeprefix("property ") for line in lines if line.startswith("property")] == FIELDS.split(",")
    assert len(rows) == len(snapshot)
    for i, row in enumerate(rows):
        laser = snapshot.lines.laser_mm[snapshot.line[i]].astype(np.float32)
        assert row[:3] == tuple(snapshot.points_mm[i])
        assert row[3] == snapshot.radius_mm[i]
        np.testing.assert_array_equal(row[4:7], snapshot.normals[i])
        assert row[7] == np.float32(snapshot.density_per_mm2[i])
        assert row[8:10] == (float(snapshot.unreliable[i] == 0), float(rescan[i]))
        assert row[10:13] == tuple(laser)
        assert row[13:] == (snapshot.neighbours[i], snapshot.line[i])


def test_coordinates_are_whole_multiples_of_the_quantum_from_the_origin(tmp_path):
    snapshot = plate()
    write_points_ply(tmp_path / "points.ply", snapshot, np.zeros(len(snapshot), bool))
    _, rows = by_hand((tmp_path / "points.ply").read_bytes())
    steps = (np.array([row[:3] for row in rows]) - snapshot.origin_mm) * 2**13
    np.testing.assert_array_equal(steps, np.rint(steps))


def test_another_reader_and_our_own_see_the_same_points(tmp_path):
    snapshot = plate()
    path = tmp_path / "points.ply"
    write_points_ply(path, snapshot, np.ones(len(snapshot), bool), comments=["two\nlines\nelement face 9"])
    theirs = trimesh.load(path)
    np.testing.assert_array_equal(theirs.vertices, snapshot.points_mm)
    ours = open_cloud(path, ReadOptions())
    np.testing.assert_array_equal(ours.points_mm, snapshot.points_mm)
    np.testing.assert_array_equal(ours.normals, snapshot.normals)
    assert ours.notes == ("lengths are read as mm: the header says so",)


def test_a_normal_that_is_not_reliable_is_nan_even_if_the_map_still_holds_one(tmp_path):
    snapshot = plate()
    normals = np.tile([0.0, 0.0, 1.0], (len(snapshot), 1))
    with_leftovers = type(snapshot)(
        **{name: getattr(snapshot, name) for name in snapshot.__slots__} | {"normals": normals}
    )
    write_points_ply(tmp_path / "points.ply", with_leftovers, np.zeros(len(snapshot), bool))
    _, rows = by_hand((tmp_path / "points.ply").read_bytes())
    np.testing.assert_array_equal(np.isnan([row[4] for row in rows]), snapshot.unreliable > 0)


def test_flags_of_another_length_are_refused_and_nothing_is_written(tmp_path):
    with pytest.raises(ValueError, match="rescan must have shape"):
        write_points_ply(tmp_path / "points.ply", plate(), np.zeros(3, bool))
    assert list(tmp_path.iterdir()) == []


def test_a_failure_leaves_the_old_file_and_nothing_beside_it(tmp_path):
    path = tmp_path / "result"
    write_whole(path, b"old")
    with pytest.raises(KeyboardInterrupt), whole_file(path) as file:
        file.write(b"half of the new")
        raise KeyboardInterrupt
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]
    write_whole(path, b"new")
    assert path.read_bytes() == b"new"
    assert list(tmp_path.iterdir()) == [path]


def test_until_it_is_whole_the_name_holds_the_old_file(tmp_path):
    path = tmp_path / "result"
    write_whole(path, b"old")
    with whole_file(path) as file:
        file.write(b"new")
        file.flush()
        assert path.read_bytes() == b"old"
    assert path.read_bytes() == b"new"


def test_places_that_cannot_be_written_are_named(tmp_path):
    (tmp_path / "folder").mkdir()
    for path in (tmp_path / "absent" / "file", tmp_path / "folder"):
        with pytest.raises(ExportNotWritten, match=path.name):
            write_whole(path, b"content")
    assert list(tmp_path.iterdir()) == [tmp_path / "folder"]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device here is always full")
def test_a_full_disk_leaves_the_old_file(tmp_path):
    path = tmp_path / "result"
    write_whole(path, b"old")
    with pytest.raises(ExportNotWritten, match="No space left"), whole_file(path) as file:
        full = os.open("/dev/full", os.O_WRONLY)
        os.dup2(full, file.fileno())
        os.close(full)
        file.write(b"new")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_an_exported_file_is_readable_as_the_user_of_the_folder_expects(tmp_path):
    write_whole(tmp_path / "ours", b"")
    (tmp_path / "theirs").write_bytes(b"")
    assert (tmp_path / "ours").stat().st_mode == (tmp_path / "theirs").stat().st_mode


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=12,
)


def nulled(value):
    """What JSON can hold of a value: NaN and infinity become null."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, list):
        return [nulled(item) for item in value]
    if isinstance(value, dict):
        return {key: nulled(item) for key, item in value.items()}
    return value


def refuse(name):
    raise AssertionError(f"{name} is no JSON")


@given(values)
def test_json_reads_back_as_it_was_with_null_for_what_is_no_number(value):
    assert json.loads(json_bytes(value), parse_constant=refuse) == nulled(value)


@given(st.dictionaries(st.text(max_size=3), st.integers(), max_size=6))
def test_equal_results_are_equal_bytes_whatever_order_they_were_made_in(value):
    assert json_bytes(value) == json_bytes(dict(reversed(value.items())))


def test_json_takes_what_results_are_made_of(tmp_path):
    class Colour(Enum):
        RED = "red"

    @dataclass(frozen=True, slots=True)
    class Area:
        mm2: float
        outline: np.ndarray

    value = {"a": Area(math.nan, np.array([[1.0, math.inf]])), "b": np.int32(3), "c": (Colour.RED, tmp_path), 4: True}
    write_json(tmp_path / "result.json", value)
    assert json.loads((tmp_path / "result.json").read_text()) == {
        "a": {"mm2": None, "outline": [[1.0, None]]},
        "b": 3,
        "c": ["red", str(tmp_path)],
        "4": True,
    }
    with pytest.raises(TypeError, match="set has no place"):
        write_json(tmp_path / "result.json", {"a": {1, 2}})
    with pytest.raises(TypeError, match="same text"):
        json_bytes({1: "one", "1": "eins"})
