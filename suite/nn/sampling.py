"""Drawing tokens from probabilities, in the way that is fast on the device at hand."""

from __future__ import annotations

import jax
import jax.numpy as jnp


def draw(key: jax.Array, probability_BLK: jax.Array, min_p: float = 0.0) -> jax.Array:
    """int32 [B, L]: every token, in parallel and independently, with these probabilities.

    With `min_p`, codes of less than that share of the likeliest one's probability are left out.

    On a CPU by inverting the cumulative distribution, which takes one random number per token: adding noise to every
    logit takes K of them, and six times as long (K = 512). Elsewhere the noise is free, and running sums are not.
    """
    if min_p:
        least_BL1 = min_p * probability_BLK.max(-1, keepdims=True)
        probability_BLK = jnp.where(probability_BLK >= least_BL1, probability_BLK, 0.0)
    return jax.lax.platform_dependent(key, probability_BLK, cpu=_draw_by_inversion, default=_draw_by_noise)


def _draw_by_inversion(key: jax.Array, probability_BLK: jax.Array) -> jax.Array:
    cumulative_BLK = jnp.cumsum(probability_BLK, axis=-1)
    # Keep off the very end, where rounding would let the unfilled codes behind the last filled one in.
    uniform_BL1 = jax.random.uniform(key, (*probability_BLK.shape[:-1], 1)) * (1 - 1e-5)
    return (cumulative_BLK <= uniform_BL1 * cumulative_BLK[..., -1:]).sum(-1, dtype=jnp.int32)


def _draw_by_noise(key: jax.Array, probability_BLK: jax.Array) -> jax.Array:
    return jax.random.categorical(key, jnp.log(probability_BLK)).astype(jnp.int32)
