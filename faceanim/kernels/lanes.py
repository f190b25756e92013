"""Eight numbers at a time: rows of eight float32 mixed in one vector register and dealt out to the rows of a table.

The compiler would take the numbers one by one. With `NUMBA_DISABLE_JIT` the same name is plain Python.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import config
from numba.core import types
from numba.extending import intrinsic

LANES = 8


def _pointer(context, builder, array_type, array, index_type, index):
    data = context.make_array(array_type)(context, builder, array).data
    return builder.gep(data, [context.cast(builder, index, index_type, types.intp)])


def _mix8(typingctx, target, i, stride, source, a, b, c, wa, wb, wc):
    def emit(context, builder, signature, args):
        kind = signature.args
        row = ir.VectorType(ir.FloatType(), LANES)
        total = ir.Constant(row, None)
        for corner, weight in ((4, 7), (5, 8), (6, 9)):
            place = _pointer(context, builder, kind[3], args[3], kind[corner], args[corner])
            values = builder.load(builder.bitcast(place, row.as_pointer()), align=4)
            number = context.cast(builder, args[weight], kind[weight], types.float32)
            lane = builder.insert_element(ir.Constant(row, ir.Undefined), number, ir.Constant(ir.IntType(32), 0))
            same = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
            factor = builder.shuffle_vector(lane, ir.Constant(row, ir.Undefined), same)
            total = builder.fadd(total, builder.fmul(values, factor, flags=["contract"]), flags=["contract"])
        place = _pointer(context, builder, kind[0], args[0], kind[1], args[1])
        step = context.cast(builder, args[2], kind[2], types.intp)
        for k in range(LANES):
            value = builder.extract_element(total, ir.Constant(ir.IntType(32), k))
            builder.store(value, builder.gep(place, [builder.mul(step, ir.Constant(step.type, k))]))
        return context.get_dummy_value()

    return types.none(target, i, stride, source, a, b, c, wa, wb, wc), emit


def _plain_mix8(target, i, stride, source, a, b, c, wa, wb, wc):
    flat = source.reshape(-1)
    total = wa * flat[a : a + LANES] + wb * flat[b : b + LANES] + wc * flat[c : c + LANES]
    target.reshape(-1)[i : i + LANES * stride : stride] = total


mix8: Any = _plain_mix8 if getattr(config, "DISABLE_JIT", 0) else intrinsic(_mix8)
"""mix8(target, i, stride, source, a, b, c, wa, wb, wc): put the sum of three rows of eight float32 of `source`, from
a, b and c on, times their weights, into elements i, i + stride, ... of `target` (float32)."""
