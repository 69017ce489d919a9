"""The agent (`Agent`): its parts, and each phase of an iteration of Algorithm 1 as a compiled function.

Each phase is one compiled function over donated state, with its loop inside; only metrics return to the host. The
state is one pytree of arrays, so that several seeds can become its leading axis. `suite.agent.algorithm` runs
the phases in their order.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx

from suite.agent import rollout as play
from suite.agent.replay import Eventful, Experience, Replay, ReplayState
from suite.agent.state import TrainState
from suite.configuration.schema import Config
from suite.interface.batching import Batched
from suite.interface.environment import BatchedEnvironment, Environment, State
from suite.interface.host import HostEnvironment
from suite.interface.tokens import TokenizerState, encode_frame
from suite.interface.turns import Turn, stream_action
from suite.policy import ppo
from suite.policy.actor_critic import make_policy
from suite.runtime.errors import UserError
from suite.tokenizers.nearest_neighbor import NearestNeighborState, NearestNeighborTokenizer
from suite.tokenizers.stream import build_tokenizer
from suite.world_model import training as world_model_training
from suite.world_model.history import History, ages_of
from suite.world_model.imagination import Dream, Past
from suite.world_model.sequences import Sequences
from suite.world_model.transformer import WorldModel

Metrics = dict[str, jax.Array]
IMAGINATION_METRICS = (*ppo.METRICS, "reward_per_step", "termination_rate")


class Agent:
    """One agent on one task: the static parts (networks' structure, optimizers), and the compiled phases."""

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

    @property
    def learns_from_real(self) -> bool:
        """Whether real play teaches its policy."""
        return self.config.ppo.learn_from_real and self.config.policy.kind != "uniform"

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

    def _new_policy(self, rngs: nnx.Rngs) -> Any:
        return make_policy(self.config.policy, self.spec.observation, self.spec.num_actions, rngs)

    def _new_world_model(self, rngs: nnx.Rngs) -> WorldModel:
        return WorldModel(self.config.world_model, self.tokens, self.grid, rngs)

    def _policy(self, policy_state: ppo.PolicyTrainState) -> Any:
        return nnx.merge(self.policy_graph, policy_state.params)

    def init(self, key: jax.Array) -> TrainState:
        """A fresh agent in fresh environments: two programs, since `start` is worth compiling only once."""
        policy_key, rollout_key, tokenizer_key, model_key = jax.random.split(key, 4)
        untrained = self._untrained(policy_key, tokenizer_key, model_key)
        return TrainState(rollout=self.start(untrained["policy"].acting, rollout_key), **untrained)

    @functools.partial(jax.jit, static_argnums=0)
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

    @functools.partial(jax.jit, static_argnums=0)
    def start(self, policy_state: ppo.PolicyTrainState, key: jax.Array) -> play.RolloutState:
        """The start of a rollout in fresh environments; the policy remembers nothing."""
        return play.start(self._policy(policy_state), self.batched, key, self.config.environment.burn_in)

    @functools.partial(jax.jit, static_argnums=0, donate_argnums=2)
    def collect(
        self, policy_state: ppo.PolicyTrainState, rollout_state: play.RolloutState, key: jax.Array
    ) -> tuple[play.RolloutState, ppo.Trajectory, play.EpisodeLog]:
        """Step 1: T_env real steps in each of N_env environments."""
        config, policy = self.config.environment, self._policy(policy_state)
        rollout_state = play.refresh(policy, rollout_state, carried=config.burn_in_start == "carried")
        keep = self.config.imagination.world == "game"
        return play.rollout(key, policy, policy_state.targets, self.batched, rollout_state, config.rollout_length, keep)

    @functools.partial(jax.jit, static_argnums=0, donate_argnums=1)
    def remember(self, replay: ReplayState, trajectory: ppo.Trajectory) -> ReplayState:
        """Step 1, second line: the real steps enter the replay buffer."""
        return self.replay.add(replay, trajectory, self.spec.pays if self.told_of_pay else None)

    @functools.partial(jax.jit, static_argnums=0, donate_argnums=1)
    def learn(
        self, policy_state: ppo.PolicyTrainState, trajectory: ppo.Trajectory, steps: jax.Array
    ) -> tuple[ppo.PolicyTrainState, Metrics]:
        """Step 2: PPO on the real steps. `steps`: float32 [2], taken before and after them."""
        config = self.config.ppo
        left = jnp.maximum(1 - steps / self.config.total_steps, 0.0)
        return ppo.update(
            config,
            self.policy_optimizer,
            self.policy_graph,
            policy_state,
            trajectory,
            epochs=config.epochs,
            minibatches=config.minibatches,
            entropy_coefficient=config.entropy_coefficient,
            remaining=(left[0], left[1]) if config.anneal_learning_rate else None,
        )

    @functools.partial(jax.jit, static_argnums=0, donate_argnums=1)
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

    @functools.partial(jax.jit, static_argnums=0, donate_argnums=1)
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

    @functools.partial(jax.jit, static_argnums=0, donate_argnums=1)
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

    @functools.partial(jax.jit, static_argnums=0, donate_argnums=1)
    def imagine(
        self,
        policy_state: ppo.PolicyTrainState,
        world_model: nnx.State | None,
        tokenizer: TokenizerState | None,
        replay: ReplayState,
        key: jax.Array,
        updates: jax.Array,
    ) -> tuple[ppo.PolicyTrainState, Metrics]:
        """Step 4: `updates` times (a traced number, so that annealing never recompiles), dream and learn from it.

        An agent that dreams in the true game has neither `world_model` nor `tokenizer`.
        """
        model = None if world_model is None else nnx.merge(self.world_model_graph, world_model)

        def update(i, carry):
            policy_state, total = carry
            trajectory = self.dream(policy_state, model, tokenizer, replay, jax.random.fold_in(key, i))
            policy_state, metrics = self.learn_from_dream(policy_state, trajectory)
            metrics |= {
                "reward_per_step": trajectory.reward_TB.mean(),
                "termination_rate": trajectory.terminated_TB.mean(dtype=jnp.float32),
            }
            return policy_state, jax.tree.map(jnp.add, total, metrics)

        zeros = dict.fromkeys(IMAGINATION_METRICS, jnp.zeros(()))
        policy_state, total = jax.lax.fori_loop(0, updates, update, (policy_state, zeros))
        return policy_state, jax.tree.map(lambda x: x / updates.astype(jnp.float32), total)

    def dream(
        self,
        policy_state: ppo.PolicyTrainState,
        model: WorldModel | None,
        tokenizer: TokenizerState | None,
        replay: ReplayState,
        key: jax.Array,
    ) -> ppo.Trajectory:
        """One imagined rollout from replayed frames, the memory refreshed on the M frames before each (note 12)."""
        plan, policy, memory = self.config.imagination, self._policy(policy_state), self.config.environment.burn_in
        sample_key, start_key, rollout_key = jax.random.split(key, 3)
        before = max(memory, self.past)
        past = self.replay.sample(replay, sample_key, plan.num_envs, before + 1, plan.recent)
        past = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), past)
        dream = self._dreamt_world(model, tokenizer, past)
        rollout_state = play.start(policy, dream, start_key, 0)
        rollout_state = dataclasses.replace(
            rollout_state,
            time_step=dataclasses.replace(rollout_state.time_step, first=past.first[-1]),
            recent=play.Recent(
                past.observation[before - memory : -1],
                past.first[before - memory : -1],
                rollout_state.hidden_BH,
                None if past.turn is None else past.turn.ours[before - memory : -1],
            ),
        )
        rollout_state = play.refresh(policy, rollout_state, carried=False)
        _, trajectory, _ = play.rollout(rollout_key, policy, policy_state.targets, dream, rollout_state, plan.horizon)
        return trajectory

    def _dreamt_world(
        self, model: WorldModel | None, tokenizer: TokenizerState | None, past: Experience
    ) -> BatchedEnvironment:
        """The world model, or the true game, at the last of the replayed steps `past` (time-major)."""
        plan = self.config.imagination
        start = jax.tree.map(lambda x: x[-1], past)
        if model is None:
            game = Batched(self.batched.environment, plan.num_envs)
            return game.resumed(start.state, start.observation, start.first, start.turn)
        before = jax.tree.map(lambda x: x[len(past.first) - 1 - self.past : -1], past)
        past_PBL, start_BL = (None if x.coded is None else x.coded.tokens for x in (before, start))
        known = Past(before.observation, before.action, before.turn, past_PBL, before.paid) if self.past else None
        return self.dream_from(
            model, tokenizer, start.observation, start.turn, plan.horizon, known, start_BL, start.paid
        )

    def dream_from(
        self,
        model: WorldModel,
        tokenizer: TokenizerState,
        observation_BO: jax.Array,
        turn_B: Turn | None,
        horizon: int,
        past: Past | None = None,
        tokens_BL: jax.Array | None = None,
        paid_BA: jax.Array | None = None,
    ) -> Dream:
        """The world model as an environment that starts at these frames (Algorithm 4).

        Args:
          model, tokenizer: the world model with its parameters, and its tokenizer's state.
          observation_BO: the frames.
          turn_B: whose turn it is there, in a game of two players.
          horizon: steps that it can take.
          past: the `self.past` real frames before these, if there are some to be told of.
          tokens_BL: the frames' tokens, if they are known.
          paid_BA: how often each action had earned a reward there, for a model that is told; None: nothing was paid.
        """
        plan = self.config.imagination
        return Dream(
            model,
            self.tokenizer,
            tokenizer,
            self.spec,
            self.tokens,
            horizon,
            observation_BO,
            turn_B,
            past=past,
            start_tokens_BL=tokens_BL,
            start_paid_BA=paid_BA,
            context=plan.context,
            min_p=plan.min_p,
        )

    def learn_from_dream(
        self, policy_state: ppo.PolicyTrainState, trajectory: ppo.Trajectory
    ) -> tuple[ppo.PolicyTrainState, Metrics]:
        """PPO on one imagined trajectory."""
        plan = self.config.imagination
        return ppo.update(
            self.config.ppo,
            self.policy_optimizer,
            self.policy_graph,
            policy_state,
            trajectory,
            epochs=plan.epochs,
            minibatches=plan.minibatches,
            entropy_coefficient=plan.entropy_coefficient,
        )
