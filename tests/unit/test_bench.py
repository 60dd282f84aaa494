"""The benchmark of the live map says what it must, and notices when an answer is wrong."""

import dataclasses
import json
import math

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks import live_map as bench
from benchmarks.agreement import Agreement
from benchmarks.cloud import NOISE_MM, RADIUS_MM, make_lines
from benchmarks.live_run import Plan, settings_for
from benchmarks.peers import scipy_everything
from benchmarks.reader import Reader
from benchmarks.summary import summarise
from scanner_service.analysis.intake import QUANTUM_MM
from scanner_service.analysis.live_map import LiveMap
from scanner_service.cli import app
from scanner_service.commands import bench as bench_command
from tests.oracle import Oracle

KEYS = ("points_per_s", "ratio_open3d", "p50_s", "p99_s", "max_s", "last_to_first_tenth", "bytes_per_point")


@pytest.fixture(scope="module")
def small_scan():
    """A small map of the benchmark's own cloud, read now and then, with what is needed to check it."""
    lines = make_lines(20_000)
    points = sum(len(line.index) for line in lines)
    settings = settings_for(Plan(points, 1, each_line=False), points)
    live_map = LiveMap(settings)
    reader = Reader(live_map, points)
    for number, line in enumerate(lines):
        live_map.add(line)
        if number % 3 == 0:
            reader.take_update()
    reader.take_update()

    def new_agreement():
        return Agreement(lines, RADIUS_MM, 4.0 * RADIUS_MM, settings.max_normal_error_rad, np.random.default_rng(5))

    return live_map.snapshot(), reader, len(lines), new_agreement


def test_a_run_writes_every_key_and_agrees_with_the_oracle(tmp_path):
    file = tmp_path / "figures" / "live-map.json"
    arguments = (
        "--points 50000 --repeats 1 --threads 1 --checks 4 --without-peers --one-radius --warm-only --patience-s 0"
    )
    assert bench.main([*arguments.split(), "--json", str(file)]) == 0
    result = json.loads(file.read_text())
    figures = result["threads"]["1"]
    assert set(KEYS) <= set(figures)
    assert figures["ratio_open3d"] is None
    assert all(figures[key] > 0 for key in KEYS if key != "ratio_open3d")
    assert figures["disagreements"] == 0
    reader = figures["cases"]["reader"]
    assert reader["checked_points"] > reader["points"] >= 50_000  # every count, and the samples on the way
    assert reader["rows_the_reader_missed"] == 0
    assert reader["p50_s"] <= reader["p99_s"] <= reader["max_s"]


def test_answers_of_the_map_pass_the_check(small_scan):
    snapshot, _, lines, new_agreement = small_scan
    agreement = new_agreement()
    agreement.check(snapshot, lines)
    agreement.check_all_counts(snapshot, 1)
    assert agreement.checked > len(snapshot)
    assert agreement.failures.total() == 0


@pytest.mark.parametrize(
    ("field", "wrong", "failure"),
    [
        ("neighbours", lambda values: values + 1, "neighbours"),
        ("density_per_mm2", lambda values: values * 1.001, "density"),
        ("normals", lambda values: -values, "sign"),
        ("normals", lambda values: values[:, ::-1], "normal"),
        ("unreliable", lambda values: np.full_like(values, 1), "reliable"),
        ("settled", lambda values: ~values, "settled"),
        ("radius_mm", lambda values: values * 1.25, "radius rule"),
    ],
)
def test_a_wrong_answer_does_not_pass_the_check(small_scan, field, wrong, failure):
    snapshot, _, lines, new_agreement = small_scan
    agreement = new_agreement()
    agreement.check(dataclasses.replace(snapshot, **{field: wrong(getattr(snapshot, field))}), lines)
    assert agreement.failures[failure] > 0


def test_a_reader_that_takes_every_update_has_the_snapshot(small_scan):
    snapshot, reader, _, _ = small_scan
    assert reader.rows_missed(snapshot) == 0
    assert reader.rows_missed(dataclasses.replace(snapshot, settled=~snapshot.settled)) == len(snapshot)


def test_the_cloud_is_what_it_is_said_to_be():
    lines = make_lines(60_000)
    steps = [np.linalg.norm(np.diff(line.xyz_q[np.diff(line.index, prepend=-9) > 0], axis=0), axis=1) for line in lines]
    assert 0.15 <= np.median(np.concatenate(steps)) * QUANTUM_MM <= 0.2
    assert all(line.point_count == len(line.index) + line.dropped["dropout"] for line in lines)
    assert all(line.point_count == 1280 for line in lines)
    assert {round(line.position_mm / 0.2) for line in lines} == set(range(len(lines)))
    share = sum(len(line.index) for line in lines) / (1280 * len(lines))
    assert share == pytest.approx(0.995 * (1 - math.pi * 2.5**2 / 24**2), abs=0.01)


def test_scipy_as_a_peer_gives_what_the_oracle_gives():
    lines = make_lines(6_000)
    xyz_q = np.concatenate([line.xyz_q for line in lines])
    which = np.repeat(np.arange(len(lines)), [len(line.index) for line in lines])
    laser_mm = np.array([line.laser_mm for line in lines])[which]
    counts, normals = scipy_everything(xyz_q * QUANTUM_MM, laser_mm, RADIUS_MM)
    oracle = Oracle(xyz_q, np.full(len(xyz_q), RADIUS_MM), which, laser_mm, NOISE_MM)
    for row in range(0, len(xyz_q), 97):
        truth = oracle.at(row)
        assert counts[row] == truth.neighbours
        if truth.is_comparable:
            assert normals[row] == pytest.approx(truth.normal, abs=1e-6)


def test_figures_come_from_the_quiet_rounds_and_ratios_from_figures():
    def ran(points_per_s, others):
        return {"points_per_s": points_per_s, "cores_taken_by_others": others, "bytes_per_point": 1.0} | cost

    cost = {"p50_s": 1.0, "p99_s": 2.0, "max_s": 3.0, "last_to_first_tenth": 1.0}
    rounds = {
        ("reader", 2): [ran(8.0, 0.0), ran(1.0, 1.0), ran(4.0, 0.1)],
        ("each_line", 2): [ran(2.0, 0.9), ran(1.0, 1.1)],
        ("open3d", 2): [ran(3.0, 0.0)],
    }
    figures = summarise(rounds)["2"]
    assert figures["points_per_s"] == 6.0
    assert figures["ratio_open3d"] == 2.0
    assert figures["ratio_scipy"] is None
    assert figures["points_per_s_each_line"] == 1.5
    assert figures["cases"]["each_line"]["quiet_rounds"] == 0


def test_more_threads_than_cores_are_refused(capsys):
    with pytest.raises(SystemExit):
        bench.main(["--threads", "100000"])
    assert "ask for no more threads" in capsys.readouterr().err


def test_the_command_says_plainly_that_the_benchmarks_are_absent(tmp_path, monkeypatch):
    installed = tmp_path / "site-packages" / "scanner_service" / "__init__.py"
    installed.parent.mkdir(parents=True)
    installed.touch()
    assert bench_command.project_root() is not None
    monkeypatch.setattr(bench_command.scanner_service, "__file__", str(installed))
    assert bench_command.project_root() is None
    answer = CliRunner().invoke(app, ["bench", "live-map"])
    assert answer.exit_code == 1
    assert "clone the project" in " ".join(answer.output.split())
