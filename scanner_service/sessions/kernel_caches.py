"""Caches of compiled kernels beside this program's own: those of other sources that nobody used lately are removed.

Each state of the sources has a folder of its own (see `analysis`), which would stay for ever otherwise. A program marks
its own as used by the folder's time, at its start and now and then; knows no kernel.
"""

import logging
import os
import re
import shutil
import time
from collections.abc import Callable
from pathlib import Path

from numba import config

_LOG = logging.getLogger(__name__)
UNUSED_S = 30 * 24 * 3600.0
"""A cache that was not used for so long is removed."""

_CACHE = re.compile(r"kernels-[0-9a-f]{16}")
_SUFFIX = ".going-"
_GOING = re.compile(r"kernels-[0-9a-f]{16}\.going-\d+")


def _ours() -> Path:
    return Path(str(getattr(config, "CACHE_DIR")))  # noqa: B009 - numba makes this attribute when it reads its settings


def mark_used(own: Path | None = None) -> None:
    """Say that a cache is in use, this program's own by default; one that is not there is none."""
    own = own or _ours()
    try:
        os.utime(own)
    except FileNotFoundError:  # nothing was compiled yet
        return
    except OSError as error:
        _LOG.warning("the cache of kernels %s cannot be marked as used: %s", own, error)


def remove_unused(own: Path | None = None, now_s: Callable[[], float] = time.time) -> list[str]:
    """Remove the caches beside `own`, this program's by default, that were last used more than `UNUSED_S` ago.

    Returns the names of those that are gone; what cannot be removed is said in the log. Several programs may do so at
    once: a cache is given another name first, which one of them alone can do.
    """
    own = own or _ours()
    if not _CACHE.fullmatch(own.name):
        return []  # a folder of the user's: what lies beside it is none of our business
    try:
        beside = [each for each in own.parent.iterdir() if each.name != own.name]
    except OSError:
        return []
    gone = [each.name for each in beside if _is_unused(each, now_s()) and _remove(each)]
    return [name.partition(_SUFFIX)[0] for name in gone]  # of what another began to remove as well


def _is_unused(folder: Path, now_s: float) -> bool:
    if not (_CACHE.fullmatch(folder.name) or _GOING.fullmatch(folder.name)):
        return False
    try:
        return not folder.is_symlink() and folder.is_dir() and now_s - folder.stat().st_mtime > UNUSED_S
    except OSError:  # another program was faster
        return False


def _remove(folder: Path) -> bool:
    going = folder if _GOING.fullmatch(folder.name) else folder.with_name(f"{folder.name}{_SUFFIX}{os.getpid()}")
    try:
        folder.rename(going)
        shutil.rmtree(going)
    except FileNotFoundError:  # another program was faster
        return False
    except OSError as error:
        _LOG.warning("the unused cache of kernels %s cannot be removed: %s", going, error)
        return False
    return True
