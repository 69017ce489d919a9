"""Floating-point operations of a function, counted in its program: matrix products and convolutions only.

Element-wise work is left out, as is usual when a rate is compared with a device's rate for matrix products.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax


def count_flops(function: Callable[..., Any], *arguments: Any) -> int:
    """Multiplications and additions of one call; nothing is compiled or run.

    A loop counts as often as it runs if that is known while tracing (`scan`), else once (`while_loop`); of a
    conditional's branches the most expensive one counts.

    Args:
      function: may be jitted.
      arguments: arrays or `jax.ShapeDtypeStruct`s.
    """
    return _count(jax.make_jaxpr(function)(*arguments).jaxpr)


def _count(jaxpr: Any) -> int:
    return sum(_count_equation(equation) for equation in jaxpr.eqns)


def _count_equation(equation: Any) -> int:
    name, params = equation.primitive.name, equation.params
    if name == "dot_general":
        (contracted, _), _ = params["dimension_numbers"]
        depth = math.prod(equation.invars[0].aval.shape[axis] for axis in contracted)
        return 2 * equation.outvars[0].aval.size * depth
    if name == "conv_general_dilated":
        kernel = equation.invars[1].aval.shape
        outputs = kernel[params["dimension_numbers"].rhs_spec[0]]
        # Per output: one product per kernel entry that leads to it. A dilated input (a gradient's) is mostly zeros
        # that a good kernel skips.
        skipped = math.prod(params["lhs_dilation"])
        return 2 * equation.outvars[0].aval.size * (math.prod(kernel) // outputs) // skipped
    if name == "cond":
        return max(_count(branch.jaxpr) for branch in params["branches"])
    inner = sum(_count(jaxpr) for value in params.values() for jaxpr in _jaxprs(value))
    if name == "shard_map":  # what one device does
        return inner * params["mesh"].size
    return inner * params["length"] if name == "scan" else inner


def _jaxprs(value: Any) -> list[Any]:
    """The programs among an equation's parameters, closed or not."""
    if hasattr(value, "eqns"):
        return [value]
    return [value.jaxpr] if hasattr(getattr(value, "jaxpr", None), "eqns") else []
