"""Short LLVM code for what the filters' steps do most: fields of records, items of arrays, counting loops and calls.

Numba's own code for these serves every case. To read one item, it puts the description of the array on the stack (40
instructions); a loop over `range` is 110 instructions, a call 32. LLVM removes them all again. Writing, printing,
reading and removing them was half of the time to compile. The code here does the same arithmetic, so the results are
equal to the last bit. What it does not cover is left to numba's own code.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir as llvm
from numba.core import callconv, cgutils, ir, ir_utils, lowering
from numba.core import types as numba_types
from numba.np import arrayobj

types: Any = numba_types  # its attributes are made as it is imported
_INDEX = llvm.IntType(64)
_NUMBERS = (types.Number, types.Boolean)


class Lower(lowering.Lower):  # type: ignore[misc]
    """Writes the LLVM code of a function."""

    def init(self) -> None:
        """Called before a function is written."""
        super().init()
        self._slots: dict[Any, Any] = {}

    def lower_inst(self, inst: Any) -> Any:
        """One statement."""
        if isinstance(inst, ir.SetAttr) and isinstance(self.typeof(inst.target.name), types.Record):
            return self._set_field(inst)
        if isinstance(inst, ir.StaticSetItem | ir.SetItem) and self._set_item(inst):
            return None
        return super().lower_inst(inst)

    def lower_expr(self, resty: Any, expr: Any) -> Any:
        """The value of an expression, of type `resty`."""
        write = _EXPRESSIONS.get(expr.op)
        value = write(self, resty, expr) if write else None
        return super().lower_expr(resty, expr) if value is None else value

    def lower_binop(self, resty: Any, expr: Any, op: Any) -> Any:
        """An operation on two operands, one of which may be a constant.

        Only powers have code of their own for constants: numba would look for it three times. It squares in a loop.
        """
        if op not in (operator.pow, operator.ipow):
            expr.static_lhs = expr.static_rhs = ir.UNDEFINED
        elif expr.static_rhs == 2 and self.typeof(expr.lhs.name) == resty == types.float64:
            base = self.loadvar(expr.lhs.name)
            return self.builder.fmul(base, base)
        return super().lower_binop(resty, expr, op)

    def storevar(self, value: Any, name: str, argidx: int | None = None) -> None:
        """Numba also reads the old value, whose references it counts."""
        if self.context.enable_nrt or name in self._singly_assigned_vars:
            super().storevar(value, name, argidx)
            return
        self._alloca_var(name, self.typeof(name))
        self.builder.store(value, self.getvar(name))

    # Calls

    def _lower_call_normal(self, fnty: Any, expr: Any, signature: Any) -> Any:
        """The result of a call. What the callee raises goes directly to this function's caller."""
        if not isinstance(fnty, types.Dispatcher) or isinstance(signature.return_type, types.Optional):
            return super()._lower_call_normal(fnty, expr, signature)
        context, builder = self.context, self.builder
        arguments = self.fold_call_args(fnty, signature, expr.args, expr.vararg, expr.kws)
        compiled = fnty.dispatcher.get_compile_result(signature)
        callee = context.declare_function(builder.module, compiled.fndesc)
        context.add_linking_libs([compiled.library])
        result = self._slot(callee.args[0].type.pointee)
        packed = context.get_arg_packer(compiled.fndesc.argtypes).as_arguments(builder, arguments)
        code = builder.call(callee, [result, builder.function.args[1], *packed])
        with cgutils.if_unlikely(builder, builder.icmp_signed("!=", code, callconv.RETCODE_OK)):
            builder.ret(code)
        return context.get_returned_value(builder, signature.return_type, builder.load(result))

    def _slot(self, kind: Any) -> Any:
        """Memory for a result, one for all calls whose results are of this type: each is read at once."""
        if kind not in self._slots:
            with self.builder.goto_entry_block():
                self._slots[kind] = self.builder.alloca(kind)
        return self._slots[kind]

    # Records

    def _field(self, resty: Any, expr: Any) -> Any:
        """A field of a record; None for an attribute of anything else."""
        kind = self.typeof(expr.value.name)
        if not isinstance(kind, types.Record):
            return None
        record, field = self.loadvar(expr.value.name), kind.typeof(expr.attr)
        if isinstance(field, types.NestedArray):
            return self._array_in_record(field, record, kind.offset(expr.attr))
        value = arrayobj.record_getattr(self.context, self.builder, kind, record, expr.attr)
        return self.context.cast(self.builder, value, field, resty)

    def _array_in_record(self, kind: Any, record: Any, offset: int) -> Any:
        """The description of an array within a record: constant but for the address of its data."""
        data = cgutils.get_record_member(self.builder, record, offset, self.context.get_data_type(kind.dtype))
        model = self.context.data_model_manager[kind]
        whole = model.get_value_type()
        shape, strides = (
            llvm.Constant(llvm.ArrayType(_INDEX, kind.ndim), list(each)) for each in (kind.shape, kind.strides)
        )
        known = {"nitems": _INDEX(kind.nitems), "itemsize": _INDEX(kind.size), "shape": shape, "strides": strides}
        fields = [known.get(name, each(None)) for name, each in zip(model._fields, whole.elements, strict=True)]
        return self.builder.insert_value(llvm.Constant(whole, fields), data, model.get_field_position("data"))

    def _set_field(self, inst: Any) -> None:
        signature = self.fndesc.calltypes[inst]
        value = self.context.cast(
            self.builder, self.loadvar(inst.value.name), self.typeof(inst.value.name), signature.args[1]
        )
        record = self.loadvar(inst.target.name)
        arrayobj.record_setattr(self.context, self.builder, signature, (record, value), inst.attr)

    # Arrays

    def _item(self, resty: Any, expr: Any) -> Any:
        """An item of an array; None for items of anything else, and for parts of arrays."""
        if expr.op == "static_getitem":
            address = self._address(expr.value, expr.index_var, expr.index)
        else:
            address = self._address(expr.value, expr.index, None)
        if address is None:
            return None
        kind = self.typeof(expr.value.name)
        value = arrayobj.load_item(self.context, self.builder, kind, address)
        return self.context.cast(self.builder, value, kind.dtype, resty)

    def _set_item(self, inst: Any) -> bool:
        """Whether a number was written to an item of an array."""
        kind, own = self.typeof(inst.target.name), self.typeof(inst.value.name)
        if not isinstance(kind, types.Array) or not isinstance(kind.dtype, _NUMBERS) or not isinstance(own, _NUMBERS):
            return False
        if isinstance(inst, ir.StaticSetItem):
            address = self._address(inst.target, inst.index_var, inst.index)
        else:
            address = self._address(inst.target, inst.index, None)
        if address is None:
            return False
        typed = self.fndesc.calltypes[inst].args[2]
        value = self.context.cast(self.builder, self.loadvar(inst.value.name), own, typed)
        value = self.context.cast(self.builder, value, typed, kind.dtype)
        arrayobj.store_item(self.context, self.builder, kind, value, address)
        return True

    def _address(self, array: Any, index: Any, static: Any) -> Any:
        """The address of one item of an array whose rows follow one another; None where that is not what is asked for.

        `index` is the variable of the index or of a tuple of them, `static` their values where they are constants.
        """
        kind = self.typeof(array.name)
        if not isinstance(kind, types.Array) or kind.layout != "C" or self.context.enable_boundscheck:
            return None
        indices = self._indices(index, static)
        if len(indices) != kind.ndim or kind.ndim == 0:
            return None
        value, builder = self.loadvar(array.name), self.builder
        model = self.context.data_model_manager[kind]
        data, shape = (model.get_field_position(name) for name in ("data", "shape"))
        offset: Any = None
        for axis, each in enumerate(indices):
            size: Any = None
            if isinstance(kind, types.NestedArray):
                size = _INDEX(kind.shape[axis])
            elif axis or not isinstance(each, int) or each < 0:
                size = builder.extract_value(value, (shape, axis))
            place = self._from_the_start(each, size)
            offset = place if offset is None else builder.add(builder.mul(offset, size), place)
        return builder.gep(builder.extract_value(value, data), [offset])

    def _indices(self, index: Any, static: Any) -> list[Any]:
        """Each index as a constant, or as its type and value; empty where one is not an integer."""
        if static is not None:
            constants = list(static) if isinstance(static, tuple) else [static]
            return constants if all(type(each) is int for each in constants) else []
        kind, value = self.typeof(index.name), self.loadvar(index.name)
        if isinstance(kind, types.BaseTuple):
            kinds = list(kind)
            values = [self.builder.extract_value(value, k) for k in range(len(kinds))]
        else:
            kinds, values = [kind], [value]
        if not all(isinstance(each, types.Integer) for each in kinds):
            return []
        return list(zip(kinds, values, strict=True))

    def _from_the_start(self, index: Any, size: Any) -> Any:
        """An index from the start of an axis; negative ones count from its end."""
        if not isinstance(index, int):
            return arrayobj.fix_integer_index(self.context, self.builder, *index, size)
        return _INDEX(index) if index >= 0 else self.builder.add(size, _INDEX(index))

    # Loops over `range`: a state (start, stop, step) and an iterator (address of the next value, stop, step, address of
    # the number of values left)

    def _range(self, resty: Any, expr: Any) -> Any:
        """`range` without a step; None for other calls."""
        if not _is_range(self.typeof(expr.func.name)) or len(expr.args) > 2 or expr.kws or expr.vararg:
            return None
        kinds = self.fndesc.calltypes[expr].args
        values = [self._cast_var(each, kind) for each, kind in zip(expr.args, kinds, strict=True)]
        whole = self.context.get_value_type(resty)
        number = whole.elements[0]
        state = llvm.Constant(whole, [number(0), number(llvm.Undefined), number(1)])
        for place, value in zip((1,) if len(values) == 1 else (0, 1), values, strict=True):
            state = self.builder.insert_value(state, value, place)
        return state

    def _begin(self, resty: Any, expr: Any) -> Any:
        """The iterator of a `range` without a step; None for others."""
        made = ir_utils.guard(ir_utils.get_definition, self.func_ir, expr.value)
        if getattr(made, "op", "") != "call" or len(made.args) > 2 or not _is_range(self.typeof(made.func.name)):
            return None
        state, builder = self.loadvar(expr.value.name), self.builder
        whole = self.context.get_value_type(resty)
        number = whole.elements[1]
        with builder.goto_entry_block():
            following, left = builder.alloca(number), builder.alloca(number)
        start, stop = builder.extract_value(state, 0), builder.extract_value(state, 1)
        builder.store(start, following)
        builder.store(builder.sub(stop, start), left)
        undefined = whole.elements[0](llvm.Undefined)
        iterator = llvm.Constant(whole, [undefined, number(llvm.Undefined), number(1), undefined])
        return builder.insert_value(builder.insert_value(iterator, following, 0), left, 3)

    def _next(self, resty: Any, expr: Any) -> Any:
        """The next value of a loop over a `range`, and whether there is one; None for other loops."""
        if not isinstance(self.typeof(expr.value.name), types.RangeIteratorType):
            return None
        iterator, builder = self.loadvar(expr.value.name), self.builder
        following, left = builder.extract_value(iterator, 0), builder.extract_value(iterator, 3)
        value, number = builder.load(following), builder.load(left)
        builder.store(builder.add(value, builder.extract_value(iterator, 2)), following)
        builder.store(builder.sub(number, number.type(1)), left)
        pair = llvm.Constant(self.context.get_value_type(resty), llvm.Undefined)
        is_valid = builder.icmp_signed(">", number, number.type(0))
        return builder.insert_value(builder.insert_value(pair, value, 0), is_valid, 1)

    def _first(self, resty: Any, expr: Any) -> Any:
        return self.builder.extract_value(self.loadvar(expr.value.name), 0)

    def _second(self, resty: Any, expr: Any) -> Any:
        return self.builder.extract_value(self.loadvar(expr.value.name), 1)


_EXPRESSIONS: dict[str, Callable[[Any, Any, Any], Any]] = {
    "getattr": Lower._field,
    "getitem": Lower._item,
    "static_getitem": Lower._item,
    "call": Lower._range,
    "getiter": Lower._begin,
    "iternext": Lower._next,
    "pair_first": Lower._first,
    "pair_second": Lower._second,
}


def _is_range(kind: Any) -> bool:
    return isinstance(kind, types.Function) and kind.typing_key is range
