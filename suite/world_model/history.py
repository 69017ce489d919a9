"""How old every token is: for how many steps its place has shown it.

In many games things move by timers that no frame shows, all of them together or each by itself. A token that has just
come tells when its timer began, so ages tell what is due next without a model that reads many frames. Not the paper's.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp


def ages_of(tokens_BTL: jax.Array, limit: int) -> jax.Array:
    """Ages of consecutive frames' tokens, int32 [B, T, L], at most `limit`; of what the first frame shows, 0 there."""
    changed_BTL = tokens_BTL[:, 1:] != tokens_BTL[:, :-1]
    changed_BTL = jnp.pad(changed_BTL, ((0, 0), (1, 0), (0, 0)), constant_values=True)
    time_1T1 = jnp.arange(tokens_BTL.shape[1], dtype=jnp.int32)[None, :, None]
    since_BTL = jax.lax.cummax(jnp.where(changed_BTL, time_1T1, 0), axis=1)
    return jnp.minimum(time_1T1 - since_BTL, limit)


def next_ages(age_BL: jax.Array, before_BL: jax.Array, tokens_BL: jax.Array, limit: int) -> jax.Array:
    """Ages of a frame's tokens, int32 [B, L], from those of the frame before it."""
    return jnp.where(tokens_BL == before_BL, jnp.minimum(age_BL + 1, limit), 0)
