"""Sums over a part of an array."""

from __future__ import annotations

import jax
import jax.numpy as jnp


def masked_mean(x: jax.Array, mask: jax.Array | None = None) -> jax.Array:
    """The mean of `x` where `mask`, of its shape, is true or 1 (None: everywhere); 0 of nothing."""
    if mask is None:
        return x.mean()
    return jnp.where(mask.astype(bool), x, 0.0).sum() / jnp.maximum(mask.sum(dtype=x.dtype), 1.0)
