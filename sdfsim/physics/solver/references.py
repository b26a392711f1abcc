"""Structures of arrays by reference, compiled.

Numba passes a NamedTuple as all members of all its arrays, each as an argument: a hundred arrays are about a thousand
arguments of every function, which take most of the compile time, and much of the time of a call. A reference is one
argument. Its fields are read like those of the tuple; a field that is a NamedTuple is again a reference.
"""

from __future__ import annotations

import hashlib
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils, config
from numba.core.imputils import impl_ret_borrowed
from numba.core.typing.templates import AttributeTemplate
from numba.extending import infer_getattr, intrinsic, lower_getattr_generic, models, register_model


class Reference(types.Opaque):
    """The address of a NamedTuple of the type `of`."""

    def __init__(self, of: types.NamedTuple) -> None:
        self.of = of
        # The name becomes part of the names of all functions that take a reference: the whole type would have thousands
        # of letters.
        kind = hashlib.sha256(of.name.encode()).hexdigest()[:12]
        super().__init__(f"{of.instance_class.__name__}@{kind}")


register_model(Reference)(models.OpaqueModel)


@infer_getattr
class _Fields(AttributeTemplate):
    key = Reference

    def generic_resolve(self, reference: Reference, name: str) -> types.Type | None:
        if name not in reference.of.fields:
            return None
        field = reference.of.types[reference.of.fields.index(name)]
        return Reference(field) if isinstance(field, types.NamedTuple) else field


@lower_getattr_generic(Reference)
def _field(context: Any, builder: Any, reference: Reference, place: Any, name: str) -> Any:
    at = reference.of.fields.index(name)
    field = reference.of.types[at]
    whole = builder.bitcast(place, context.get_value_type(reference.of).as_pointer())
    here = cgutils.gep_inbounds(builder, whole, 0, at)
    if isinstance(field, types.NamedTuple):
        return builder.bitcast(here, cgutils.voidptr_t)
    return impl_ret_borrowed(context, builder, field, builder.load(here))


@intrinsic
def _reference(typing: Any, value: types.Type) -> Any:
    if isinstance(value, types.NoneType | Reference):
        return value(value), lambda context, builder, signature, arguments: arguments[0]
    if not isinstance(value, types.NamedTuple):
        return None

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        slot = cgutils.alloca_once(builder, arguments[0].type)
        builder.store(arguments[0], slot)
        return builder.bitcast(slot, cgutils.voidptr_t)

    return Reference(value)(value), code


@intrinsic
def _call(typing: Any, address: types.Type, arguments: Any) -> Any:
    parts: Any = arguments
    if not isinstance(arguments, types.BaseTuple):
        return None

    def code(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        kinds = [context.get_value_type(each) for each in parts.types]
        function = ir.FunctionType(context.get_value_type(types.int64), kinds)
        place = builder.inttoptr(given[0], function.as_pointer())
        return builder.call(place, cgutils.unpack_tuple(builder, given[1], len(kinds)))

    return types.int64(types.int64, arguments), code


# Call a function at an address with a tuple of references and whole numbers; it returns a whole number. Nothing checks
# the types of the arguments.
call: Any = (lambda function, arguments: function(*arguments)) if vars(config)["DISABLE_JIT"] else _call
# A reference to a NamedTuple, for compiled code; None and references as they are. Numba frees arrays after the last use
# of the variable that holds them, so take references of arguments only, or of variables that are used again after the
# last use of the reference.
reference: Any = (lambda value: value) if vars(config)["DISABLE_JIT"] else _reference
