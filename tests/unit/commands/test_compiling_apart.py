"""Before a large cloud kernels are compiled in a process of their own, once; a small one needs none."""

import os
import subprocess
import sys

import numpy as np
import pytest
from numba import config

from scanner_service.analysis.comparison.shapes import SHAPES
from scanner_service.commands import compiling_apart
from scanner_service.commands.compiling_apart import LARGE, compile_apart


@pytest.fixture
def started(monkeypatch, tmp_path):
    """The commands of processes that were asked for, each of which is taken to have failed."""
    commands = []
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(compiling_apart.subprocess, "run", lambda command, **_: commands.append(command))
    return commands


def test_only_a_large_cloud_with_a_known_method_starts_a_process(started):
    compile_apart("gaussian", LARGE - 1)
    compile_apart("no such method", LARGE)
    assert not started
    compile_apart("gaussian", LARGE)
    assert started == [[sys.executable, "-P", "-m", "scanner_service.commands.compiling_apart", "gaussian"]]


def test_what_was_compiled_is_not_compiled_again(started, tmp_path):
    compile_apart(None, LARGE)
    assert started[0][-1] == "density"
    (tmp_path / "density.compiled").touch()
    compile_apart(None, LARGE)
    assert len(started) == 1


@pytest.mark.long
@pytest.mark.parametrize("method", ["density", "fixed_radius", "orthogonal_distance", "voronoi_poles"])
def test_the_process_leaves_nothing_to_compile(tmp_path, method):
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "kernels")}
    subprocess.run(
        [sys.executable, "-m", "scanner_service.commands.compiling_apart", method], env=environment, check=True
    )
    kernels = set((tmp_path / "kernels").rglob("*.nbc"))
    assert kernels
    file = tmp_path / "ball.xyz"
    np.savetxt(file, SHAPES["sphere"](1000, np.random.default_rng(1)).points_mm)
    command = [
        sys.executable,
        "-m",
        "scanner_service",
        "analyse",
        str(file),
        "--orient",
        "--out",
        str(tmp_path / "out"),
    ]
    command += [] if method == "density" else ["--method", method]
    subprocess.run(command, env=environment, check=True, capture_output=True)
    assert set((tmp_path / "kernels").rglob("*.nbc")) == kernels
