"""`scanner analyse --orient` turns normals outwards, and tells how sure it is."""

import json

import numpy as np
from typer.testing import CliRunner

from scanner_service.cli import app


def write_ball(path, count=4000):
    points = np.random.default_rng(0).normal(size=(count, 3))
    points *= 5.0 / np.linalg.norm(points, axis=1)[:, None]
    np.savetxt(path, points, fmt="%.6f")


def test_a_ball_is_turned_outwards_and_the_files_say_so(tmp_path):
    write_ball(tmp_path / "ball.xyz")
    out = tmp_path / "out"
    arguments = ["analyse", str(tmp_path / "ball.xyz"), "--radius", "0.9", "--units", "mm", "--out", str(out)]
    answer = CliRunner().invoke(app, [*arguments, "--orient", "--json"])
    assert answer.exit_code == 0, answer.output
    told = json.loads((out / "summary.json").read_text())
    assert told["orientation"]["components"] == 1
    assert told["orientation"]["largest_components"][0]["confidence"] == 1.0
    assert told["orientation"]["largest_components"][0]["warning"] is None
    assert not any("upwards" in note for note in told["notes"])
    header, body = (out / "oriented.ply").read_bytes().split(b"end_header\n", 1)
    assert b"element vertex 4000" in header
    kinds = [(name, "<f8") for name in ("x", "y", "z", "nx", "ny", "nz")] + [("component", "<i4"), ("sure", "<f4")]
    rows = np.frombuffer(body, dtype=kinds)
    given = rows["component"] == 0
    assert given.sum() > 3900
    assert (rows["sure"][given] == 1).all()
    along = rows["x"] * rows["nx"] + rows["y"] * rows["ny"] + rows["z"] * rows["nz"]
    assert (along[given] > 0).all()


def test_a_viewpoint_and_orientation_exclude_each_other(tmp_path):
    write_ball(tmp_path / "ball.xyz", 100)
    answer = CliRunner().invoke(
        app, ["analyse", str(tmp_path / "ball.xyz"), "--orient", "--seen-from", "0,0,9", "--out", str(tmp_path)]
    )
    assert answer.exit_code == 1
    assert "leave one of them out" in " ".join(answer.output.split())
