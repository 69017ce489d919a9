"""What training carries from one iteration to the next."""

from __future__ import annotations

import dataclasses
from typing import Any, TypeVar

import jax
from flashbax.buffers.trajectory_buffer import TrajectoryBufferState
from flax import struct

from suite.agent.replay import ReplayState
from suite.agent.rollout import EpisodeLog, Recent, RolloutState
from suite.interface.tokens import TokenizerState
from suite.policy.ppo import PolicyTrainState, Trajectory
from suite.runtime import layout
from suite.world_model.training import WorldModelTrainState

Tree = TypeVar("Tree")


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


def laid_out(tree: Tree) -> Tree:
    """The same arrays, or shapes of arrays, where `suite.runtime.layout` wants them.

    Rollouts, trajectories and replayed steps are split along their batch axis. All else is on every device. Of several
    seeds, all is split along their axis.
    """
    if layout.of_seeds():
        return layout.split(tree)
    parts = (RolloutState, Recent, Trajectory, EpisodeLog, TrajectoryBufferState)
    return jax.tree.map(_laid_out, tree, is_leaf=lambda x: isinstance(x, parts))


def _laid_out(part: Any) -> Any:
    if isinstance(part, TrajectoryBufferState):
        return layout.replicated(part).replace(experience=layout.split(part.experience))
    if not isinstance(part, RolloutState | Recent | Trajectory):
        return layout.replicated(part)
    moments = ("hidden_BH", "last_value_B", "last_ours_B")  # what is known of one; time comes first in the rest

    def placed(name: str, value: Any) -> Any:
        if isinstance(part, RolloutState):
            return _laid_out(value) if name == "recent" else layout.split(value)
        return layout.split(value, axis=0 if name in moments else 1)

    return type(part)(
        **{field.name: placed(field.name, getattr(part, field.name)) for field in dataclasses.fields(part)}
    )
