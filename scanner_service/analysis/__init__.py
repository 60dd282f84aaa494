"""The live map and its oracle: pure numpy, scipy and numba; no port, no clock, no thread.

Compiled kernels are kept in a cache named after the sources of this package: numba looks at one file only when it
decides whether a cached kernel is still good, and would go on using a callee that has changed in another.
"""

import hashlib
import os
from pathlib import Path

from numba import config


def _cache_folder() -> str:
    """Where this version's kernels are kept: the user's cache, or what NUMBA_CACHE_DIR says."""
    sources = hashlib.sha256()
    for file in sorted(Path(__file__).parent.rglob("*.py")):
        sources.update(file.read_bytes())
    home = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return str(Path(home) / "scanner-service" / f"kernels-{sources.hexdigest()[:16]}")


if not getattr(config, "CACHE_DIR", ""):
    setattr(config, "CACHE_DIR", _cache_folder())  # noqa: B010 - numba makes this attribute when it reads its settings
