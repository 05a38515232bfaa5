"""Checks of shapes and types of arrays, at each call of a function that takes or returns arrays."""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Callable, Mapping
from typing import Any, get_args

import jaxtyping


def install(modules: list[str], typechecker: str) -> None:
    """Check the calls of functions, and the fields of records, whose annotations have shapes.

    Other functions are not checked: mypy checks their types, and a check would be much slower than the call.
    """
    jaxtyped = jaxtyping.jaxtyped

    def decorator(*, typechecker: Callable[..., Any]) -> Callable[..., Any]:
        return lambda definition: (
            jaxtyped(definition, typechecker=typechecker) if has_shapes(definition) else definition
        )

    jaxtyping.jaxtyped = decorator  # the decorator that the import hook uses
    jaxtyping.install_import_hook(modules, typechecker)


def has_shapes(definition: Any) -> bool:
    """Return whether a function, a method, a property or a record has an array among its annotations."""
    definition = getattr(definition, "fget", None) or getattr(definition, "__func__", definition)
    if inspect.isclass(definition):
        names: Mapping[str, Any] = vars(sys.modules[definition.__module__])
        annotations = [value for kind in definition.__mro__ for value in vars(kind).get("__annotations__", {}).values()]
    else:
        names, annotations = definition.__globals__, [*definition.__annotations__.values()]
    return any(_is_array(annotation, names) for annotation in annotations)


def _is_array(annotation: Any, names: Mapping[str, Any]) -> bool:
    if isinstance(annotation, str):
        return any(_is_array(names[word], {}) for word in re.findall(r"\w+", annotation) if word in names)
    if inspect.isclass(annotation) and issubclass(annotation, jaxtyping.AbstractArray | jaxtyping.AbstractDtype):
        return True
    return any(_is_array(argument, names) for argument in get_args(annotation))
