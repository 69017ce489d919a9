"""The agent (`Agent`): each phase of an iteration of Algorithm 1 as a compiled function.

Each phase is one compiled function over donated state, with its loop inside; only metrics return to the host. The
state is one pytree of arrays, so that several seeds can become its leading axis (`suite.agent.seeds`).
`suite.agent.algorithm` runs the phases in their order.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx

from suite.agent import rollout as play
from suite.agent.dreams import Dreaming
from suite.agent.replay import Eventful, ReplayState
from suite.agent.seeds import split
from suite.agent.state import TrainState, laid_out
from suite.configuration.schema import Config
from suite.interface.environment import Environment
from suite.interface.tokens import TokenizerState, encode_frame
from suite.interface.turns import stream_action
from suite.policy import ppo
from suite.runtime import layout
from suite.tokenizers.nearest_neighbor import NearestNeighborState
from suite.world_model import training as world_model_training
from suite.world_model.history import History, ages_of
from suite.world_model.sequences import Sequences

Metrics = dict[str, jax.Array]
IMAGINATION_METRICS = (*ppo.METRICS, "reward_per_step", "termination_rate")


def _compiled(donate: int | tuple[()] = ()) -> Callable[[Callable[..., Any]], Any]:
    """Compiles a method, which may donate the argument of this number; what it returns is laid out."""

    def compiled(method: Callable[..., Any]) -> Any:
        @functools.wraps(method)
        def phase(agent: Agent, *arguments: Any) -> Any:
            of_one = functools.partial(method, agent)
            return laid_out((layout.of_each_seed(of_one) if agent.seeds > 1 else of_one)(*arguments))

        return jax.jit(phase, static_argnums=0, donate_argnums=donate)

    return compiled


class Agent(Dreaming):
    """One agent on one task: its parts, how it dreams, and the compiled phases.

    With several `seeds`, so many runs of it that go on together: all that phases take and return has a leading axis S.
    """

    def __init__(self, config: Config, environment: Environment, seeds: int = 1):
        """As `Parts`; and how many runs go on together."""
        super().__init__(config, environment)
        self.seeds = seeds

    @property
    def metric_names(self) -> list[str]:
        """Names of all metrics that iterations may have: `<phase>/<metric>`."""
        phases: dict[str, tuple[str, ...]] = {}
        if self.config.ppo.learn_from_real:
            phases["learn"] = ppo.METRICS
        if self.config.world_model.enabled:
            phases["tokenizer"] = self.tokenizer.metrics
            phases["world_model"] = world_model_training.metrics_of(self.tokens, self.config.world_model)
            if self.config.imagination.trust:
                phases["world_model"] += ("reward_known",)
        if self.config.dreams:
            phases["imagine"] = IMAGINATION_METRICS
        return [f"{phase}/{metric}" for phase, metrics in phases.items() for metric in metrics]

    def init(self, key: jax.Array) -> TrainState:
        """A fresh agent in fresh environments: two programs, since `start` is worth compiling only once.

        Args:
          key: of its randomness; of several seeds one for each, [S].
        """
        policy_key, rollout_key, tokenizer_key, model_key = split(key, 4)
        untrained = self._untrained(policy_key, tokenizer_key, model_key)
        return TrainState(rollout=self.start(untrained["policy"].acting, rollout_key), **untrained)

    @_compiled()
    def _untrained(self, policy_key: jax.Array, tokenizer_key: jax.Array, model_key: jax.Array) -> dict[str, Any]:
        """What a fresh `TrainState` holds besides its rollout."""
        params = nnx.state(self._new_policy(nnx.Rngs(policy_key)))
        fresh = {"policy": ppo.PolicyTrainState.create(self.config.ppo, self.policy_optimizer, params)}
        if self.config.dreams:
            fresh["replay"] = self.new_replay()
        if not self.config.world_model.enabled:
            return fresh
        model_params = nnx.state(self._new_world_model(nnx.Rngs(model_key)))
        model_state = world_model_training.WorldModelTrainState.create(
            self.config.world_model, self.world_model_optimizer, model_params
        )
        if self.config.imagination.trust_window:
            model_state = dataclasses.replace(model_state, measured=jnp.zeros(1 + len(self.tokens.reward_classes)))
        return fresh | {"tokenizer": self.tokenizer.init(tokenizer_key), "world_model": model_state}

    @_compiled()
    def start(self, policy_state: ppo.PolicyTrainState, key: jax.Array) -> play.RolloutState:
        """The start of a rollout in fresh environments; the policy remembers nothing."""
        return play.start(self._policy(policy_state), self.batched, key, self.config.environment.burn_in)

    @_compiled(donate=2)
    def collect(
        self, policy_state: ppo.PolicyTrainState, rollout_state: play.RolloutState, key: jax.Array
    ) -> tuple[play.RolloutState, ppo.Trajectory, play.EpisodeLog]:
        """Step 1: T_env real steps in each of N_env environments."""
        config, policy = self.config.environment, self._policy(policy_state)
        rollout_state = play.refresh(policy, rollout_state, carried=config.burn_in_start == "carried")
        keep = self.config.imagination.world == "game"
        return play.rollout(key, policy, policy_state.targets, self.batched, rollout_state, config.rollout_length, keep)

    @_compiled(donate=1)
    def remember(self, replay: ReplayState, trajectory: ppo.Trajectory) -> ReplayState:
        """Step 1, second line: the real steps enter the replay buffer."""
        return self.replay.add(replay, trajectory, self.spec.pays if self.told_of_pay else None)

    @_compiled(donate=1)
    def learn(
        self, policy_state: ppo.PolicyTrainState, trajectory: ppo.Trajectory, steps: jax.Array
    ) -> tuple[ppo.PolicyTrainState, Metrics]:
        """Step 2: PPO on the real steps. `steps`: float32 [2], taken before and after them."""
        config = self.config.ppo
        return ppo.update(
            config,
            self.policy_optimizer,
            self.policy_graph,
            policy_state,
            trajectory,
            epochs=config.epochs,
            minibatches=config.minibatches,
            entropy_coefficient=config.entropy_coefficient,
            remaining=self.learning_rates_left(steps[0], steps[1]),
        )

    @_compiled(donate=1)
    def update_tokenizer(
        self, tokenizer: TokenizerState, replay: ReplayState, key: jax.Array
    ) -> tuple[TokenizerState, Metrics]:
        """Step 3, first half (Algorithm 5): the tokenizer learns from replayed frames."""
        config = self.config.world_model

        def update(tokenizer, key):
            frames = self.replay.sample(replay, key, config.sequences // config.minibatches, config.sequence_length)
            shape = self.spec.observation.shape
            return self.tokenizer.update(tokenizer, frames.observation.reshape(-1, *shape))

        keys = jax.random.split(key, self.config.tokenizer.updates * config.minibatches)
        tokenizer, metrics = jax.lax.scan(update, tokenizer, keys)
        return tokenizer, {name: values[-1] for name, values in metrics.items()}

    @_compiled(donate=1)
    def code(self, replay: ReplayState, tokenizer: NearestNeighborState, known: jax.Array) -> ReplayState:
        """Brings the tokens of stored frames up to date, where they are kept.

        Args:
          replay: the buffer, an iteration's new frames in it.
          tokenizer: after it has learned.
          known: int32 scalar; how many codes it had before that.
        """
        assert self.lasting_tokenizer is not None
        return self.replay.code(
            replay, self.lasting_tokenizer, tokenizer, known, self.config.environment.rollout_length
        )

    @_compiled(donate=1)
    def update_world_model(
        self,
        model_state: world_model_training.WorldModelTrainState,
        tokenizer: TokenizerState,
        replay: ReplayState,
        key: jax.Array,
    ) -> tuple[world_model_training.WorldModelTrainState, Metrics]:
        """Step 3, second half (Algorithm 5): the transformer learns from replayed sequences of T_WM + 1 frames."""
        config, plan = self.config.world_model, self.config.imagination
        if config.patch_contents and self.tokens.content_size:
            model_state = model_state.with_contents(self.tokenizer.contents(tokenizer))
        if model_state.measured is not None:
            new = self.measure_rewards(model_state.dreaming, tokenizer, replay, jax.random.fold_in(key, 0))
            measured = model_state.measured + (new - model_state.measured) / plan.trust_window
            model_state = dataclasses.replace(model_state, measured=measured)

        eventful = None
        if config.event_share:
            length = self.ages + config.sequence_length + 1
            eventful = self.replay.eventful(replay, self.spec.pays, length, skipped=self.ages)

        def update(model_state, key):
            sample_key, dropout_key = jax.random.split(key)
            sequences = self.replayed_sequences(tokenizer, replay, sample_key, eventful=eventful)
            model_state, metrics = world_model_training.update(
                config,
                self.world_model_optimizer,
                self.world_model_graph,
                self.tokens,
                model_state,
                sequences,
                dropout_key,
            )
            return model_state, (metrics, sequences.reward_BT if plan.trust else None)

        keys = jax.random.split(key, config.updates * config.minibatches)
        model_state, (metrics, reward_NBT) = jax.lax.scan(update, model_state, keys)
        metrics = jax.tree.map(jnp.mean, metrics)
        if plan.trust:
            loss = metrics["reward_loss"]
            frequency_R = world_model_training.reward_frequency(self.tokens, reward_NBT)
            if model_state.measured is not None:
                # Averages that began with zeros are all too small by the same factor, which is what frequencies lack.
                loss, frequency_R = model_state.measured[0], model_state.measured[1:]
                loss, frequency_R = loss / frequency_R.sum(), frequency_R / frequency_R.sum()
            metrics["reward_known"] = world_model_training.known_share(loss, frequency_R)
        return model_state, metrics

    def replayed_sequences(
        self,
        tokenizer: TokenizerState,
        replay: ReplayState,
        key: jax.Array,
        recent: int = 0,
        eventful: Eventful | None = None,
    ) -> Sequences:
        """A minibatch of replayed sequences of T_WM + 1 frames; with `recent`, of those that ended so lately."""
        config = self.config.world_model
        length = self.ages + config.sequence_length + 1
        number, weight_B = config.sequences // config.minibatches, None
        if eventful is None:
            batch = self.replay.sample(replay, key, number, length, recent)
        else:
            batch, weight_B = self.replay.sample_eventful(replay, key, number, length, eventful, config.event_share)
        coded = batch.coded
        tokens_BTL = (
            encode_frame(self.tokenizer, tokenizer, batch.observation, batch.turn) if coded is None else coded.tokens
        )
        age_BTL = ages_of(tokens_BTL, self.ages) if self.ages else None
        history_BT = History(age_BTL, batch.paid)
        batch, tokens_BTL, history_BT = jax.tree.map(lambda x: x[:, self.ages :], (batch, tokens_BTL, history_BT))
        action_BT = batch.action if batch.turn is None else stream_action(batch.turn, batch.action)
        return Sequences(
            tokens_BTL=tokens_BTL,
            action_BT=action_BT[:, :-1],
            reward_BT=batch.reward[:, :-1],
            terminated_BT=batch.terminated[:, :-1],
            ended_BT=batch.first[:, 1:],
            turn_BT=batch.turn,
            history_BT=jax.tree.map(lambda x: x[:, :-1], history_BT),
            weight_B=weight_B,
        )

    def measure_rewards(self, params: Any, tokenizer: TokenizerState, replay: ReplayState, key: jax.Array) -> jax.Array:
        """Float32 [1 + R]: a model's loss of rewards on the newest iteration's steps, and each class's frequency.

        Sequences are drawn among those that lie entirely within the newest iteration, and are as many as cover it once.
        """
        model, config = nnx.merge(self.world_model_graph, params), self.config.world_model
        newest = self.config.environment.rollout_length - config.sequence_length

        def measure(key):
            new = self.replayed_sequences(tokenizer, replay, key, newest)
            _, metrics = world_model_training.losses(model, new, config, self.tokens)
            frequency_R = world_model_training.reward_frequency(self.tokens, new.reward_BT)
            return jnp.concatenate([metrics["reward_loss"][None], frequency_R])

        steps = config.sequences // config.minibatches * config.sequence_length
        keys = jax.random.split(key, math.ceil(self.config.steps_per_iteration / steps))
        return jax.lax.map(measure, keys).mean(0)

    @_compiled(donate=1)
    def imagine(
        self,
        policy_state: ppo.PolicyTrainState,
        world_model: nnx.State | None,
        tokenizer: TokenizerState | None,
        replay: ReplayState,
        key: jax.Array,
        updates: jax.Array,
        steps: jax.Array,
    ) -> tuple[ppo.PolicyTrainState, Metrics]:
        """Step 4: `updates` times (a traced number, so that annealing never recompiles), dream and learn from it.

        After `steps` real steps (float32 scalar), on which the learning rate depends if it is annealed.
        An agent that dreams in the true game has neither `world_model` nor `tokenizer`.
        """
        model = None if world_model is None else nnx.merge(self.world_model_graph, world_model)
        remaining = self.learning_rates_left(steps, steps)

        def update(i, carry):
            policy_state, total = carry
            trajectory = self.dream(policy_state, model, tokenizer, replay, jax.random.fold_in(key, i))
            policy_state, metrics = self.learn_from_dream(policy_state, trajectory, remaining)
            metrics |= {
                "reward_per_step": trajectory.reward_TB.mean(),
                "termination_rate": trajectory.terminated_TB.mean(dtype=jnp.float32),
            }
            return policy_state, jax.tree.map(jnp.add, total, metrics)

        zeros = dict.fromkeys(IMAGINATION_METRICS, jnp.zeros(()))
        policy_state, total = jax.lax.fori_loop(0, updates, update, (policy_state, zeros))
        return policy_state, jax.tree.map(lambda x: x / updates.astype(jnp.float32), total)
