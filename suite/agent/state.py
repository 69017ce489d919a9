"""What training carries from one iteration to the next."""

from __future__ import annotations

from flax import struct

from suite.agent.replay import ReplayState
from suite.agent.rollout import Player
from suite.interface.tokens import TokenizerState
from suite.policy.ppo import Learner
from suite.world_model.training import WorldModelLearner


@struct.dataclass
class TrainState:
    """Everything that a run carries from one iteration to the next.

    Attributes:
      learner: policy parameters, their optimizer, value statistics.
      player: the real environments and the policy's memory of them.
      replay, tokenizer, world_model: None for model-free agents.
    """

    learner: Learner
    player: Player
    replay: ReplayState | None = None
    tokenizer: TokenizerState | None = None
    world_model: WorldModelLearner | None = None
