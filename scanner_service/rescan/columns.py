"""Arrays of one row a point that grow with a map; knows no meaning of any of them."""

from typing import Any

import numpy as np
import numpy.typing as npt

_LEAST_ROWS = 4096


class Columns:
    """Growing arrays by name, each with the type and the width of what was put into it first; 0 where nothing was."""

    def __init__(self) -> None:
        self._arrays: dict[str, npt.NDArray[Any]] = {}
        self._rows = 0

    def make_room(self, rows: int) -> None:
        """Let every array have so many rows at least, and for a growing map a quarter more."""
        if rows <= self._rows:
            return
        self._rows = max(rows + rows // 4, _LEAST_ROWS)
        for name, old in self._arrays.items():
            self._arrays[name] = np.concatenate([old, np.zeros((self._rows - len(old), *old.shape[1:]), old.dtype)])

    def put(self, rows: npt.NDArray[np.int64] | slice, **values: npt.NDArray[Any]) -> None:
        """Write values, one row each."""
        for name, new in values.items():
            if name not in self._arrays:
                self._arrays[name] = np.zeros((self._rows, *new.shape[1:]), new.dtype)
            self._arrays[name][rows] = new

    def view(self, name: str, rows: int) -> npt.NDArray[Any]:
        """The first rows of an array, as they are from now on."""
        return self._arrays[name][:rows]

    def views(self, group: str, rows: slice) -> dict[str, npt.NDArray[Any]]:
        """All arrays whose names begin with the group's and a dot, by the rest of their names."""
        return {name.removeprefix(f"{group}."): old[rows] for name, old in self._arrays.items() if _is_of(name, group)}

    def copies(self, group: str, rows: npt.NDArray[np.int64] | slice) -> dict[str, npt.NDArray[Any]]:
        """The same, as they are now."""
        chosen = {name: old[rows] for name, old in self._arrays.items() if _is_of(name, group)}
        return {
            name.removeprefix(f"{group}."): values.copy() if isinstance(rows, slice) else values
            for name, values in chosen.items()
        }


def _is_of(name: str, group: str) -> bool:
    return name.startswith(f"{group}.")
