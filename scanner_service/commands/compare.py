"""`scanner compare`: every method of normals side by side, under noise, against known normals or a live map's."""

import csv
import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from scanner_service import __version__
from scanner_service.analysis.comparison.noise import LEVELS, NoiseLevel
from scanner_service.analysis.comparison.peers import peers
from scanner_service.analysis.comparison.running import Meter, Row, compare, our_methods
from scanner_service.analysis.comparison.shapes import CUSTOMARY, ESTIMATES, SHAPES, KnownCloud
from scanner_service.analysis.normals.estimating import METHODS
from scanner_service.commands.clouds import open_known
from scanner_service.commands.compiling_apart import compile_apart
from scanner_service.commands.measuring import measured
from scanner_service.commands.small_memory import give_memory_back
from scanner_service.commands.terminal import check_folder, console, errors, plain_errors, show_json
from scanner_service.storage.exports.comparison_png import comparison_png
from scanner_service.storage.exports.results_json import write_json
from scanner_service.storage.exports.whole_file import write_whole

FILES = ("comparison.csv", "comparison.json", "comparison.png")
NO_TRUTH = "angles are differences from the normals of {}, not errors: these are an estimate too"


def compare_command(
    files: Annotated[
        list[Path] | None,
        typer.Argument(help="Clouds with reference normals, or records; sphere, cylinder and edge without any."),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the table and the picture.")] = Path("out"),
    shape: Annotated[list[str] | None, typer.Option(help=f"{', '.join(SHAPES)}; repeat it for more.")] = None,
    method: Annotated[list[str] | None, typer.Option(help="Only this method; repeat it for more.")] = None,
    points: Annotated[int, typer.Option(min=50, max=1_000_000, help="Points of each shape.")] = 10_000,
    noise: Annotated[
        list[str] | None, typer.Option(help="Only this level, such as 0.01box or 2spacing; repeat it for more.")
    ] = None,
    with_peers: Annotated[
        bool, typer.Option("--peers", help="Also plain PCA, and Open3D if installed, each at its best setting.")
    ] = False,
    units: Annotated[str | None, typer.Option(help="Length unit of the files: mm, m, inch or auto.")] = None,
    session: Annotated[
        str | None, typer.Option(help="Which session of a record: its id or first letters; the newest by default.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of shapes and noise.")] = 1,
    as_json: Annotated[bool, typer.Option("--json", help="Print the rows as JSON.")] = False,
) -> None:
    """Add noise to clouds whose normals are known, run every method, and print and save a table and a picture.

    A session of a record has no known normals: there the live map's own are the reference, and the figures are
    differences from the live map, not errors.
    """
    give_memory_back()
    with plain_errors():
        check_folder(out)
        levels = _levels(noise)
        names = _known(method, tuple(METHODS), "method")
        rng = np.random.default_rng(seed)
        clouds = _clouds(files or [], _known(shape, tuple(SHAPES), "shape"), points, units, session, rng)
        for name in METHODS if names is None else names:
            compile_apart(name, max(len(cloud.points_mm) for cloud in clouds))
        contestants = our_methods(names)
        if with_peers:
            outside, notes = peers(min(len(cloud.points_mm) for cloud in clouds))
            contestants += outside
            for note in notes:
                errors.print(f"note: {note}", highlight=False, soft_wrap=True)
        with _bar(as_json) as bar:
            task = bar.add_task("comparing", total=1.0)
            rows = compare(
                clouds,
                contestants,
                Meter(measured),
                rng,
                levels=levels,
                tell=lambda share, what: bar.update(task, completed=share, description=what),
            )
        told = [row_answer(row) for row in rows]
        write_json(out / "comparison.json", {"version": __version__, "seed": seed, "rows": told})
        write_whole(out / "comparison.csv", _csv(told))
        write_whole(out / "comparison.png", comparison_png(rows))
        if as_json:
            show_json({"version": __version__, "seed": seed, "rows": told})
            return
        for cloud in clouds:
            own = [row for row in rows if row.cloud == cloud.name]
            console.print(_table(cloud.name, own))
            console.print(_other_table(cloud.name, own))
        for row in rows:
            if row.failure is not None:
                errors.print(f"note: {row.cloud}, {row.noise.label}: {row.failure}", highlight=False, soft_wrap=True)
        console.print(f"Written to {out}: {', '.join(FILES)}", highlight=False, soft_wrap=True)


def row_answer(row: Row) -> dict[str, Any]:
    """A row as it is saved: angles in degrees, shares from 0 to 1."""
    return {
        "cloud": row.cloud,
        "reference": row.reference,
        "points": row.points,
        "noise": row.noise.label,
        "method": row.method,
        "setting": row.setting,
        "rms_deg": math.degrees(row.score.rms_rad),
        "median_deg": math.degrees(row.score.median_rad),
        "within_5_deg": row.score.within_5_deg,
        "within_10_deg": row.score.within_10_deg,
        "missing": row.score.missing,
        "cpu_s": row.seconds,
        "memory_bytes": row.memory_bytes,
        "failure": row.failure,
    }


def _clouds(
    files: Sequence[Path],
    shapes: list[str] | None,
    points: int,
    units: str | None,
    session: str | None,
    rng: np.random.Generator,
) -> list[KnownCloud]:
    """The clouds asked for: files, shapes or both; the customary shapes when nothing is."""
    if session is not None and not files:
        raise ValueError("--session names a session of a record: give the record too")
    clouds = [SHAPES[name](points, rng) for name in (shapes or ([] if files else CUSTOMARY))]
    for file in files:
        cloud, lost = open_known(file, units, session)
        told = ", ".join(f"{count:,} {reason.replace('_', ' ')}" for reason, count in lost.items() if count)
        if told:
            errors.print(f"note: left out of {cloud.name}: {told}", highlight=False, soft_wrap=True)
        if cloud.reference in ESTIMATES:
            whose = NO_TRUTH.format(ESTIMATES[cloud.reference])
            errors.print(f"note: {cloud.name}: {whose}", highlight=False, soft_wrap=True)
        clouds.append(cloud)
    return clouds


def _known(given: list[str] | None, names: tuple[str, ...], what: str) -> list[str] | None:
    for name in given or []:
        if name not in names:
            raise ValueError(f"there is no {what} {name}; choose from {', '.join(names)}")
    return given or None


def _levels(given: list[str] | None) -> Sequence[NoiseLevel]:
    if not given:
        return LEVELS
    levels = []
    for text in given:
        for kind in ("box", "spacing"):
            if text.endswith(kind):
                try:
                    share = float(text.removesuffix(kind))
                except ValueError:
                    share = math.nan
                if 0.0 <= share <= 100.0:
                    levels.append(NoiseLevel("box" if kind == "box" else "spacing", share))
                    break
        else:
            raise ValueError(f"a noise level is a share with its kind, such as 0.01box or 2spacing, not {text}")
    return levels


def _bar(quiet: bool) -> Progress:
    return Progress(
        BarColumn(bar_width=24),
        TextColumn("{task.percentage:>3.0f}%"),
        TextColumn("{task.description}"),
        TimeElapsedColumn(),
        console=errors,
        disable=quiet,
    )


def _csv(rows: Sequence[dict[str, Any]]) -> bytes:
    text = io.StringIO()
    writer = csv.DictWriter(text, fieldnames=list(rows[0]) if rows else [])
    writer.writeheader()
    for row in rows:
        unknown = {name: "" for name, value in row.items() if isinstance(value, float) and not math.isfinite(value)}
        writer.writerow(row | unknown)
    return text.getvalue().encode()


def _table(name: str, rows: Sequence[Row]) -> Table:
    """Rms errors in degrees: methods down, noise across."""
    levels = list(dict.fromkeys(row.noise.label for row in rows))
    reference = rows[0].reference
    what = f"difference from {ESTIMATES[reference]}" if reference in ESTIMATES else "error"
    table = Table(title=f"{name}, {rows[0].points:,} points: rms {what} in degrees", title_justify="left")
    table.add_column("method", no_wrap=True)
    for level in levels:
        table.add_column(level.replace(" ", "\n"), justify="right")
    for method in dict.fromkeys(row.method for row in rows):
        own = {row.noise.label: row for row in rows if row.method == method}
        table.add_row(method, *(_number(math.degrees(own[level].score.rms_rad)) for level in levels))
    return table


def _other_table(name: str, rows: Sequence[Row]) -> Table:
    """The worst over the noise levels of everything else that is measured."""
    table = Table(title=f"{name}: the worst of all noise levels", title_justify="left")
    table.add_column("method", no_wrap=True)
    for title in ("median °", "in 5°", "in 10°", "missing", "CPU s", "MB"):
        table.add_column(title, justify="right")
    for method in dict.fromkeys(row.method for row in rows):
        own = [row for row in rows if row.method == method and row.failure is None]
        if not own:
            table.add_row(method, *("–" for _ in range(6)))
            continue
        table.add_row(
            method,
            _number(max(math.degrees(row.score.median_rad) for row in own)),
            f"{min(row.score.within_5_deg for row in own):.0%}",
            f"{min(row.score.within_10_deg for row in own):.0%}",
            str(max(row.score.missing for row in own)),
            _number(max(row.seconds for row in own)),
            _number(max(row.memory_bytes for row in own) / 1e6),
        )
    return table


def _number(value: float) -> str:
    return f"{value:.2f}" if math.isfinite(value) else "–"
