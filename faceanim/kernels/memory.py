"""Loads and stores that tell the compiler which arrays never overlap, so that it may use vector instructions.

A loop that reads twenty arrays and writes twelve is vectorised only when the compiler knows that no store can change
a value still to be read. It cannot prove that, and the checks at run time would be too many. `load` and the stores
`STORE[k]` carry that promise in their alias scopes: within one function, what `STORE[k]` writes is read neither by
`load` nor touched by `STORE[j]`, j != k. The caller keeps the promise by giving distinct, non-overlapping arrays, or
distinct places of one array. Indices count the elements of the array in C order, whatever its shape; they are neither
checked nor wrapped.

With `NUMBA_DISABLE_JIT` the same names are plain Python.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import config
from numba.core import types
from numba.extending import intrinsic

_STORES = 27


def _scope(builder, *names):
    module = builder.module
    domain = module.add_metadata(["faceanim"])
    return module.add_metadata([module.add_metadata([name, domain]) for name in names])


def _address(context, builder, array_type, array, index_type, index):
    data = context.make_array(array_type)(context, builder, array).data
    return builder.gep(data, [context.cast(builder, index, index_type, types.intp)])


def _make_load():
    @intrinsic
    def load(typingctx, array, index):
        def emit(context, builder, signature, args):
            array_type, index_type = signature.args
            value = builder.load(_address(context, builder, array_type, args[0], index_type, args[1]))
            value.set_metadata("alias.scope", _scope(builder, "in"))
            return value

        return array.dtype(array, index), emit

    return load


def _make_store(k):
    others = ["in"] + [f"out{j}" for j in range(_STORES) if j != k]

    @intrinsic
    def store(typingctx, array, index, value):
        def emit(context, builder, signature, args):
            array_type, index_type, value_type = signature.args
            address = _address(context, builder, array_type, args[0], index_type, args[1])
            kept = builder.store(context.cast(builder, args[2], value_type, array_type.dtype), address)
            kept.set_metadata("alias.scope", _scope(builder, f"out{k}"))
            kept.set_metadata("noalias", _scope(builder, *others))
            return context.get_dummy_value()

        return types.none(array, index, value), emit

    return store


def _copy3(typingctx, target, i, source, j):
    def emit(context, builder, signature, args):
        to = _address(context, builder, signature.args[0], args[0], signature.args[1], args[1])
        origin = _address(context, builder, signature.args[2], args[2], signature.args[3], args[3])
        pair = ir.VectorType(ir.DoubleType(), 2).as_pointer()
        two = builder.load(builder.bitcast(origin, pair), align=8)
        last = ir.Constant(ir.IntType(64), 2)
        third = builder.load(builder.gep(origin, [last]))
        builder.store(two, builder.bitcast(to, pair), align=8)
        builder.store(third, builder.gep(to, [last]))
        return context.get_dummy_value()

    return types.none(target, i, source, j), emit


def _add4(typingctx, target, i, source, j):
    def emit(context, builder, signature, args):
        four = ir.VectorType(ir.DoubleType(), 4).as_pointer()
        to = _address(context, builder, signature.args[0], args[0], signature.args[1], args[1])
        origin = _address(context, builder, signature.args[2], args[2], signature.args[3], args[3])
        to = builder.bitcast(to, four)
        total = builder.fadd(builder.load(to, align=8), builder.load(builder.bitcast(origin, four), align=8))
        builder.store(total, to, align=8)
        return context.get_dummy_value()

    return types.none(target, i, source, j), emit


def _prefetch(typingctx, array, index):
    def emit(context, builder, signature, args):
        address = _address(context, builder, signature.args[0], args[0], signature.args[1], args[1])
        byte = ir.IntType(8).as_pointer()
        number = ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [byte, number, number, number])
        ask = builder.module.declare_intrinsic("llvm.prefetch", [byte], kind)
        builder.call(ask, [builder.bitcast(address, byte), number(0), number(3), number(1)])
        return context.get_dummy_value()

    return types.none(array, index), emit


def _make_cast(source, target, ir_type):
    @intrinsic
    def cast(typingctx, value):
        if value != source:
            return None
        return target(source), lambda context, builder, signature, args: builder.bitcast(args[0], ir_type)

    return cast


def _plain_load(array, index):
    return array.reshape(-1)[index]


def _plain_store(array, index, value):
    array.reshape(-1)[index] = value


def _plain_copy3(target, i, source, j):
    target.reshape(-1)[i : i + 3] = source.reshape(-1)[j : j + 3]


def _plain_add4(target, i, source, j):
    target.reshape(-1)[i : i + 4] += source.reshape(-1)[j : j + 4]


def _plain_prefetch(array, index):
    pass


def _choose(compiled: Any, plain: Any) -> Any:
    return plain if getattr(config, "DISABLE_JIT", 0) else compiled


load = _choose(_make_load(), _plain_load)
"""load(array, index): element `index`."""
STORE = tuple(_choose(_make_store(k), _plain_store) for k in range(_STORES))
"""STORE[k](array, index, value): set element `index`. A kernel cannot index this tuple: give its items names."""
copy3 = _choose(intrinsic(_copy3), _plain_copy3)
"""copy3(target, i, source, j): three float64 elements from j on to i on."""
add4 = _choose(intrinsic(_add4), _plain_add4)
"""add4(target, i, source, j): add four float64 elements from j on to those from i on, in one vector instruction."""
prefetch = _choose(intrinsic(_prefetch), _plain_prefetch)
"""prefetch(array, index): ask for the cache line of an element to be read soon; the index may lie outside the array."""
bits = _choose(_make_cast(types.float64, types.int64, ir.IntType(64)), lambda value: np.float64(value).view(np.int64))
"""bits(value): the bits of a float64 as int64."""
from_bits = _choose(
    _make_cast(types.int64, types.float64, ir.DoubleType()), lambda value: np.int64(value).view(np.float64)
)
"""from_bits(value): the float64 whose bits are `value` (int64)."""
