"""`scanner compare` and `scanner analyse --method`: tables, files, and plain sentences for what cannot be meant."""

import csv
import json
import math

import numpy as np
import pytest
from typer.testing import CliRunner

from scanner_service.analysis.comparison.noise import NoiseLevel, add_noise
from scanner_service.analysis.comparison.peers import plain_pca
from scanner_service.analysis.comparison.running import Contestant, Meter, compare
from scanner_service.analysis.comparison.scoring import score
from scanner_service.analysis.comparison.shapes import SHAPES
from scanner_service.analysis.errors import MethodRefused
from scanner_service.cli import app
from scanner_service.sessions.settings import SessionSettings
from scanner_service.storage.formats import open_cloud
from tests.unit.sessions.test_tiles import recorded

RUNNER = CliRunner()


def run(*arguments):
    return RUNNER.invoke(app, [str(argument) for argument in arguments])


def one_line(answer):
    return " ".join(answer.output.split())


@pytest.fixture
def ball(tmp_path):
    cloud = SHAPES["sphere"](300, np.random.default_rng(1))
    file = tmp_path / "ball.xyz"
    np.savetxt(file, np.column_stack([cloud.points_mm, cloud.normals]))
    return file


def test_noise_is_uniform_and_as_large_as_it_is_said_to_be():
    points = SHAPES["cylinder"](3000, np.random.default_rng(2)).points_mm
    moved = add_noise(points, NoiseLevel("box", 0.01), np.random.default_rng(3)) - points
    side = np.ptp(points, axis=0).max()
    assert np.abs(moved).max() <= 0.01 * side
    assert moved.std() == pytest.approx(0.01 * side / math.sqrt(3), rel=0.03)
    grid = np.array([[x, y, z] for x in range(6) for y in range(6) for z in range(6)], dtype=float)
    moved = add_noise(grid, NoiseLevel("spacing", 0.5), np.random.default_rng(4)) - grid
    inner = ((grid > 0) & (grid < 5)).all(axis=1)
    assert 0.45 < np.abs(moved[inner]).max() <= 0.5


def test_a_score_counts_angles_without_sign_and_missing_ones_against_the_shares():
    known = np.tile([0.0, 0.0, 1.0], (4, 1))
    tilt = math.radians(7.0)
    found = np.array([[0, 0, 1], [0, 0, -1], [math.sin(tilt), 0, math.cos(tilt)], [np.nan] * 3])
    result = score(found, known)
    assert result.missing == 1
    assert (result.within_5_deg, result.within_10_deg) == (0.5, 0.75)
    assert math.degrees(result.rms_rad) == pytest.approx(7.0 / math.sqrt(3))


def test_the_best_setting_counts_and_a_refusal_is_a_row():
    cloud = SHAPES["sphere"](400, np.random.default_rng(5))

    def refuses(points):
        raise MethodRefused("not today")

    contestants = [
        Contestant("right", {"wrong": lambda points: np.roll(cloud.normals[: len(points)], 1, axis=1),
                             "right": lambda points: cloud.normals[: len(points)]}),
    ]  # fmt: skip
    meter = Meter(lambda work: (work(), 1.0, 2.0))
    rows = compare([cloud], contestants, meter, np.random.default_rng(6), levels=[NoiseLevel("box", 0.0)])
    assert (rows[0].setting, rows[0].score.rms_rad, rows[0].seconds) == ("right", 0.0, 1.0)
    picky = Contestant("picky", {"": lambda points: points if len(points) == 200 else refuses(points)})
    row = compare([cloud], [picky], meter, np.random.default_rng(6), levels=[NoiseLevel("box", 0.0)])[0]
    assert row.failure == "not today"
    assert math.isnan(row.score.rms_rad)


def test_plain_pca_is_right_on_a_sphere():
    cloud = SHAPES["sphere"](2000, np.random.default_rng(7))
    assert math.degrees(score(plain_pca(cloud.points_mm, 20), cloud.normals).rms_rad) < 2.0


