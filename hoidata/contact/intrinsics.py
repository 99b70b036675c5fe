"""Three operations of the processor that numba has no word for, as functions of compiled code.

LLVM turns each into one or a few instructions where the processor has them and into slower code of the same result
where it has not: results depend on no machine.

Plain numba was measured and given up: without ``fused`` the float64 distances in annotation's hand_type.parquet lose
the last bit they share with OpenBLAS. Eight squares in a plain loop give equal bits but take 1.4 times as long per
frame for near points and 1.5 times for the nearest one (one thread, bench.kernels' scene).
"""

from typing import Any

from llvmlite import ir
from numba import types
from numba.core.typing import signature
from numba.extending import intrinsic
from numba.np.arrayobj import make_array

LANES = 8

_BITS = ir.IntType(64)
_DOUBLES = ir.VectorType(ir.DoubleType(), LANES)
_FLOATS = ir.VectorType(ir.FloatType(), LANES)
_FIRST_LANE = ir.VectorType(ir.IntType(32), LANES)([0] * LANES)


def _fused(typingctx, a, b, c):  # pragma: no cover (compiled)
    """``a * b + c`` of three float64, rounded once: what OpenBLAS adds up a product of matrices with."""

    def generate(context, builder, call, arguments):
        return builder.fma(*arguments)

    return types.float64(types.float64, types.float64, types.float64), generate


def _lowest_bit(typingctx, word):  # pragma: no cover (compiled)
    """The place of the lowest bit set in a uint64 that is not zero."""

    def generate(context, builder, call, arguments):
        return builder.cttz(arguments[0], ir.IntType(1)(1))

    return types.uint64(types.uint64), generate


def _squares_to_eight(typingctx, blocks, block, x, y, z, squares):  # pragma: no cover (compiled)
    """Squared distances of (x, y, z) to the points of one block, into ``squares``: (8,) float64.

    blocks: (block, 3, 8) float32, contiguous. Each is ``dx * dx + dy * dy + dz * dz``, rounded after every step.
    """

    def generate(context, builder, call, arguments):
        places = make_array(call.args[0])(context, builder, arguments[0]).data
        target = make_array(call.args[5])(context, builder, arguments[5]).data
        row = builder.mul(arguments[1], _BITS(3 * LANES))
        total = None
        for axis in range(3):
            start = builder.gep(places, [builder.add(row, _BITS(axis * LANES))])
            own = builder.fpext(builder.load(builder.bitcast(start, _FLOATS.as_pointer()), align=4), _DOUBLES)
            difference = builder.fsub(own, _in_all_lanes(builder, arguments[2 + axis]))
            square = builder.fmul(difference, difference)
            total = square if total is None else builder.fadd(total, square)
        builder.store(total, builder.bitcast(target, _DOUBLES.as_pointer()), align=8)
        return context.get_dummy_value()

    number = types.float64
    return signature(types.none, blocks, types.int64, number, number, number, squares), generate


def _in_all_lanes(builder, value):
    nothing = ir.Constant(_DOUBLES, ir.Undefined)
    return builder.shuffle_vector(builder.insert_element(nothing, value, ir.IntType(32)(0)), nothing, _FIRST_LANE)


fused: Any = intrinsic(_fused)
lowest_bit: Any = intrinsic(_lowest_bit)
squares_to_eight: Any = intrinsic(_squares_to_eight)
