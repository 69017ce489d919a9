"""What training carries from one iteration to the next."""

from __future__ import annotations

from flax import struct

from suite.agent.replay import ReplayState
from suite.agent.rollout import RolloutState
from suite.interface.tokens import TokenizerState
from suite.policy.ppo import PolicyTrainState
from suite.world_model.training import WorldModelTrainState


@struct.dataclass
class TrainState:
    """Everything that a run carries from one iteration to the next.

    Attributes:
      policy: policy parameters, their optimizer, value statistics.
      rollout: the real environments and the policy's memory of them.
      replay, tokenizer, world_model: None for model-free agents.
    """

    policy: PolicyTrainState
    rollout: RolloutState
    replay: ReplayState | None = None
    tokenizer: TokenizerState | None = None
    world_model: WorldModelTrainState | None = None
