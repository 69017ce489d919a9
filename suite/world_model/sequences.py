"""What the world model learns from: replayed sequences, their observations as tokens."""

from __future__ import annotations

import jax
from flax import struct

from suite.interface.turns import Turn
from suite.world_model.history import History


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
      history_BT: of all frames but the last, for a model that is told something; else None.
      weight_B: float32; of what each sequence's rewards and ends teach, 1 on average. None: 1.
    """

    tokens_BTL: jax.Array
    action_BT: jax.Array
    reward_BT: jax.Array
    terminated_BT: jax.Array
    ended_BT: jax.Array | None = None
    turn_BT: Turn | None = None
    history_BT: History | None = None
    weight_B: jax.Array | None = None
