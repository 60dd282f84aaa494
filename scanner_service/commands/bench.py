"""`scanner bench`: the benchmarks that stand beside the project; knows where they are, measures nothing itself."""

import subprocess
import sys
from pathlib import Path
from typing import Annotated

import typer

import scanner_service
from scanner_service.commands.terminal import fail

bench_app = typer.Typer(
    rich_markup_mode=None, help="Measure how fast the service is, beside the tools that people use today."
)


@bench_app.command("live-map")
def live_map_command(
    json_file: Annotated[Path | None, typer.Option("--json", help="File for the figures.")] = None,
    points: Annotated[int, typer.Option(min=1, help="Points of a run; 20000000 for a release.")] = 2_000_000,
    repeats: Annotated[int, typer.Option(min=1, help="Rounds; medians are reported.")] = 3,
    threads: Annotated[list[int] | None, typer.Option(min=1, help="Number of threads; repeat it for more.")] = None,
    checks: Annotated[int, typer.Option(min=0, help="Random lines at which the oracle is asked.")] = 20,
    without_peers: Annotated[bool, typer.Option("--without-peers", help="Leave Open3D and scipy out.")] = False,
    one_radius: Annotated[bool, typer.Option("--one-radius", help="Leave 2r and 4r out.")] = False,
    warm_only: Annotated[bool, typer.Option("--warm-only", help="Leave the cold start out.")] = False,
) -> None:
    """Measure the live map and its peers by turns, print ratios, save JSON; takes some minutes."""
    command = ["benchmarks.live_map", "--points", str(points), "--repeats", str(repeats), "--checks", str(checks)]
    if json_file is not None:
        command += ["--json", str(json_file.absolute())]
    if threads:
        command += ["--threads", *map(str, threads)]
    for flag, is_wanted in (
        ("--without-peers", without_peers),
        ("--one-radius", one_radius),
        ("--warm-only", warm_only),
    ):
        if is_wanted:
            command.append(flag)
    _run(command)


@bench_app.command("neighbours")
def neighbours_command(
    json_file: Annotated[Path | None, typer.Option("--json", help="File for the figures.")] = None,
    out: Annotated[Path, typer.Option(help="Folder for the plot, neighbours.png.")] = Path("out"),
    points: Annotated[int, typer.Option(min=2000, help="Points of the cloud.")] = 200_000,
    repeats: Annotated[int, typer.Option(min=1, help="Rounds; the best counts.")] = 3,
) -> None:
    """Measure how the cost of range queries grows with the radius: table, plot, JSON."""
    command = ["benchmarks.neighbours", "--points", str(points), "--repeats", str(repeats)]
    command += ["--out", str(out.absolute())]
    if json_file is not None:
        command += ["--json", str(json_file.absolute())]
    _run(command)


@bench_app.command("orientation")
def orientation_command(
    json_file: Annotated[Path | None, typer.Option("--json", help="File for the figures.")] = None,
    points: Annotated[int, typer.Option(min=2000, help="Points of the cloud.")] = 1_000_000,
    threads: Annotated[int, typer.Option(min=1, help="Number of threads.")] = 2,
    without_peers: Annotated[bool, typer.Option("--without-peers", help="Leave Open3D and CloudCompare out.")] = False,
) -> None:
    """Measure normals and their orientation beside Open3D and CloudCompare, print ratios, save JSON."""
    command = ["benchmarks.orientation", "--points", str(points), "--threads", str(threads)]
    if json_file is not None:
        command += ["--json", str(json_file.absolute())]
    _run([*command, "--without-peers"] if without_peers else command)


@bench_app.command("latency")
def latency_command(
    json_file: Annotated[Path | None, typer.Option("--json", help="File for the figures.")] = None,
    rates: Annotated[list[float] | None, typer.Option("--rate", help="Lines a second; repeat it for more.")] = None,
    seconds: Annotated[float, typer.Option(min=0.1, help="Length of the run at each rate.")] = 4.0,
) -> None:
    """Measure from a line's last byte on the serial port to the update that a client receives; save JSON."""
    command = ["benchmarks.latency", "--seconds", str(seconds)]
    if rates:
        command += ["--rates", *map(str, rates)]
    if json_file is not None:
        command += ["--json", str(json_file.absolute())]
    _run(command)


def _run(command: list[str]) -> None:
    """Run a module of the benchmarks from the checkout; its status is ours."""
    root = project_root()
    if root is None:
        fail(
            "The benchmarks are not part of the installed package: clone the project and run "
            "`scanner bench` from there, installed with `pip install --editable '.[bench]'`."
        )
    if subprocess.run([sys.executable, "-m", *command], cwd=root, check=False).returncode != 0:
        raise typer.Exit(1)


@bench_app.command("rescan")
def rescan_command(
    json_file: Annotated[Path | None, typer.Option("--json", help="File for the figures.")] = None,
    meshes: Annotated[Path | None, typer.Option(help="Folder with fandisk.obj, gears.stl, featuretype.STL.")] = None,
    part: Annotated[str | None, typer.Option(help="One part only.")] = None,
    spacing: Annotated[float, typer.Option(min=0.05, help="Distance of the truth's samples, mm.")] = 0.15,
) -> None:
    """Compare the area of rescan regions with the truth, by reason: recall and precision; takes some minutes."""
    root = _checkout("rescan")
    command = [sys.executable, "-m", "benchmarks.rescan", "--spacing", str(spacing)]
    for name, value in (("--json", json_file), ("--meshes", meshes)):
        if value is not None:
            command += [name, str(value.absolute())]
    if part is not None:
        command += ["--part", part]
    if subprocess.run(command, cwd=root, check=False).returncode != 0:
        raise typer.Exit(1)


def _checkout(name: str) -> Path:
    """The checkout that the benchmark lies in; ends the command when there is none."""
    root = project_root()
    if root is None:
        fail(
            "The benchmarks are not part of the installed package: clone the project and run "
            f"`scanner bench {name}` from there, installed with `pip install --editable '.[bench]'`."
        )
    return root


def project_root() -> Path | None:
    """The checkout that this package runs from; None when it was installed without one."""
    root = Path(scanner_service.__file__).resolve().parent.parent
    is_checkout = (root / "benchmarks" / "live_map.py").is_file() and (root / "tests" / "oracle.py").is_file()
    return root if is_checkout else None
