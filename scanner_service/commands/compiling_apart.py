"""Kernels of an analysis compiled in a process of their own, so that the one with a large cloud stays small.

A compiler takes about 120 MB, which are not given back. Run as a module this file is that process:
`python -m scanner_service.commands.compiling_apart METHOD` with a method's name, or `density` for none.
"""

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numba import config

from scanner_service.analysis.cloud import analyse_cloud
from scanner_service.analysis.comparison.shapes import sphere
from scanner_service.analysis.method_analysis import QUADRICS, analyse_by_method
from scanner_service.analysis.normals.estimating import METHODS
from scanner_service.analysis.normals.field import NormalOptions
from scanner_service.analysis.orientation import orient_normals
from scanner_service.commands.terminal import errors

LARGE = 100_000
"""Points from which on a cloud is large; below, the compiler is most of the memory wherever it runs."""

DENSITY = "density"
_FEW = 400


def compile_apart(method: str | None, points: int) -> None:
    """Before a large cloud, and once after an installation, compile what `method` (or density) and orientation need.

    What cannot be compiled there is compiled here when it is needed, as for a small cloud.
    """
    name = DENSITY if method is None else method
    known = method is None or method in METHODS or method in QUADRICS
    compiled = Path(str(config.CACHE_DIR)) / f"{name}.compiled"  # type: ignore[attr-defined]
    if points < LARGE or not known or compiled.exists():
        return
    with errors.status("compiling kernels (only the first time) …"):
        subprocess.run(
            [sys.executable, "-P", "-m", "scanner_service.commands.compiling_apart", name],
            check=False,
            capture_output=True,
        )


def main(arguments: Sequence[str]) -> None:
    """Compile by running everything on a few points, then say so beside the kernels."""
    name = arguments[0]
    few = sphere(_FEW, np.random.default_rng(0))
    if name == DENSITY:
        for rule in ("global", "flexible"):
            analyse_cloud(few.points_mm, rule)
        analyse_cloud(few.points_mm, "fixed", radius_mm=2.0)
    else:
        analyse_by_method(few.points_mm, name)
        if name in QUADRICS or "radius_mm" in METHODS[name].reads:
            analyse_by_method(few.points_mm, name, NormalOptions(radius_mm=2.0))
        if name in METHODS and "neighbours" in METHODS[name].reads:
            analyse_by_method(few.points_mm, name, NormalOptions(neighbours=20))
    orient_normals(few.points_mm, few.normals)
    folder = Path(str(config.CACHE_DIR))  # type: ignore[attr-defined]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.compiled").touch()


if __name__ == "__main__":
    main(sys.argv[1:])
