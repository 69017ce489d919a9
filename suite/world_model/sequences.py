"""What the world model learns from: replayed sequences, their observations as tokens."""

from __future__ import annotations

import jax
from flax import struct

from suite.interface.turns import Turn


@struct.dataclass
class Sequences:
    """B replayed sequences of T steps and T + 1 frames, their observations as tokens.

    Attributes:
      tokens_BTL: int32 [B, T + 1, L], or float32 [B, T + 1, L, P] where tokens are vectors.
      action_BT: int32; taken at frame t.
      reward_BT: float32; what it earned.
      terminated_BT: bool; the episode ended there, and frame t + 1 belongs to the next one.
      ended_BT: bool; terminated or truncated; None: terminated. Only `mask_after_done` looks at it.
      turn_BT: whose turn it is at each of the T + 1 frames; None for single-agent tasks.
      age_BTL: int32 [B, T, L]; ages of all tokens but the last frame's, for a model that is told them; else None.
    """

    tokens_BTL: jax.Array
    action_BT: jax.Array
    reward_BT: jax.Array
    terminated_BT: jax.Array
    ended_BT: jax.Array | None = None
    turn_BT: Turn | None = None
    age_BTL: jax.Array | None = None
