"""The nominal part put into the cells of what is known: what stands in the way, and what is free; knows no points."""

import numpy as np
import numpy.typing as npt
from scipy.ndimage import distance_transform_edt

from drivers.scanline import Float64Array
from scanner_service.rescan.passes.marching import FREE, HIDDEN, SURFACE
from scanner_service.rescan.reference import Pieces


def set_nominal(state: npt.NDArray[np.uint8], low_mm: Float64Array, cell_mm: float, pieces: Pieces) -> None:
    """Put the nominal part into the cells of `state`: its surface is solid, and hidden space outside of it is free.

    Inside or outside is told by the side on which a cell lies of the nearest cell with a piece.
    """
    at = np.floor((pieces.points_mm - low_mm) / cell_mm).astype(np.int64)
    inside = ((at >= 0) & (at < np.array(state.shape))).all(axis=1)
    if not inside.any():
        return
    at, normals = at[inside], pieces.normals[inside]
    flat = np.ravel_multi_index((at[:, 0], at[:, 1], at[:, 2]), state.shape)
    cells, which = np.unique(flat, return_inverse=True)
    facing = np.zeros((len(cells), 3))
    middle = np.zeros((len(cells), 3))
    np.add.at(facing, which, normals)
    np.add.at(middle, which, pieces.points_mm[inside])
    middle /= np.bincount(which)[:, None]
    number = np.full(state.size, -1, dtype=np.int64)
    number[cells] = np.arange(len(cells))
    there = number.reshape(state.shape) >= 0
    nearest = distance_transform_edt(~there, return_distances=False, return_indices=True)
    hidden = np.argwhere(state == HIDDEN)
    i, j, k = (nearest[axis][tuple(hidden.T)] for axis in range(3))
    owner = number.reshape(state.shape)[i, j, k]
    centre = low_mm + (hidden + 0.5) * cell_mm
    out = np.einsum("ij,ij->i", centre - middle[owner], facing[owner]) > 0
    free = hidden[out]
    state[free[:, 0], free[:, 1], free[:, 2]] = FREE
    solid = there & (state != FREE)
    state[solid] = SURFACE
