"""How options that need not be given are shown: as what they take, without the word None."""

from __future__ import annotations

import dataclasses
import types
import typing

from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    UnsupportedTypeAnnotationError,
)

REGISTRY = ConstructorRegistry()


@REGISTRY.primitive_rule
def optional_rule(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | UnsupportedTypeAnnotationError | None:
    """`X | None` is parsed and shown as `X`: to leave an option out is the way to say None.

    Without it, help and messages offer `None` among the choices, and those in another order each time.
    """
    several = info.type_origin in (typing.Union, types.UnionType)
    options = typing.get_args(info.type) if several else ()
    if len(options) != 2 or type(None) not in options:
        return None
    only = next(o for o in options if o is not type(None))
    spec = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(only, info.markers))
    if not isinstance(spec, PrimitiveConstructorSpec):
        return spec
    return dataclasses.replace(
        spec,
        is_instance=lambda value: value is None or spec.is_instance(value),
        str_from_instance=lambda value: ["not", "given"] if value is None else spec.str_from_instance(value),
    )
