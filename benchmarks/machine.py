"""What the figures were measured on: processor, versions, and how busy others kept it meanwhile."""

import importlib.metadata
import os
import platform
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

_PACKAGES = ("numpy", "numba", "llvmlite", "scipy", "open3d")


def describe_machine() -> dict[str, object]:
    """Processor, memory and versions; packages that are not installed are None."""
    return {
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)),
        "memory_bytes": os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"),
        "system": platform.platform(),
        "python": platform.python_version(),
        "packages": {name: _version(name) for name in _PACKAGES},
        "load_average": os.getloadavg(),
    }


def _processor() -> str:
    lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    facts = dict(line.split(":", 1) for line in lines if ":" in line)
    told = {key.strip(): value.strip() for key, value in facts.items()}
    return f"{told.get('model name', platform.machine())} (family {told.get('cpu family')}, model {told.get('model')})"


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def is_installed(package: str) -> bool:
    """True when the package can be measured here."""
    return _version(package) is not None


def resident_bytes() -> int:
    """Memory of this process that is in use now."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def fetch_memory(n_bytes: int) -> None:
    """Touch as much memory and give it back, so that the machine has it at hand.

    A virtual machine gets its memory from its host when it is first touched, which can cost a hundred times what
    the kernel needs; a run that happens to touch memory first would be charged for it, and the next would not.
    """
    pages = np.empty(n_bytes, dtype=np.uint8)
    pages[:: os.sysconf("SC_PAGE_SIZE")] = 1


def use_cores(count: int) -> None:
    """Bind this process, and what it starts, to `count` cores.

    Raises
    ------
    ValueError : there are not so many.
    """
    allowed = sorted(os.sched_getaffinity(0))
    if count > len(allowed):
        raise ValueError(f"{count} threads are to be measured and there are {len(allowed)} cores: ask for fewer")
    os.sched_setaffinity(0, allowed[-count:])


@dataclass(frozen=True, slots=True)
class Neighbours:
    """A watch on what everybody else does on the machine, from the moment it is made."""

    begun_s: float
    machine_busy_s: float
    own_busy_s: float

    @classmethod
    def watch(cls) -> "Neighbours":
        """Begin to watch."""
        return cls(time.perf_counter(), _machine_busy_s(), time.process_time())

    def cores_taken(self) -> float:
        """How many cores others, and the hypervisor, have used on average since; near 0 on a quiet machine."""
        elapsed = time.perf_counter() - self.begun_s
        others = (_machine_busy_s() - self.machine_busy_s) - (time.process_time() - self.own_busy_s)
        return max(0.0, others / max(elapsed, 1e-9))


def wait_for_quiet(patience_s: float) -> None:
    """Return as soon as others leave the machine alone for a moment, or when patience is at its end."""
    until = time.monotonic() + patience_s
    while time.monotonic() < until:
        others = Neighbours.watch()
        time.sleep(0.3)
        if others.cores_taken() < 0.1:
            return


def _machine_busy_s() -> float:
    """Processor time of all processes, interrupts and stolen time, since the machine was started."""
    user, nice, system, _idle, _wait, irq, soft_irq, steal = (
        int(ticks) for ticks in Path("/proc/stat").read_text(encoding="ascii").split(maxsplit=9)[1:9]
    )
    return (user + nice + system + irq + soft_irq + steal) / os.sysconf("SC_CLK_TCK")
