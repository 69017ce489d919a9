"""The model that a checkpoint keeps, and the way back from a run's folder to it."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
from flax import struct

from suite import registry
from suite.agent.phases import Agent
from suite.agent.replay import ReplayState
from suite.agent.rollout import RolloutState
from suite.agent.state import TrainState
from suite.configuration.schema import CheckpointConfig, Config, EvaluationConfig, ProtocolConfig
from suite.interface.tokens import TokenizerState
from suite.policy.ppo import PolicyTrainState
from suite.records import checkpoint
from suite.records.record import RunRecord
from suite.runtime.compilation import device_kind, enable_compilation_cache
from suite.runtime.errors import UserError
from suite.runtime.reporting import Reporter
from suite.world_model.training import WorldModelTrainState


@struct.dataclass
class SavedModel:
    """What evaluation and inspection need of a `TrainState`.

    Attributes:
      policy: the policy's parameters.
      targets: statistics of its value targets.
      tokenizer: codebook or networks; None for model-free agents.
      world_model: the parameters that dreams use, averaged or not; None for model-free agents.
    """

    policy: Any
    targets: Any
    tokenizer: TokenizerState | None
    world_model: Any

    @classmethod
    def of(cls, state: TrainState) -> SavedModel:
        """The part of `state` that is saved as the model."""
        policy, model = state.policy, state.world_model
        return cls(policy.params, policy.targets, state.tokenizer, None if model is None else model.dreaming)

    @property
    def policy_state(self) -> PolicyTrainState:
        """The policy as it acts; it has no optimizer and cannot learn."""
        return PolicyTrainState(params=self.policy, optimizer=None, targets=self.targets)


@dataclasses.dataclass(frozen=True)
class Remainder:
    """What a `TrainState` holds besides its `SavedModel`: what only going on with training needs.

    Its fields' names are those of checkpoints, so that a run of an earlier version can go on.

    Attributes:
      optimizer: the state of the policy's optimizer.
      player: the rollout's state.
      replay, world_model_optimizer: None for agents that have none.
      world_model_trained: the world model's parameters, where the saved ones are their moving average; else None.
      world_model_measured: the moving averages of what is known of rewards, where they are measured; else None.
    """

    optimizer: Any
    player: RolloutState
    replay: ReplayState | None
    world_model_optimizer: Any
    world_model_trained: Any
    world_model_measured: jax.Array | None

    @classmethod
    def of(cls, state: TrainState) -> Remainder:
        """The part of `state` that is not saved as the model."""
        model = state.world_model
        return cls(
            optimizer=state.policy.optimizer,
            player=state.rollout,
            replay=state.replay,
            world_model_optimizer=None if model is None else model.optimizer,
            world_model_trained=None if model is None or model.averaged is None else model.params,
            world_model_measured=None if model is None else model.measured,
        )

    def stored(self) -> dict[str, Any]:
        """As checkpoints hold it: by name."""
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}

    def with_model(self, saved: SavedModel) -> TrainState:
        """The `TrainState` whose parts these two are."""
        world_model, trained = None, self.world_model_trained
        if saved.world_model is not None:
            world_model = WorldModelTrainState(
                params=saved.world_model if trained is None else trained,
                optimizer=self.world_model_optimizer,
                averaged=None if trained is None else saved.world_model,
                measured=self.world_model_measured,
            )
        policy = dataclasses.replace(saved.policy_state, optimizer=self.optimizer)
        return TrainState(policy, self.player, self.replay, saved.tokenizer, world_model)


@dataclasses.dataclass(frozen=True)
class RestoredRun:
    """A run's agent and its newest model, taken after `step` real steps."""

    agent: Agent
    model: SavedModel
    step: int


def restore(record: RunRecord, reporter: Reporter) -> RestoredRun:
    """The newest model of a run.

    Args:
      record: of the run.
      reporter: where warnings about damaged checkpoints go.

    Raises:
      UserError: the run has no checkpoint, or none that is whole.
    """
    agent = agent_for(record.config, reporter)
    template = jax.eval_shape(lambda key: SavedModel.of(agent.init(key)), jax.random.key(0))
    restored = checkpoint.restore_latest(record.folder / "checkpoints", template)
    if restored is None:
        raise no_checkpoint(record)
    for warning in restored.warnings:
        reporter.warning(warning)
    return RestoredRun(agent, restored.model, restored.step)


def no_checkpoint(record: RunRecord) -> UserError:
    """The error that a run has nothing to restore."""
    return UserError(f"{record.folder} has no checkpoint; run it first: suite run {record.config.task}")


_agents: dict[tuple[Config, int], Agent] = {}  # the last one built


def agent_for(config: Config, reporter: Reporter, seeds: int = 1) -> Agent:
    """The agent of a configuration, as so many runs that go on together (`suite.agent.seeds`).

    Those that differ by seed, by a budget that nothing is tied to, or in when runs are evaluated and saved share one.

    With it they share its compiled programs. Those of the agent before are dropped: they would stay for good, and on a
    CPU each agent's are thousands of memory maps, of which Linux gives a process 65,530. XLA crashes where they end.
    """
    protocol = config.protocol if config.tied_to_budget else ProtocolConfig(steps=config.steps_per_iteration)
    shared = dataclasses.replace(
        config, seed=0, protocol=protocol, evaluation=EvaluationConfig(), checkpoint=CheckpointConfig()
    )
    if (shared, seeds) not in _agents:
        _agents.clear()
        jax.clear_caches()
        device_kind()  # or one line that says that there is none
        enable_compilation_cache()
        environment = registry.task(config.task).make()(progress=reporter.texture)
        _agents[shared, seeds] = Agent(shared, environment, seeds)
    return _agents[shared, seeds]
