"""The picture of a comparison: one panel a cloud, error against noise, one line a method; computes nothing."""

import math
from collections.abc import Sequence
from io import BytesIO

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from scanner_service.analysis.comparison.running import Row
from scanner_service.analysis.comparison.shapes import ESTIMATES

# Colours of Okabe and Ito, which most people can tell apart; a mark of its own for each method besides.
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7f7f7f", "#000000")
_MARKS = ("o", "s", "^", "D", "v", "P", "x", "+")
_COLUMNS = 3


def comparison_png(rows: Sequence[Row], *, dpi: int = 110) -> bytes:
    """Draw rms errors in degrees over the noise levels, as they follow in the rows, and the time a method takes."""
    clouds = list(dict.fromkeys(row.cloud for row in rows))
    methods = list(dict.fromkeys(row.method for row in rows))
    panels = len(clouds) + 1
    columns = 2 if panels in (2, 4) else _COLUMNS
    deep = math.ceil(panels / columns)
    figure = Figure(figsize=(5.2 * columns, 4.1 * deep + 0.9), dpi=dpi, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    axes: list[Axes] = [figure.add_subplot(deep, columns, number + 1) for number in range(panels)]
    for panel, cloud in zip(axes, clouds, strict=False):
        _errors(panel, cloud, [row for row in rows if row.cloud == cloud], methods)
    _times(axes[panels - 1], rows, methods)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(4, len(methods)), frameon=False, fontsize=10)
    only_estimates = all(row.reference in ESTIMATES for row in rows)
    what = "Difference of normals from another estimate's" if only_estimates else "Error of normals"
    figure.suptitle(f"{what} under noise, and what it costs", fontsize=14, fontweight="bold")
    picture = BytesIO()
    figure.savefig(picture, format="png", metadata={"Title": "Comparison of normals", "Software": "scanner-service"})
    return picture.getvalue()


def _errors(panel: Axes, cloud: str, rows: Sequence[Row], methods: Sequence[str]) -> None:
    levels = list(dict.fromkeys(row.noise.label for row in rows))
    for number, method in enumerate(methods):
        found = {row.noise.label: math.degrees(row.score.rms_rad) for row in rows if row.method == method}
        panel.plot(
            range(len(levels)),
            [found.get(level, math.nan) for level in levels],
            marker=_MARKS[number % len(_MARKS)],
            color=_COLOURS[number % len(_COLOURS)],
            linewidth=1.6,
            linestyle="--" if method.endswith("_best") else "-",
            label=method.replace("_", " "),
        )
    panel.set_title(f"{cloud}, {rows[0].points:,} points".replace(",", "\u202f"), fontsize=11)
    panel.set_xticks(range(len(levels)), levels, rotation=30, ha="right", fontsize=9)
    reference = rows[0].reference
    what = f"difference from {ESTIMATES[reference]}" if reference in ESTIMATES else "error"
    panel.set_ylabel(f"rms {what}, degrees (log scale)")
    panel.set_yscale("log")
    panel.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    panel.yaxis.set_minor_formatter(lambda value, _: f"{value:g}" if f"{value:g}"[0] in "235" else "")
    panel.grid(True, which="both", color="#e4e4e4", linewidth=0.6)
    panel.set_axisbelow(True)


def _times(panel: Axes, rows: Sequence[Row], methods: Sequence[str]) -> None:
    for number, method in enumerate(methods):
        costs = [1e6 * row.seconds / row.points for row in rows if row.method == method and math.isfinite(row.seconds)]
        panel.scatter(
            costs,
            [number] * len(costs),
            color=_COLOURS[number % len(_COLOURS)],
            marker=_MARKS[number % len(_MARKS)],
            alpha=0.8,
        )
    panel.set_yticks(range(len(methods)), [method.replace("_", " ") for method in methods], fontsize=9)
    panel.invert_yaxis()
    panel.set_xscale("log")
    panel.set_xlabel("processor time, µs a point (log scale)")
    panel.set_title("time, all clouds and levels", fontsize=11)
    panel.grid(True, axis="x", which="both", color="#e4e4e4", linewidth=0.6)
    panel.set_axisbelow(True)
