"""The only rollout (Algorithm 4): a policy plays in the real world or in a dream, for one player or two."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from suite.interface.environment import BatchedEnvironment, State, TimeStep
from suite.interface.turns import CHANCE, choose_event
from suite.policy.actor_critic import mask_logits
from suite.policy.ppo import TargetStatistics, Trajectory


@struct.dataclass
class Recent:
    """The last M events before a rollout, to refresh the memory on.

    Attributes:
      observation_MB: uint8 frames, oldest first.
      first_MB: bool; the frame opens an episode.
      hidden_BH: memory before the oldest of them.
      acting_MB: bool, our turns; None for single-agent tasks.
    """

    observation_MB: jax.Array
    first_MB: jax.Array
    hidden_BH: jax.Array
    acting_MB: jax.Array | None = None


@struct.dataclass
class RolloutState:
    """Everything that a rollout carries on to the next one.

    Attributes:
      state: the environments' own state.
      time_step: what the policy acts on next.
      hidden_BH: the policy's memory before it sees that.
      recent: the M events before.
      return_B: float32 reward so far in the running episodes.
      length_B: int32 events so far in the running episodes, chance's included.
    """

    state: State
    time_step: TimeStep
    hidden_BH: jax.Array
    recent: Recent
    return_B: jax.Array
    length_B: jax.Array


@struct.dataclass
class EpisodeLog:
    """At every step [T, B], the running episode's totals; an episode's final ones stand where `ended_TB`.

    `counts_TB`: bool; the step counts towards the budget: all but chance's events (note 32).
    """

    counts_TB: jax.Array
    ended_TB: jax.Array
    return_TB: jax.Array
    length_TB: jax.Array
    statistics_TB: dict[str, jax.Array]


def start(policy: Any, environment: BatchedEnvironment, key: jax.Array, burn_in: int) -> RolloutState:
    """The state of a rollout at the first frame of B fresh episodes; the policy remembers nothing.

    The `burn_in` recent frames do not exist yet: their zeros never count, because `first` clears the memory.
    """
    state, time_step = environment.reset(key)
    batch = environment.num_envs
    hidden_BH = policy.initial_hidden(batch)
    recent = Recent(
        observation_MB=jnp.zeros((burn_in, *time_step.observation.shape), time_step.observation.dtype),
        first_MB=jnp.zeros((burn_in, batch), bool),
        hidden_BH=hidden_BH,
        acting_MB=None if time_step.turn is None else jnp.zeros((burn_in, batch), bool),
    )
    return RolloutState(
        state=state,
        time_step=time_step,
        hidden_BH=hidden_BH,
        recent=recent,
        return_B=jnp.zeros(batch, jnp.float32),
        length_B=jnp.zeros(batch, jnp.int32),
    )


def refresh(policy: Any, rollout_state: RolloutState, *, carried: bool) -> RolloutState:
    """Burn-in: recomputes the memory over the recent events with today's parameters (Algorithm 4, note 12).

    Args:
      policy: the actor-critic.
      rollout_state: whose memory to refresh.
      carried: start from the memory that preceded those events, rather than from zero.
    """
    recent = rollout_state.recent
    if recent.first_MB.shape[0] == 0:
        return rollout_state
    hidden_BH = recent.hidden_BH if carried else jnp.zeros_like(recent.hidden_BH)
    hidden_BH = policy.advance(recent.observation_MB, recent.first_MB, hidden_BH, recent.acting_MB)
    return dataclasses.replace(rollout_state, hidden_BH=hidden_BH)


def rollout(
    key: jax.Array,
    policy: Any,
    targets: TargetStatistics,
    environment: BatchedEnvironment,
    rollout_state: RolloutState,
    length: int,
    keep_states: bool = False,
) -> tuple[RolloutState, Trajectory, EpisodeLog]:
    """`length` events in each of B environments.

    Args:
      key: for actions, other players and the environment.
      policy: the actor-critic; its values are standardized, `targets` brings them back to reward units.
      targets: value statistics.
      environment: the real environments or a dream.
      rollout_state: where to go on from; its memory already refreshed.
      length: T.
      keep_states: put the environments' own states into the trajectory, beside each frame.

    Returns:
      the state after the last event, the trajectory [T, B] for PPO, and the episodes' totals.
    """

    def value_after(observation_B, hidden_BH):
        """Raw value of frames that follow the memory `hidden_BH` within their episodes; float32 [B]."""
        not_first_1B = jnp.zeros((1, observation_B.shape[0]), bool)
        output, _ = policy(observation_B[None], not_first_1B, hidden_BH)
        return targets.denormalize(output.value_TB[0])

    def event(rollout_state: RolloutState, key: jax.Array):
        act_key, turn_key, step_key = jax.random.split(key, 3)
        now, turn = rollout_state.time_step, rollout_state.time_step.turn
        acting_1B = None if turn is None else turn.ours[None]
        output, hidden_BH = policy(now.observation[None], now.first[None], rollout_state.hidden_BH, acting_1B)
        logits_BA = mask_logits(output.logits_TBA[0], None if turn is None else turn.legal_A)
        action_B = jax.random.categorical(act_key, logits_BA).astype(jnp.int32)
        log_probability_B = jnp.take_along_axis(jax.nn.log_softmax(logits_BA), action_B[:, None], axis=1)[:, 0]
        event_B = action_B if turn is None else choose_event(turn_key, turn, action_B)
        state, after = environment.step(step_key, rollout_state.state, event_B)
        # A time limit is not an end: the frame it cut off at still has a value. Rare, hence the conditional.
        truncation_value_B = jax.lax.cond(
            after.truncated.any(),
            lambda: jnp.where(after.truncated, value_after(after.final_observation, hidden_BH), 0.0),
            lambda: jnp.zeros_like(after.reward),
        )
        ended_B = after.terminated | after.truncated
        return_B, length_B = rollout_state.return_B + after.reward, rollout_state.length_B + 1
        step = Trajectory(
            observation_TB=now.observation,
            action_TB=event_B,
            reward_TB=after.reward,
            terminated_TB=after.terminated,
            truncated_TB=after.truncated,
            first_TB=now.first,
            log_probability_TB=log_probability_B,
            value_TB=targets.denormalize(output.value_TB[0]),
            hidden_BH=rollout_state.hidden_BH,
            last_value_B=jnp.zeros_like(after.reward),
            truncation_value_TB=truncation_value_B,
            turn_TB=turn,
            state_TB=rollout_state.state if keep_states else None,
        )
        counts_B = jnp.ones_like(ended_B) if turn is None else turn.player != CHANCE
        log = EpisodeLog(counts_B, ended_B, return_B, length_B, after.statistics)
        rollout_state = dataclasses.replace(
            rollout_state,
            state=state,
            time_step=after,
            hidden_BH=hidden_BH,
            return_B=jnp.where(ended_B, 0.0, return_B),
            length_B=jnp.where(ended_B, 0, length_B),
        )
        return rollout_state, (step, log)

    start_recent = rollout_state.recent
    rollout_state, (steps, log) = jax.lax.scan(event, rollout_state, jax.random.split(key, length))
    memory_TBH = steps.hidden_BH  # before each step; PPO needs the first, burn-in the one M steps ago
    last, _ = policy(
        rollout_state.time_step.observation[None], rollout_state.time_step.first[None], rollout_state.hidden_BH
    )
    trajectory = dataclasses.replace(
        steps,
        hidden_BH=memory_TBH[0],
        last_value_B=targets.denormalize(last.value_TB[0]),
        last_ours_B=None if rollout_state.time_step.turn is None else rollout_state.time_step.turn.ours,
    )
    if burn_in := start_recent.first_MB.shape[0]:
        since = length - burn_in  # not negative: suite.configuration.schema sees to it
        recent = Recent(
            observation_MB=trajectory.observation_TB[since:],
            first_MB=trajectory.first_TB[since:],
            hidden_BH=memory_TBH[since],
            acting_MB=None if trajectory.turn_TB is None else trajectory.turn_TB.ours[since:],
        )
        rollout_state = dataclasses.replace(rollout_state, recent=recent)
    return rollout_state, trajectory, log
