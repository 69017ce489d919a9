"""What a world model is told of what came before the frames that it reads. Not the paper's.

How old every token is: for how many steps its place has shown it. In many games things move by timers that no frame
shows, all of them together or each by itself. A token that has just come tells when its timer began, so ages tell what
is due next without a model that reads many frames.

And how often each action has earned a reward in this episode. Many rewards are paid once an episode, and no frame shows
whether they were: a model that is not told pays them again and again in its dreams.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

MOST = 255  # that a count holds


@struct.dataclass
class History:
    """Of any leading axes; what a model is not told is None.

    Attributes:
      age: int32 [..., L]; ages of a frame's tokens.
      paid: uint8 [..., A]; how often each action had earned a reward in the episode, up to the frame.
    """

    age: jax.Array | None = None
    paid: jax.Array | None = None


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


def next_paid(paid_BA: jax.Array, action_B: jax.Array, pays_B: jax.Array) -> jax.Array:
    """How often each action has earned a reward, uint8 [B, A], after one step more of the same episode."""
    earned_BA = jax.nn.one_hot(action_B, paid_BA.shape[-1], dtype=paid_BA.dtype) * pays_B[:, None].astype(paid_BA.dtype)
    return jnp.where(paid_BA < MOST, paid_BA + earned_BA, paid_BA)


def paid_before(
    paid_BA: jax.Array, action_TB: jax.Array, pays_TB: jax.Array, first_TB: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """How often each action had earned a reward before each of T steps, uint8 [T, B, A], and after the last, [B, A].

    Args:
      paid_BA: uint8; up to the first of these steps.
      action_TB: int32.
      pays_TB: bool; whether the step earned a reward.
      first_TB: bool; the frame acted on opens an episode, in which nothing has been paid yet.
    """

    def step(paid_BA: jax.Array, now: tuple[jax.Array, ...]) -> tuple[jax.Array, jax.Array]:
        action_B, pays_B, first_B = now
        paid_BA = jnp.where(first_B[:, None], jnp.zeros_like(paid_BA), paid_BA)
        return next_paid(paid_BA, action_B, pays_B), paid_BA

    after_BA, paid_TBA = jax.lax.scan(step, paid_BA, (action_TB, pays_TB, first_TB))
    return paid_TBA, after_BA
