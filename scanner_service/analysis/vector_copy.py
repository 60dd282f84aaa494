"""Copying eight numbers through one vector register: numba itself vectorises loops, and none as short as this."""

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic


@intrinsic
def _widen_eight(typing_context: Any, source: Any, at: Any, row: Any, target: Any, column: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> None:
        source_type, _, _, target_type, _ = signature.args
        source_array = context.make_array(source_type)(context, builder, arguments[0])
        target_array = context.make_array(target_type)(context, builder, arguments[3])
        zero = context.get_constant(types.intp, 0)
        read_from = cgutils.get_item_pointer(
            context, builder, source_type, source_array, [arguments[1], arguments[2], zero], wraparound=False
        )
        write_to = cgutils.get_item_pointer(
            context, builder, target_type, target_array, [arguments[2], arguments[4]], wraparound=False
        )
        eight = ir.VectorType(ir.IntType(32), 8)
        wide = ir.VectorType(ir.DoubleType(), 8)
        numbers = builder.load(builder.bitcast(read_from, eight.as_pointer()), align=4)
        builder.store(builder.sitofp(numbers, wide), builder.bitcast(write_to, wide.as_pointer()), align=8)

    return types.void(source, types.intp, types.intp, target, types.intp), generate


widen_eight: Any = _widen_eight
"""widen_eight(source, at, row, target, column): target[row, column + k] = source[at, row, k] for 0 <= k < 8.

From int32 (K, R, .) to float64 (R, N), unchecked; what lies behind a row of the source that is shorter than 8 is
copied, too.
"""
