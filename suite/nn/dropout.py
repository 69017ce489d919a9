"""Dropout whose random bits cost less than the layer they act on.

Attention dropout needs a bit for every pair of tokens; drawn one by one from a cryptographic generator they cost more
than the attention. Here a random word per row and one per column are drawn, and each pair is mixed.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp


def dropout(x: jax.Array, rate: float, key: jax.Array | None) -> jax.Array:
    """Zeroes each entry of `x` [..., rows, columns] with probability `rate`, the others scaled by 1 / (1 - rate).

    The identity where `key` is None (evaluation) or `rate` is 0.
    """
    if key is None or rate == 0.0:
        return x
    row_key, column_key = jax.random.split(key)
    row = jax.random.bits(row_key, (*x.shape[:-1], 1))
    column = jax.random.bits(column_key, (*[1] * (x.ndim - 1), x.shape[-1]))
    keep = _mix(row + column) >= jnp.uint32(round(rate * 2**32))
    return jnp.where(keep, x / (1 - rate), jnp.zeros_like(x))


def _mix(word: jax.Array) -> jax.Array:
    """A bijection of 32-bit words that flips each output bit with probability near 1/2 (Murmur's finalizer)."""
    word = (word ^ (word >> 16)) * jnp.uint32(0x85EBCA6B)
    word = (word ^ (word >> 13)) * jnp.uint32(0xC2B2AE35)
    return word ^ (word >> 16)
