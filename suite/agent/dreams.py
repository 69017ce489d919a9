"""One imagined rollout, and what the policy learns from it (Algorithm 4)."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from suite.agent import rollout as play
from suite.agent.parts import Parts
from suite.agent.replay import Experience, ReplayState
from suite.interface.batching import Batched
from suite.interface.environment import BatchedEnvironment
from suite.interface.tokens import TokenizerState
from suite.interface.turns import Turn
from suite.policy import ppo
from suite.world_model.imagination import Dream, Past
from suite.world_model.transformer import WorldModel


class Dreaming(Parts):
    """How an agent dreams, in its world model or in the true game. Nothing here is compiled by itself."""

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
        self,
        policy_state: ppo.PolicyTrainState,
        trajectory: ppo.Trajectory,
        remaining: tuple[jax.Array, jax.Array] | None = None,
    ) -> tuple[ppo.PolicyTrainState, dict[str, jax.Array]]:
        """PPO on one imagined trajectory; `remaining` as `suite.policy.ppo.update` has it."""
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
            remaining=remaining,
        )
