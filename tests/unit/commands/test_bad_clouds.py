"""Clouds that no method can make sense of: the command ends with reasons or one sentence, with every method."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from scanner_service.analysis.errors import AnalysisError
from scanner_service.analysis.method_analysis import METHOD_NAMES, analyse_by_method
from scanner_service.cli import app

ORIENTED = ("fixed_radius", "bivariate_quadric", "big_delaunay_balls")
RNG = np.random.default_rng(5)
BAD_CLOUDS = {
    "few": RNG.normal(size=(4, 3)),
    "fewer than a quadric needs": RNG.normal(size=(12, 3)),
    "a line": np.outer(np.arange(40.0), [1.0, 2.0, 3.0]),
    "a plane": np.column_stack([RNG.uniform(0.0, 1.0, (60, 2)), np.zeros(60)]),
    "one place": np.ones((40, 3)),
    "doubled points": np.repeat(RNG.normal(size=(30, 3)), 3, axis=0),
    "a far outlier": np.vstack([RNG.normal(size=(60, 3)), [[1e8, 0.0, 0.0]]]),
    "not a number": np.vstack([RNG.normal(size=(60, 3)), np.full((3, 3), np.nan), [[np.inf, 0.0, 0.0]]]),
    "nothing but NaN": np.full((20, 3), np.nan),
}


def only_numbers(text):
    raise AssertionError(f"{text} is no JSON")


@pytest.mark.parametrize("name", BAD_CLOUDS)
@pytest.mark.parametrize("method", METHOD_NAMES)
def test_every_point_has_a_normal_or_a_reason_or_the_cloud_is_refused(method, name):
    points = BAD_CLOUDS[name]
    try:
        found = analyse_by_method(points, method)
    except AnalysisError as refusal:
        assert len(str(refusal)) > 40
        return
    given = found.reason == 0
    assert sum(found.counts.values()) == len(points)
    assert np.isnan(found.normals[~given]).all()
    np.testing.assert_allclose(np.linalg.norm(found.normals[given], axis=1), 1.0, atol=1e-9)


FEW = [("big_delaunay_balls", []), ("general_quadric", []), ("bivariate_quadric", ["--orient"])]
ALL = [*((method, []) for method in METHOD_NAMES), *((method, ["--orient"]) for method in ORIENTED)]


@pytest.mark.parametrize("runs", [FEW, pytest.param(ALL, marks=pytest.mark.long)], ids=["few", "all"])
@pytest.mark.parametrize("name", BAD_CLOUDS)
def test_every_method_answers_with_reasons_or_refuses_in_a_sentence(name, runs, tmp_path):
    file, points = tmp_path / "cloud.xyz", BAD_CLOUDS[name]
    np.savetxt(file, points)
    for number, (method, orient) in enumerate(runs):
        out = tmp_path / f"{number}"
        arguments = ["analyse", file, "--method", method, "--units", "mm", "--out", out, *orient]
        found = CliRunner().invoke(app, [str(argument) for argument in arguments])
        if found.exit_code == 1:
            assert isinstance(found.exception, SystemExit), (method, found.exception)
            assert len(found.output) > 40, method
            assert "Traceback" not in found.output
            assert not (out / "points.ply").exists()
            continue
        assert found.exit_code == 0, (method, found.output)
        told = json.loads((out / "summary.json").read_text(), parse_constant=only_numbers)
        dropped = sum(told["losses"]["points"]["dropped"].values())
        assert sum(told["reasons"].values()) + dropped == len(points), method
