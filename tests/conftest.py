"""What holds for every test: laws are judged by what they say, and a run of all of them wastes no core."""

import contextlib
import importlib
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import settings

settings.register_profile("unhurried", deadline=None)
settings.load_profile("unhurried")

TESTS = Path(__file__).parent
COMPILE = "from scanner_service.sessions.readiness import warm_up; warm_up()"
WITHOUT_KERNELS = (
    "unit/drivers", "unit/simulators", "unit/storage", "unit/web", "end_to_end/test_rigs_on_pty.py",
    "end_to_end/test_stage_clients.py", "end_to_end/test_driver_on_pty.py", "end_to_end/test_scanners_on_pty.py",
    "end_to_end/test_stages_on_pty.py", "end_to_end/test_conformance.py", "end_to_end/test_pty_port.py",
    "end_to_end/test_published_clients.py", "end_to_end/test_emulators.py", "end_to_end/test_replug_cycles.py",
    "end_to_end/test_simulated_kinds.py", "end_to_end/test_simulated_process.py",
)  # fmt: skip
"""What needs no compiled kernel of the map or the planner, or hardly any: it runs while these are compiled."""
LONGEST = (
    "unit/sessions/test_pass_desk.py", "end_to_end/test_live_scan.py", "end_to_end/test_viewer_on_service.py",
    "unit/analysis/graphs/test_graphs.py", "unit/analysis/test_normals.py", "unit/rescan/test_gaps.py",
    "end_to_end/test_sessions_by_hand.py", "end_to_end/test_rescan_loop.py", "unit/rescan/passes/test_serving.py",
    "unit/sessions/test_exporting.py", "unit/commands/test_bad_clouds.py", "faults/test_faults.py",
)  # fmt: skip
"""The files that take longest: begun first of the others, so that none is left to one worker alone at the end."""

_compiling: "list[subprocess.Popen[bytes]]" = []


def _is_controller(config: pytest.Config) -> bool:
    """True in the process that hands tests out to several workers."""
    return bool(getattr(config.option, "numprocesses", None)) and not hasattr(config, "workerinput")


def _import_others_first(worker: int, workers: int, wanted: list[str]) -> None:
    """Workers begin with different files, so that pytest rewrites the assertions of each file once and not in each."""
    paths = [Path(each.partition("::")[0]).resolve() for each in wanted]
    files = sorted({file for path in paths for file in ([path] if path.is_file() else path.rglob("test_*.py"))})
    begin = len(files) * worker // workers
    for file in files[begin:] + files[:begin]:
        with contextlib.suppress(Exception, pytest.skip.Exception):  # whatever it is, collecting meets and tells it
            importlib.import_module(".".join(file.relative_to(TESTS.parent).with_suffix("").parts))


def pytest_sessionstart(session: pytest.Session) -> None:
    """Kernels are compiled once, beside the first tests, and not by each worker and each service for itself."""
    if hasattr(session.config, "workerinput"):
        mine = session.config.workerinput
        _import_others_first(int(mine["workerid"][2:]), mine["workercount"], session.config.args)
    if _is_controller(session.config) and not session.config.option.collectonly:
        _compiling.append(subprocess.Popen([sys.executable, "-c", COMPILE], cwd=TESTS.parent))


def pytest_sessionfinish() -> None:
    """A run that ends early leaves no compiler behind."""
    for process in _compiling:
        process.kill()
        process.wait()
    _compiling.clear()


def _turn(item: pytest.Item) -> int:
    """When a file has its turn: lower is earlier; its tests keep their order."""
    name = item.path.relative_to(TESTS).as_posix()
    if name.startswith(WITHOUT_KERNELS):
        return -1
    return LONGEST.index(name) if name in LONGEST else len(LONGEST)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """What needs no kernel comes first, then the longest files; with `--no-loadscope-reorder` workers keep to that."""
    items.sort(key=_turn)
