"""Contract 2: turns. Chance is player 0 with actions of its own; an opponent is a policy.

A single-agent task has no `Turn` (`TimeStep.turn is None`), decided while tracing, so that it pays nothing.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from flax import struct

CHANCE = 0
FEW = 64  # weights that are summed one by one where one of them is drawn
LAST_SHARE = 1 - 1e-6


@struct.dataclass
class Turn:
    """Who acts next in a two-player game, and what is allowed; every field has the batch's leading axes.

    Attributes:
      player: int32; 0 chance, 1 or 2.
      seat: int32; which player is ours (1 or 2).
      legal_A: bool; legal actions of the player to act (all false at chance nodes).
      chance_C: float32; probabilities of the chance outcomes (all zero where a player acts).
      opponent_observation: what the other seat sees; for the world model only, never for the policy.
    """

    player: jax.Array
    seat: jax.Array
    legal_A: jax.Array
    chance_C: jax.Array
    opponent_observation: jax.Array

    @property
    def ours(self) -> jax.Array:
        """bool: it is our player's turn."""
        return self.player == self.seat


def stream_action(turn: Turn, event: jax.Array) -> jax.Array:
    """The event in the vocabulary of a world model's stream, where no two players share an action (note 32).

    [0, A) is player 1, [A, 2A) player 2, [2A, 2A + C) chance. int32, of the shape of `event`.
    """
    num_actions = turn.legal_A.shape[-1]
    return event + num_actions * jnp.where(turn.player == CHANCE, 2, turn.player - 1)


def choose_event(key: jax.Array, turn: Turn, action_B: jax.Array) -> jax.Array:
    """The event that happens at each environment's turn, int32 [B], in the player's own numbering.

    Ours: `action_B`. The opponent's: uniform over its legal actions. Chance's: an outcome index drawn from
    `chance_C` (the paper's Section 4.7).
    """
    opponent_key, chance_key = jax.random.split(key)
    other_B = _draw(opponent_key, turn.legal_A.astype(jnp.float32))
    if turn.chance_C.shape[-1]:
        other_B = jnp.where(turn.player == CHANCE, _draw(chance_key, turn.chance_C), other_B)
    return jnp.where(turn.ours, action_B, other_B).astype(jnp.int32)


def _draw(key: jax.Array, weight_BN: jax.Array) -> jax.Array:
    """An index [B] with probability proportional to its weight, which is not negative; 0 where all weights are 0.

    By inverting the cumulative distribution: one random number each, where noise for every one of bargaining's 1002
    outcomes would cost more than all the rest of an event. So would their cumulative sums: of many weights, first a
    group is drawn, then one of its members.
    """
    batch, count = weight_BN.shape
    # Below 1 by more than rounding, so that outcomes of weight 0 at the end are never drawn.
    share_B = jax.random.uniform(key, (batch,)) * LAST_SHARE
    if count <= FEW:
        return _invert(share_B, weight_BN)[0]
    width = math.isqrt(count - 1) + 1
    groups = -(-count // width)
    weight_BGW = jnp.pad(weight_BN, ((0, 0), (0, groups * width - count))).reshape(batch, groups, width)
    group_B, share_B = _invert(share_B, jnp.dot(weight_BGW, jnp.ones(width)))  # a CPU multiplies faster than it sums
    members_BW = jnp.take_along_axis(weight_BGW, group_B[:, None, None], axis=1)[:, 0]
    return group_B * width + _invert(share_B, members_BW)[0]


def _invert(share_B: jax.Array, weight_BN: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Where `share_B`, in [0, 1), of the total weight is reached: the index [B], and the share of its own weight."""
    cumulative_BN = jnp.cumsum(weight_BN, axis=-1)
    goal_B = share_B * cumulative_BN[:, -1]
    index_B = jnp.where(cumulative_BN[:, -1] > 0, (cumulative_BN <= goal_B[:, None]).sum(-1), 0)
    weight_B, up_to_B = (jnp.take_along_axis(x, index_B[:, None], axis=1)[:, 0] for x in (weight_BN, cumulative_BN))
    inside_B = 1 - (up_to_B - goal_B) / jnp.where(weight_B > 0, weight_B, 1)
    return index_B, jnp.clip(inside_B, 0, LAST_SHARE)
