"""Which cells lie around a cell, as bit masks over blocks of 4 x 4 x 4 cells; knows no points.

A block's cells are the bits of one 64-bit word: the cell at (x, y, z) within the block is bit 16 x + 4 y + z. The 27
blocks around a block are numbered 9 (dx + 1) + 3 (dy + 1) + dz + 1, so 13 is the block itself.
"""

from typing import Any

import numpy as np
import numpy.typing as npt
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

RINGS = 4
"""A look-up reaches this many cells far, which are the blocks next to one's own and no more."""

BLOCK_CELLS = 64


def _tables() -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[np.uint64]]:
    """For each number of rings and place: how many blocks the rings touch, which, and their cells within the rings."""
    count = np.zeros((RINGS + 1, BLOCK_CELLS), dtype=np.int64)
    near = np.zeros((RINGS + 1, BLOCK_CELLS, 27), dtype=np.int64)
    mask = np.zeros((RINGS + 1, BLOCK_CELLS, 27), dtype=np.uint64)
    along = np.arange(-4, 8)  # cell coordinates of the blocks before, here and after, along one axis
    for rings in range(1, RINGS + 1):
        for place in range(BLOCK_CELLS):
            at = (place >> 4, (place >> 2) & 3, place & 3)
            for block in range(27):
                offset = (block // 9 - 1, block // 3 % 3 - 1, block % 3 - 1)
                chosen = 0
                within = [along[np.abs(along - at[axis]) <= rings] for axis in range(3)]
                x, y, z = ([int(c) & 3 for c in within[axis] if c >> 2 == offset[axis]] for axis in range(3))
                for i in x:
                    for j in y:
                        for k in z:
                            chosen |= 1 << (16 * i + 4 * j + k)
                if chosen:
                    slot = count[rings, place]
                    near[rings, place, slot], mask[rings, place, slot] = block, chosen
                    count[rings, place] += 1
    return count, near, mask


AROUND_COUNT, AROUND_NEAR, AROUND_MASK = _tables()
"""(rings, place), (rings, place, .) and (rings, place, .): the blocks that the rings around a place touch."""


@intrinsic
def _lowest_bit(typing_context: Any, word: Any) -> Any:

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.cttz(arguments[0], ir.Constant(ir.IntType(1), 1))

    return types.int64(types.uint64), generate


lowest_bit: Any = _lowest_bit
"""lowest_bit(word): the number of the lowest bit that is set in a 64-bit word; for 0 the answer means nothing."""
