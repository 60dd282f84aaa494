"""The charts of a report: how many points have which density, and coverage after each pass; computes nothing."""

from collections.abc import Sequence
from io import BytesIO

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, PercentFormatter

from scanner_service.analysis.snapshot import MapSnapshot
from scanner_service.storage.exports.density_raster import judged
from scanner_service.storage.exports.report_content import PassRow, amount

_BAR, _SHORT, _INK, _LINE, _PAPER = "#3b6ea5", "#c2571a", "#222222", "#bbbbbb", "#ffffff"


def chart(width: float, height: float) -> tuple[Figure, Axes]:
    """An empty figure, in inches, and its axes."""
    figure = Figure(figsize=(width, height), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.add_subplot()


def draw_histogram(axes: Axes, snapshot: MapSnapshot, required_per_mm2: float) -> None:
    """How many of the judged points have which density; those below the requirement in another colour."""
    densities = snapshot.density_per_mm2[judged(snapshot)]
    _frame(axes)
    axes.set_xlabel("density (points/mm²)")
    axes.set_ylabel("judged points")
    if not len(densities):
        axes.text(0.5, 0.5, "no point is judged", transform=axes.transAxes, ha="center", color=_INK)
        return
    top = max(float(np.percentile(densities, 99.5)), 1.1 * required_per_mm2 if np.isfinite(required_per_mm2) else 0.0)
    counts, edges = np.histogram(np.minimum(densities, top), bins=60, range=(0.0, top or 1.0))
    short = edges[1:] <= required_per_mm2 if np.isfinite(required_per_mm2) else np.zeros(len(counts), dtype=bool)
    colours = [_SHORT if below else _BAR for below in short]
    axes.bar(edges[:-1], counts, np.diff(edges), align="edge", color=colours, edgecolor="white", linewidth=0.3)
    axes.set_xlim(0, top or 1.0)
    axes.yaxis.set_major_formatter(lambda value, _: amount(value))
    if np.isfinite(required_per_mm2):
        axes.axvline(required_per_mm2, color=_INK, linewidth=1.3, linestyle=(0, (5, 2)))
        axes.annotate(
            f" required {required_per_mm2:.3g} ",
            (required_per_mm2, 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(0, -4),
            textcoords="offset points",
            va="top",
            ha="left" if required_per_mm2 < 0.6 * top else "right",
            color=_INK,
            fontsize=9,
        )


def draw_coverage(axes: Axes, passes: Sequence[PassRow]) -> None:
    """Observed coverage after each pass, as bars, and the area of the rescan regions, as a line."""
    _frame(axes)
    places = np.arange(len(passes))
    shares = np.array([row.coverage for row in passes])
    axes.bar(places, np.nan_to_num(shares), 0.6, color=_BAR)
    for place, share in enumerate(shares.tolist()):
        text = "?" if np.isnan(share) else f"{100 * share:.1f} %"
        axes.text(
            place,
            0.04,
            text,
            ha="center",
            va="bottom",
            fontsize=10,
            fontweight="bold",
            color=_PAPER if share > 0.1 else _INK,
        )
    axes.set_ylim(0, 1.12)
    axes.set_xlim(-0.6, max(len(passes) - 0.4, 1.4))
    axes.set_yticks(np.linspace(0, 1, 6))
    axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    axes.set_xticks(places, [row.name for row in passes], rotation=0 if len(passes) <= 6 else 30)
    axes.set_ylabel("observed coverage", color=_BAR)
    right = axes.twinx()
    right.plot(places, [row.region_mm2 for row in passes], color=_SHORT, marker="o", markersize=5, linewidth=1.4)
    right.set_ylim(0, max([row.region_mm2 for row in passes] + [1.0]) * 1.15)
    right.set_ylabel("area to scan again (mm²)", color=_SHORT, fontsize=9)
    right.tick_params(colors="#555555", labelsize=8.5)
    right.yaxis.set_major_locator(MaxNLocator(5))
    for side in right.spines.values():
        side.set_color(_LINE)


def svg_of(figure: Figure) -> str:
    """The figure as an SVG element to stand within HTML."""
    text = BytesIO()
    figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    svg = text.getvalue().decode("utf-8")
    return svg[svg.index("<svg") :]


def _frame(axes: Axes) -> None:
    axes.grid(True, axis="y", color="#e4e4e4", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(colors="#555555", labelsize=8.5)
    axes.xaxis.label.set_fontsize(9)
    axes.yaxis.label.set_fontsize(9)
    for side in axes.spines.values():
        side.set_color(_LINE)
