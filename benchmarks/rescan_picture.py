"""A picture of a plan: what is known of a part, what is wanted, and the pass that is recommended first."""

import sys
from pathlib import Path

import numpy as np

from benchmarks.rescan_loop import Judge, first_pass
from benchmarks.rescan_scan import DENSITY_PER_MM2, Scan, Subject, reach_of
from drivers.scanline import Float64Array
from scanner_service.rescan.passes.known_surface import know_surface
from scanner_service.rescan.passes.needs import Evidence, Wanted, failing_points, find_needs
from scanner_service.rescan.passes.optics import ScannerOptics
from scanner_service.rescan.passes.planner import Wishes, plan_passes
from simulators.optics import demo_scanner
from simulators.parts import PARTS


class _Uncounted:
    """No truth is wanted for a picture."""

    share = 0.0

    def add(self, lines: object) -> None:
        """Nothing is counted."""


def draw(path: Path) -> None:
    """The demo part after one coarse pass from above, seen from the side of the first recommended pass."""
    import matplotlib.pyplot as plt

    scanner = demo_scanner()
    reach = reach_of(scanner)
    subject = Subject(
        "demo", PARTS["demo"]().surface, np.array([-24.0, -1.0, -7.0]), np.array([24.0, 61.0, 20.0]),
        _Uncounted,  # type: ignore[arg-type]
    )  # fmt: skip
    scan = Scan(subject, reach, scanner, with_map=True)
    first_pass(scan, subject, scanner)
    snapshot, report = Judge(scan, scanner).judged()
    optics = ScannerOptics(scanner.geometry(), scanner.field_of_view_mm, scanner.points_per_line)
    surface = know_surface(snapshot, *failing_points(report))
    needs = find_needs(snapshot, report, surface, Wanted(DENSITY_PER_MM2))
    first = plan_passes(snapshot, report, reach, optics, Wishes(DENSITY_PER_MM2, 1)).passes[0]
    figure = plt.figure(figsize=(9.0, 6.0), layout="constrained")
    axes = figure.add_subplot(projection="3d")
    good = surface.failing_share < 0.5

    def dots(places: Float64Array, colour: str, name: str, size: float) -> None:
        axes.scatter(*places.T, s=size, c=colour, label=name, linewidths=0)

    dots(surface.points_mm[good], "0.75", "meets the requirement", 1.0)
    measured, floor = needs.evidence == Evidence.MEASURED, needs.evidence == Evidence.FLOOR
    dots(needs.places_mm[measured], "tab:orange", "measured, and not good enough", 3.0)
    dots(needs.places_mm[floor], "tab:purple", "goes on in the shadow", 3.0)
    dots(needs.places_mm[needs.evidence == Evidence.FRONTIER], "tab:cyan", "hidden space begins", 1.0)
    dots(first.places_mm, "tab:green", "served by the pass", 5.0)
    ends = [first.motion.part_from_sensor(at) for at in (first.start_mm, first.end_mm)]
    track = np.array([pose.translation_mm + 40.0 * pose.rotation[:, 2] for pose in ends])
    axes.quiver(*track[0], *(track[1] - track[0]), color="tab:red", linewidth=2, arrow_length_ratio=0.12)
    for pose, at in zip(ends, track, strict=True):
        axes.plot(*np.stack([at, pose.translation_mm]).T, color="tab:red", linewidth=0.8)
    axes.set_box_aspect((48, 62, 50))
    axes.view_init(elev=28, azim=-60)
    axes.set_xlabel("x, mm")
    axes.set_ylabel("y, mm")
    axes.set_title(
        f"{first.line_count} lines {first.line_spacing_mm:.2f} mm apart, {first.duration_s:.1f} s: "
        f"{first.gain_mm2:.0f} mm² promised"
    )
    axes.legend(loc="upper left", fontsize=8, markerscale=4)
    figure.savefig(path, dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    draw(Path(sys.argv[1]))