def test_compare_writes_a_table_and_a_picture(ball, tmp_path):
    arguments = ["--method", "gaussian", "--method", "big_delaunay_balls", "--noise", "0box", "--noise", "1spacing"]
    answer = run("compare", ball, *arguments, "--out", tmp_path / "out", "--json")
    assert answer.exit_code == 0, answer.output
    rows = json.loads((tmp_path / "out" / "comparison.json").read_text())["rows"]
    assert json.loads(answer.stdout)["rows"] == rows
    assert [(row["noise"], row["method"]) for row in rows] == [
        (noise, method) for noise in ("none", "1 spacing") for method in ("gaussian", "big_delaunay_balls")
    ]
    assert all(0.0 < row["rms_deg"] < 60.0 and row["cpu_s"] >= 0.0 for row in rows)
    with (tmp_path / "out" / "comparison.csv").open() as file:
        assert [row["method"] for row in csv.DictReader(file)] == [row["method"] for row in rows]
    assert (tmp_path / "out" / "comparison.png").read_bytes().startswith(b"\x89PNG")
    told = run("compare", "--shape", "edge", "--points", 60, "--method", "gaussian", "--out", tmp_path / "out")
    assert told.exit_code == 0, told.output
    assert "rms error in degrees" in told.output


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--shape", "cube"], "there is no shape cube"),
        (["--method", "magic"], "there is no method magic"),
        (["--noise", "much"], "0.01box or 2spacing"),
        (["--noise", "-1box"], "0.01box or 2spacing"),
        (["absent.xyz"], "does not exist"),
    ],
)
def test_compare_refuses_in_one_sentence(arguments, said, tmp_path):
    answer = run("compare", *arguments, "--out", tmp_path / "out")
    assert answer.exit_code == 1
    assert said in one_line(answer)


def test_a_cloud_without_normals_cannot_be_compared(tmp_path):
    np.savetxt(tmp_path / "bare.xyz", np.random.default_rng(8).normal(size=(50, 3)))
    answer = run("compare", tmp_path / "bare.xyz", "--out", tmp_path / "out")
    assert answer.exit_code == 1
    assert "has no normals to compare with" in one_line(answer)


@pytest.mark.parametrize("method", ["orthogonal_distance", "adaptive_radius", "general_quadric"])
def test_analyse_by_a_method_writes_its_values(ball, tmp_path, method):
    out = tmp_path / "out"
    answer = run("analyse", ball, "--method", method, "--seen-from", "0,0,100", "--out", out, "--json")
    assert answer.exit_code == 0, answer.output
    summary = json.loads(answer.stdout)
    assert summary["method"] == method
    assert sum(summary["reasons"].values()) == 300
    assert summary["against_reference"]["median_deg"] < 10.0
    written = open_cloud(out / "points.ply")
    given = np.isfinite(written.normals).all(axis=1)
    towards = np.array([0.0, 0.0, 100.0]) - written.points_mm
    assert ((written.normals * towards).sum(axis=1)[given] >= 0).all()
    assert f"comment method {method}".encode() in (out / "points.ply").read_bytes()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--neighbours", "20"], "belongs to --method"),
        (["--method", "gaussian", "--rule", "global"], "leave it out with --method"),
        (["--method", "gaussian", "--neighbours", "20"], "does not read neighbours"),
        (["--method", "magic"], "there is no method magic"),
        (["--method", "fixed_radius", "--radius", "-1"], "greater than 0"),
        (["--method", "gaussian", "--session", "x"], "not a record"),
    ],
)
def test_analyse_refuses_options_without_effect(ball, tmp_path, arguments, said):
    answer = run("analyse", ball, *arguments, "--out", tmp_path / "out")
    assert answer.exit_code == 1, answer.output
    assert said in one_line(answer)


def test_a_session_is_compared_with_its_live_map_and_the_figures_are_called_differences(tmp_path):
    record = tmp_path / "record.sqlite"
    recorded(record, SessionSettings(max_points=20_000), withdraw=True)
    out = tmp_path / "out"
    chosen = ["--session", "latest", "--method", "gaussian", "--noise", "0box", "--out", out]
    answer = run("compare", record, *chosen)
    assert answer.exit_code == 0, answer.output
    assert "differences from the normals of the live map" in one_line(answer)
    assert "rms error" not in one_line(answer)
    assert "2,250 not counted" in one_line(answer)  # the pass that was withdrawn
    (row,) = json.loads((out / "comparison.json").read_text())["rows"]
    assert (row["reference"], row["points"]) == ("live map", 30 * 70 + 12 * 40)
    assert row["median_deg"] < 5.0
    assert run("compare", record, "--session", "nobody", "--out", out).exit_code == 1

    written = run("export", "latest", "--record", record, "--format", "ply", "--format", "pcd", "--out", out / "files")
    assert written.exit_code == 0, written.output
    points = ["--method", "gaussian", "--noise", "0box", "--out", out]
    for file in (next((out / "files").rglob("*.ply")), next((out / "files").rglob("*.pcd"))):
        answer = run("compare", file, *points)
        assert answer.exit_code == 0, answer.output
        assert "differences from the normals of the live map" in one_line(answer), file
        assert "rms error" not in one_line(answer)
    assert run("compare", "--session", "latest", "--out", out).exit_code == 1
