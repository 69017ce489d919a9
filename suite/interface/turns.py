"""Contract 2: turns. Chance is player 0 with actions of its own; an opponent is a policy.

A single-agent task has no `Turn` (`TimeStep.turn is None`), decided while tracing, so that it pays nothing.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

CHANCE = 0


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
    other_B = jax.random.categorical(opponent_key, jnp.where(turn.legal_A, 0.0, -jnp.inf))
    if turn.chance_C.shape[-1]:
        chance_B = jax.random.categorical(chance_key, jnp.log(turn.chance_C))
        other_B = jnp.where(turn.player == CHANCE, chance_B, other_B)
    return jnp.where(turn.ours, action_B, other_B).astype(jnp.int32)
