"""The parts of an agent that stay as they are while it learns: networks' structure, optimizers, its buffer's shape."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx

from suite.agent.replay import Replay, ReplayState
from suite.configuration.schema import Config
from suite.interface.batching import Batched
from suite.interface.environment import Environment, State
from suite.interface.host import HostEnvironment
from suite.policy import ppo
from suite.policy.actor_critic import make_policy
from suite.runtime.errors import UserError
from suite.tokenizers.nearest_neighbor import NearestNeighborTokenizer
from suite.tokenizers.stream import build_tokenizer
from suite.world_model import training as world_model_training
from suite.world_model.transformer import WorldModel


class Parts:
    """An agent's parts on one task, without the arrays that learn: those are in a `TrainState`."""

    def __init__(self, config: Config, environment: Environment):
        """Builds the structure only; `init` makes the arrays.

        Args:
          config: the resolved configuration.
          environment: one pure environment.

        Raises:
          UserError: it is to be dreamt in, but steps on the host, and so cannot go back to an earlier state.
        """
        if config.imagination.world == "game" and isinstance(environment, HostEnvironment):
            raise UserError(
                f"agent {config.agent} dreams in the game itself, and {config.task} steps on the host, where no dream "
                "can start from an earlier state; it needs craftax_classic, craftax_full, minatar/* or a game of "
                "openspiel/* that fits into tables"
            )
        self.config = config
        self.spec = spec = environment.spec
        self.batched = Batched(environment, config.environment.num_envs)
        self.policy_graph = nnx.graphdef(nnx.eval_shape(lambda: self._new_policy(nnx.Rngs(0))))
        self.policy_optimizer = ppo.make_optimizer(config.ppo)
        if config.dreams:
            self.replay = Replay.of(config)
        if config.world_model.enabled:
            self.tokenizer, self.tokens, self.grid = build_tokenizer(config, spec)
            self.world_model_optimizer = world_model_training.make_optimizer(config.world_model)
            self.world_model_graph = nnx.graphdef(nnx.eval_shape(lambda: self._new_world_model(nnx.Rngs(0))))

    @property
    def learns_from_real(self) -> bool:
        """Whether real play teaches its policy."""
        return self.config.learns_from_real

    @property
    def ages(self) -> int:
        """The highest age of a token that the world model is told; 0: it is told none."""
        return self.config.world_model.ages if self.config.world_model.enabled and self.tokens.spatial else 0

    @property
    def told_of_pay(self) -> bool:
        """Whether the world model is told how often each action has earned a reward."""
        return bool(self.config.world_model.enabled and self.config.world_model.paid and self.tokens.spatial)

    @property
    def past(self) -> int:
        """How many real frames before a dream's first one its world model is told of."""
        return max(self.config.imagination.context, self.ages)

    def learning_rates_left(self, before: jax.Array, after: jax.Array) -> tuple[jax.Array, jax.Array] | None:
        """What is left of the policy's learning rate after so many real steps (float32 scalars); None: all, always."""
        if not self.config.ppo.anneal_learning_rate:
            return None
        total = self.config.total_steps
        return jnp.maximum(1 - before / total, 0.0), jnp.maximum(1 - after / total, 0.0)

    def _new_policy(self, rngs: nnx.Rngs) -> Any:
        return make_policy(self.config.policy, self.spec.observation, self.spec.num_actions, rngs)

    def _new_world_model(self, rngs: nnx.Rngs) -> WorldModel:
        return WorldModel(self.config.world_model, self.tokens, self.grid, rngs)

    def _policy(self, policy_state: ppo.PolicyTrainState) -> Any:
        return nnx.merge(self.policy_graph, policy_state.params)

    def new_replay(self) -> ReplayState:
        """An empty replay buffer, with room for the environments' states if dreams happen in the game."""
        lasting = self.lasting_tokenizer
        return self.replay.init(
            self.spec, self.kept_state, lasting.tokens_per_frame if lasting else 0, self.told_of_pay
        )

    @property
    def lasting_tokenizer(self) -> NearestNeighborTokenizer | None:
        """The tokenizer, if the tokens of stored frames are kept; else None.

        They are if its codes never change and a frame is one observation. A frame is sampled many times, and looking
        its codes up each time takes a fifth of an iteration on Craftax.
        """
        if not self.config.world_model.enabled or self.spec.two_player:
            return None
        return self.tokenizer if isinstance(self.tokenizer, NearestNeighborTokenizer) else None

    @property
    def kept_state(self) -> State:
        """Shapes of one environment's state, if the replay buffer keeps states; else None."""
        if self.config.imagination.world != "game":
            return None
        state_B, _ = jax.eval_shape(self.batched.reset, jax.random.key(0))
        return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), state_B)
