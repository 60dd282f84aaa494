"""The benchmarks of range queries and of orientation say what they must."""

import json

import numpy as np
import pytest
from scipy.spatial import cKDTree

from benchmarks import graphs, neighbours, orientation


def test_every_structure_covers_the_same_neighbours_and_the_cost_of_lists_grows_with_them(tmp_path, capsys):
    file = tmp_path / "deep" / "neighbours.json"
    arguments = ["--points", "4000", "--repeats", "1", "--json", str(file), "--out", str(tmp_path)]
    assert neighbours.main(arguments) == 0
    figures = json.loads(file.read_text())
    found = figures["structures"]
    assert {"live_map", "ckdtree_counts", "ckdtree_lists"} <= set(found)
    covered = [[row["neighbours"] for row in found[name]["rows"]] for name in ("ckdtree_counts", "ckdtree_lists")]
    assert covered[0] == covered[1]
    assert [row["neighbours"] for row in found["live_map"]["rows"]] == pytest.approx(covered[0], rel=0.05)
    assert (tmp_path / "neighbours.png").stat().st_size > 10_000
    assert "exponent of r" in capsys.readouterr().out


def test_the_exponent_is_the_power_of_the_radius():
    rows = [{"radius_mm": r, "us_per_query": 3.0 * r**2.5} for r in (1.0, 2.0, 3.0, 5.0)]
    assert neighbours.exponent(rows) == pytest.approx(2.5)


def test_the_cloud_of_orientation_has_normals_across_it_and_the_radius_covers_what_it_says():
    points, normals, radius_mm = orientation.make_cloud(20_000)
    tree = cKDTree(points)
    assert np.mean(tree.query_ball_point(points, radius_mm, return_length=True)) == pytest.approx(16, rel=0.15)
    near = points[tree.query(points, 8)[1]] - points[:, None]
    sharpest_mm = 60.0**2 / 100.0  # least radius of curvature
    bend = (near**2).sum(axis=2) / (2.0 * sharpest_mm)
    assert (np.abs((near * normals[:, None]).sum(axis=2)) < 1.1 * bend + 0.03).all()
    assert ((points * normals).sum(axis=1) > 0).all()


def test_a_run_orients_all_points_outwards(tmp_path):
    file = tmp_path / "orientation.json"
    assert orientation.main(["--points", "5000", "--threads", "1", "--without-peers", "--json", str(file)]) == 0
    row = json.loads(file.read_text())["tools"]["scanner"]
    assert row["right_share"] == 1.0
    assert row["without_normal"] < 0.02 * 5000
    assert row["wall_s"] >= row["normals_s"] > 0


def test_a_graph_is_measured_in_a_process_of_its_own_and_its_edges_are_counted(tmp_path, capsys):
    file = tmp_path / "graphs.json"
    assert graphs.main(["--points", "700", "--graph", "euclidean_spanning_tree", "--json", str(file)]) == 0
    row = json.loads(file.read_text())["graphs"]["euclidean_spanning_tree"]
    assert row["edges"] == 699
    assert 0 < row["before_bytes"] <= row["peak_bytes"]
    assert "699 edges" in capsys.readouterr().out
