"""Drawing tokens from probabilities, in the way that is fast on the device at hand."""

from __future__ import annotations

import jax
import jax.numpy as jnp

RUN = 32  # codes whose probabilities are summed first, where there are many
MANY = 128


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
    # First a run of codes, then one of them: on a CPU a running sum over all codes takes nine times as long (K = 1024).
    codes, uniform_BL = probability_BLK.shape[-1], jax.random.uniform(key, probability_BLK.shape[:-1])
    if codes <= MANY:
        return _invert(probability_BLK, uniform_BL)[0]
    padded_BLK = jnp.pad(probability_BLK, ((0, 0), (0, 0), (0, -codes % RUN)))
    run_BLRC = padded_BLK.reshape(*padded_BLK.shape[:-1], -1, RUN)
    chosen_BL, rest_BL = _invert(run_BLRC.sum(-1), uniform_BL)
    chosen_BLC = jnp.take_along_axis(run_BLRC, chosen_BL[..., None, None], axis=-2)[..., 0, :]
    return chosen_BL * RUN + _invert(chosen_BLC, rest_BL)[0]


def _invert(weight_BLK: jax.Array, uniform_BL: jax.Array) -> tuple[jax.Array, jax.Array]:
    """int32 [B, L]: where cumulative weights pass a share of their sum; and how far into it, float32 in [0, 1)."""
    cumulative_BLK = jnp.cumsum(weight_BLK, axis=-1)
    # Keep off the very end, where rounding would let the unfilled codes behind the last filled one in.
    passed_BL1 = uniform_BL[..., None] * (1 - 1e-5) * cumulative_BLK[..., -1:]
    index_BL = (cumulative_BLK <= passed_BL1).sum(-1, dtype=jnp.int32)
    weight_BL1, until_BL1 = (jnp.take_along_axis(x, index_BL[..., None], axis=-1) for x in (weight_BLK, cumulative_BLK))
    rest_BL = 1 - ((until_BL1 - passed_BL1) / weight_BL1)[..., 0]
    return index_BL, jnp.clip(rest_BL, 0.0, 1.0)


def _draw_by_noise(key: jax.Array, probability_BLK: jax.Array) -> jax.Array:
    return jax.random.categorical(key, jnp.log(probability_BLK)).astype(jnp.int32)
