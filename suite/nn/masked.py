"""Sums over a part of an array."""

from __future__ import annotations

import jax
import jax.numpy as jnp


def masked_mean(x: jax.Array, mask: jax.Array | None = None) -> jax.Array:
    """The mean of `x` where `mask`, of its shape, counts; 0 of nothing.

    Args:
      x: float32.
      mask: bool, or float32 weights; None: everything counts.
    """
    if mask is None:
        return x.mean()
    counted = jnp.where(mask, x, 0.0) if mask.dtype == bool else x * mask
    return counted.sum() / jnp.maximum(mask.sum().astype(x.dtype), 1.0)
