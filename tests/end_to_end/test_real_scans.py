"""Real range scans through the command line, judged by scipy, numpy and the merged surface of the same object."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from typer.testing import CliRunner

from scanner_service.cli import app
from scanner_service.storage.formats import ReadOptions, open_cloud
from tests.end_to_end.test_live_scan import read_ply
from tests.oracle import Q_MM, Oracle

ROOT = Path(__file__).resolve().parents[2]
BUNNY = ROOT.parent / "shared" / "data" / "bunny"
VERTICES = {"bun000": 40256, "bun045": 40097, "bun180": 40251}

LYING_HEADER = (
    b"ply\nformat ascii 1.0\nelement vertex 99999999999\n"
    + b"".join(b"property float %c\n" % axis for axis in b"xyz")
    + b"end_header\n0 0 0\n"
)

needs_bunny = pytest.mark.skipif(not BUNNY.is_dir(), reason="the Stanford range scans are not beside the project")


def run(*arguments):
    """A command in this process, which has its kernels already; other tests start it as a user does."""
    return CliRunner().invoke(app, list(map(str, arguments)))


def refusal_of(*arguments):
    """What a command that is refused says."""
    done = run(*arguments)
    assert done.exit_code == 1
    assert isinstance(done.exception, SystemExit), "no fault of the program"
    return done.output


def pose_of(name):
    """Rotation and translation (mm) to the world: Rᵀ(q)·p + t of the configuration's line."""
    for line in (BUNNY / "bun.conf").read_text().splitlines():
        fields = line.split()
        if fields[:2] == ["bmesh", f"{name}.ply"]:
            t, (x, y, z, w) = np.array(fields[2:5], float) * 1000, map(float, fields[5:9])
            rotation = np.array(
                [
                    [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                    [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                    [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
                ]
            )
            return rotation.T, t
    raise AssertionError(name)


def faces_of_merged_surface():
    """Centres (m, 3) in mm and unit normals (m, 3) of the merged surface's faces, read from its ASCII file."""
    text = (BUNNY / "bun_zipper.ply").read_text().split("end_header\n")[1].split()
    vertices = open_cloud(BUNNY / "bun_zipper.ply", ReadOptions(units="m")).points_mm
    faces = np.array(text[5 * len(vertices) :], dtype=int).reshape(-1, 4)[:, 1:]
    a, b, c = vertices[faces[:, 0]], vertices[faces[:, 1]], vertices[faces[:, 2]]
    normal = np.cross(b - a, c - a)
    return (a + b + c) / 3, normal / np.linalg.norm(normal, axis=1, keepdims=True)


@needs_bunny
@pytest.mark.parametrize("name", sorted(VERTICES))
def test_a_real_scan_is_accounted_for_exact_and_turned_the_right_way(name, tmp_path):
    done = run("replay", BUNNY / f"{name}.ply", "--out", tmp_path, "--json")
    assert done.exit_code == 0, done.stderr
    summary = json.loads(done.stdout)
    assert summary == json.loads((tmp_path / "summary.json").read_text())
    source = summary["losses"]["device"]
    assert source["points_declared"] == VERTICES[name] == summary["points"] + sum(source["dropped"].values())
    assert summary["line_spacing_mm"]["median"] == pytest.approx(0.5, abs=1e-3)

    rows = read_ply((tmp_path / "points.ply").read_bytes())
    assert len(rows) == summary["points"]
    points = np.column_stack([rows["x"], rows["y"], rows["z"]])
    normals = np.column_stack([rows["nx"], rows["ny"], rows["nz"]])
    laser = np.column_stack([rows[f"scalar_laser_{axis}"] for axis in "xyz"])
    reliable = rows["scalar_reliable"] == 1
    assert reliable.mean() >= 0.90
    assert (np.isnan(normals).any(axis=1) == ~reliable).all()

    oracle = Oracle(np.rint(points / Q_MM), rows["scalar_radius"], rows["scalar_scanline"], laser)
    counts = np.array([len(oracle.neighbour_rows(row)) for row in range(len(rows))])
    np.testing.assert_array_equal(rows["scalar_neighbours"], counts)
    for row in np.random.default_rng(1).choice(np.flatnonzero(reliable), 2000, replace=False):
        truth = oracle.at(row)
        assert truth.is_comparable
        assert np.linalg.norm(np.cross(normals[row], truth.normal)) < 1e-6

    rotation, translation = pose_of(name)
    centres, face_normals = faces_of_merged_surface()
    world = points @ rotation.T + translation
    distance, nearest = cKDTree(centres).query(world)
    assert np.median(distance) < 1.0  # the pose is the right one
    turned = np.einsum("ij,ij->i", normals @ rotation.T, face_normals[nearest]) > 0
    assert turned[reliable].mean() >= 0.995


@needs_bunny
def test_a_record_played_again_gives_the_same_files_bit_for_bit(tmp_path):
    first, again = tmp_path / "first", tmp_path / "again"
    record = tmp_path / "scan.sqlite"
    assert run("replay", BUNNY / "bun000.ply", "--out", first, "--record", record).exit_code == 0
    assert run("replay", record, "--out", again).exit_code == 0
    assert (first / "points.ply").read_bytes() == (again / "points.ply").read_bytes()
    for regions in ("regions.json",):
        a, b = (json.loads((folder / regions).read_text()) for folder in (first, again))
        assert a["regions"] == b["regions"]


@needs_bunny
@pytest.mark.parametrize(
    "rule",
    [["--radius", "2.5"], ["--rule", "flexible", "--max-radius", "5"], ["--rule", "global", "--max-radius", "5"]],
)
def test_a_plain_cloud_is_analysed_with_every_rule(rule, tmp_path):
    done = run("analyse", BUNNY / "bun_zipper.ply", "--units", "m", *rule, "--out", tmp_path, "--json")
    assert done.exit_code == 0, done.stderr
    summary = json.loads(done.stdout)
    rows = read_ply((tmp_path / "points.ply").read_bytes())
    assert len(rows) == summary["points"] == 35947
    assert (rows["scalar_reliable"] == 1).mean() > 0.85
    assert {"density.png", "regions.json", "summary.json"} <= {path.name for path in tmp_path.iterdir()}
    points = np.column_stack([rows["x"], rows["y"], rows["z"]])
    counts = cKDTree(points).query_ball_point(points[:500], rows["scalar_radius"][:500], return_length=True)
    np.testing.assert_array_equal(rows["scalar_neighbours"][:500], counts)
    if "flexible" in rule:
        assert np.median(rows["scalar_neighbours"]) == 20


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (None, "does not exist"),
        (b"", "is empty"),
        (LYING_HEADER, "99999999999"),
        (b"line,x_mm,y_mm,z_mm\n1,0,0,nope\n", "nope"),
        (b"\x00\x01\x02\x03" * 50, "none of the kinds"),
    ],
)
def test_a_file_that_cannot_be_used_is_refused_in_one_sentence(content, told, tmp_path):
    file = tmp_path / "scan.ply"
    if content is not None:
        file.write_bytes(content)
    assert told in refusal_of("replay", file, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_options_without_sense_are_refused_in_one_sentence(tmp_path):
    file = tmp_path / "profiles.csv"
    rows = [f"{line},{0.2 * k},{0.5 * line},0,3,{0.5 * line},200" for line in range(5) for k in range(8)]
    file.write_text("line,x_mm,y_mm,z_mm,laser_x_mm,laser_y_mm,laser_z_mm\n" + "\n".join(rows) + "\n")
    assert run("replay", file, "--out", tmp_path / "fine").exit_code == 0
    for options in ("--line-spacing", "0"), ("--line-spacing", "-1"), ("--density", "nan"), ("--speed", "0"):
        assert refusal_of("replay", file, "--out", tmp_path / "out", *options).strip()
