"""A bias whose gradient is fast on a CPU."""

from __future__ import annotations

import jax
import jax.numpy as jnp

ROWS = 8  # with fewer the product is compiled into loops too


@jax.custom_vjp
def add_bias(x_NC: jax.Array, bias_C: jax.Array) -> jax.Array:
    """`x_NC + bias_C`."""
    return x_NC + bias_C[None]


def _forward(x_NC: jax.Array, bias_C: jax.Array) -> tuple[jax.Array, None]:
    return add_bias(x_NC, bias_C), None


def _backward(_: None, slope_NC: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Gradients by both.

    The bias's is a sum over N. Where N stands for several axes, XLA on a CPU sums over all of them at once, and takes
    ten times as long as for the matrix product with ones that this is.
    """
    return slope_NC, jnp.ones((ROWS, len(slope_NC)), slope_NC.dtype).dot(slope_NC, precision="highest")[0]


add_bias.defvjp(_forward, _backward)
