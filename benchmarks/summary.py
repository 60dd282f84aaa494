"""From the rounds of a benchmark to medians and ratios, and to the table that people read; runs nothing."""

import statistics
from typing import Any

Figures = dict[str, Any]

QUIET_CORES = 0.25
"""Others may take so much of the machine before a round counts as disturbed."""


def summarise(rounds: dict[tuple[str, int], list[Figures]]) -> dict[str, Figures]:
    """For each number of threads the headline figures, and below them the median of each case.

    `points_per_s`, `ratio_open3d` and `ratio_scipy` are those of the run with 30 readings a second; the cost of a line
    (`p50_s`, `p99_s`, `max_s`, `last_to_first_tenth`) is that of the run which evaluates everything after each line;
    `bytes_per_point` is the larger of both.
    """
    summary: dict[str, Figures] = {}
    for threads in sorted({threads for _, threads in rounds}):
        of = {name: _median(runs) for (name, count), runs in rounds.items() if count == threads}
        reader, each_line = of["reader"], of["each_line"]
        summary[str(threads)] = {
            "points_per_s": reader["points_per_s"],
            "points_per_s_each_line": each_line["points_per_s"],
            "points_per_s_flexible": of["flexible"]["points_per_s"] if "flexible" in of else None,
            "ratio_open3d": _ratio(reader, of.get("open3d")),
            "ratio_scipy": _ratio(reader, of.get("scipy")),
            "p50_s": each_line["p50_s"],
            "p99_s": each_line["p99_s"],
            "max_s": each_line["max_s"],
            "last_to_first_tenth": each_line["last_to_first_tenth"],
            "bytes_per_point": max(reader["bytes_per_point"], each_line["bytes_per_point"]),
            "checked_points": sum(_checked(runs) for (_, count), runs in rounds.items() if count == threads),
            "disagreements": sum(_wrong(runs) for (_, count), runs in rounds.items() if count == threads),
            "cases": of,
        }
        for factor in (2, 4):
            if f"reader_{factor}r" in of:
                wide = of[f"reader_{factor}r"]
                summary[str(threads)][f"points_per_s_{factor}r"] = wide["points_per_s"]
                summary[str(threads)][f"ratio_open3d_{factor}r"] = _ratio(wide, of.get(f"open3d_{factor}r"))
    return summary


def _median(runs: list[Figures]) -> Figures:
    """The median of every number over the quiet rounds; what is no number is that of the first round.

    A round is quiet when others took less than QUIET_CORES; where none was, all count, and `quiet_rounds` is 0.
    """
    quiet = [run for run in runs if run["cores_taken_by_others"] < QUIET_CORES]
    middle = dict(runs[0])
    for name, value in runs[0].items():
        if isinstance(value, float):
            middle[name] = statistics.median(run[name] for run in quiet or runs)
    middle["quiet_rounds"] = len(quiet)
    middle["points_per_s_of_rounds"] = [run["points_per_s"] for run in runs]
    middle["cores_taken_by_others_of_rounds"] = [run["cores_taken_by_others"] for run in runs]
    return middle


def _ratio(ours: Figures, peer: Figures | None) -> float | None:
    return None if peer is None else ours["points_per_s"] / peer["points_per_s"]


def _checked(runs: list[Figures]) -> int:
    return sum(run.get("checked_points", 0) for run in runs)


def _wrong(runs: list[Figures]) -> int:
    """Answers that differ from the oracle's, and rows of which the reader was not told."""
    return sum(sum(run.get("disagreements", {}).values()) + (run.get("rows_the_reader_missed") or 0) for run in runs)


def print_summary(result: Figures) -> None:
    """The figures as a table, the machine below it."""
    columns = list(result["threads"])
    print(f"\n{'':<44}" + "".join(f"{'1 thread' if count == '1' else count + ' threads':>14}" for count in columns))
    for title, name, scale, digits in _ROWS:
        values = [result["threads"][count].get(name) for count in columns]
        if any(value is not None for value in values):
            print(f"{title:<44}" + "".join(_cell(value, scale, digits) for value in values))
    for peer in ("open3d", "scipy"):
        found = [result["threads"][count]["cases"].get(peer) for count in columns]
        if all(found):
            cells = "".join(_cell(figures["points_per_s"], 1e-6, 3) for figures in found)
            print(f"{f'{peer} (batch), million points/s':<44}{cells}")
    machine = result["machine"]
    start = result["start_up"]
    if start is not None:
        print(f"start-up: cold {start['cold']['ready_s']:.1f} s, warm {start['warm']['ready_s']:.2f} s")
    cases = [figures for count in columns for figures in result["threads"][count]["cases"].values()]
    disturbed = sum(figures["quiet_rounds"] == 0 for figures in cases)
    if disturbed:
        print(f"{disturbed} of {len(cases)} figures come from rounds in which others took {QUIET_CORES} cores or more")
    load = machine["load_average"]
    print(f"{machine['processor']}, {machine['cores']} cores; load average {load[0]:.2f} before the run")


_ROWS = (
    ("30 readings a second, million points/s", "points_per_s", 1e-6, 3),
    ("  ratio to Open3D (normals only)", "ratio_open3d", 1.0, 2),
    ("  ratio to scipy and numpy", "ratio_scipy", 1.0, 2),
    ("all written after each line, million points/s", "points_per_s_each_line", 1e-6, 3),
    ("  a line: median, µs", "p50_s", 1e6, 0),
    ("  a line: 99 of 100 within, µs", "p99_s", 1e6, 0),
    ("  a line: longest, µs", "max_s", 1e6, 0),
    ("  last tenth to first tenth", "last_to_first_tenth", 1.0, 3),
    ("flexible rule, 30 readings, million points/s", "points_per_s_flexible", 1e-6, 3),
    ("at 2r, million points/s", "points_per_s_2r", 1e-6, 3),
    ("  ratio to Open3D", "ratio_open3d_2r", 1.0, 2),
    ("at 4r, million points/s", "points_per_s_4r", 1e-6, 3),
    ("  ratio to Open3D", "ratio_open3d_4r", 1.0, 2),
    ("memory, bytes a point", "bytes_per_point", 1.0, 0),
    ("answers compared with the oracle", "checked_points", 1.0, 0),
    ("  of which differ", "disagreements", 1.0, 0),
)


def _cell(value: float | None, scale: float, digits: int) -> str:
    return f"{'–':>14}" if value is None else f"{value * scale:>14,.{digits}f}"
