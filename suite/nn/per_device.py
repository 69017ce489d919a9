"""A network's method, called on every device with its own rows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from flax import nnx

from suite.runtime import layout


def of_each_device(
    method: Callable[..., Any], module: nnx.Module, in_axes: tuple[Any, ...], out_axes: Any
) -> Callable[..., Any]:
    """`method(module, ...)` as a function of the rest, as `layout.per_device` has it; parameters are on each device."""
    if layout.devices() == 1:
        return lambda *arguments: method(module, *arguments)
    graphdef, params = nnx.split(module)

    def merged(params: nnx.State, *arguments: Any) -> Any:
        return method(nnx.merge(graphdef, params), *arguments)

    whole = layout.per_device(merged, (None, *in_axes), out_axes)
    return lambda *arguments: whole(params, *arguments)
