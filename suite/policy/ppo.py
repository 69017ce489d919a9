"""Proximal policy optimization on a batch of trajectories, real or imagined (Appendix A.1.2, Algorithm 3).

Shapes: T steps, B environments, A actions, H memory units. In two-player games a step is an event; only where
`acting_TB` is the decision ours. Other events pass their rewards back to our decision before them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import nnx, struct

from suite.configuration.schema import PPOConfig
from suite.interface.turns import Turn
from suite.nn.masked import masked_mean
from suite.nn.optimizer import clipped
from suite.policy.actor_critic import PolicyOutput, log_probability, mask_logits
from suite.runtime import layout

# What `update` reports, in the order of tables and files.
METRICS: tuple[str, ...] = (
    "policy_loss",
    "value_loss",
    "entropy",
    "approx_kl",
    "clip_fraction",
    "gradient_norm",
    "explained_variance",
    "target_mean",
    "target_std",
)


@struct.dataclass
class Trajectory:
    """T steps of B environments, as they were played.

    Attributes:
      observation_TB: uint8 [T, B, ...]; what was acted on.
      action_TB: int32.
      reward_TB: float32, of the step taken at t.
      terminated_TB, truncated_TB: bool; the step taken at t ended the episode.
      first_TB: bool; `observation_TB[t]` opens an episode.
      log_probability_TB: float32, of the action when it was taken.
      value_TB: float32, of the observation, in units of reward.
      hidden_BH: float32, the memory before t = 0.
      last_value_B: float32, of the observation after the last step, in units of reward.
      truncation_value_TB: float32, of the last observation of a truncated episode, in units of reward; else 0.
      turn_TB: whose turns they were; None for single-agent tasks: all are ours, and every action is legal.
      last_ours_B: bool; the observation after the last step is ours to act on. None for single-agent tasks.
      state_TB: the environments' own states at each step, where they were asked for; PPO does not look at them.
    """

    observation_TB: jax.Array
    action_TB: jax.Array
    reward_TB: jax.Array
    terminated_TB: jax.Array
    truncated_TB: jax.Array
    first_TB: jax.Array
    log_probability_TB: jax.Array
    value_TB: jax.Array
    hidden_BH: jax.Array
    last_value_B: jax.Array
    truncation_value_TB: jax.Array
    turn_TB: Turn | None = None
    last_ours_B: jax.Array | None = None
    state_TB: Any = None

    @property
    def acting_TB(self) -> jax.Array | None:
        """bool; our decisions. None: all are."""
        return None if self.turn_TB is None else self.turn_TB.ours

    @property
    def legal_TBA(self) -> jax.Array | None:
        """bool; None: every action is legal."""
        return None if self.turn_TB is None else self.turn_TB.legal_A


def generalized_advantages(
    trajectory: Trajectory, discount: float, gae_lambda: float
) -> tuple[jax.Array, jax.Array | None]:
    """Generalized advantage estimates [T, B] (Appendix A.1.2), and where they are known (bool; None: everywhere).

    `discount` and `gae_lambda` count our decisions, not events. Termination is worth nothing beyond; a truncation
    has the value of its last observation beyond, and the trace ends at both. Unknown, and 0, are events that are not
    ours, and our last decision if neither the episode's end nor a further turn of ours follows it: values are learned
    at our turns only, so none is to be had for what comes after.
    """
    acting_TB = trajectory.acting_TB

    def step(carry, inputs):
        next_value_B, next_advantage_B, pending_B, known_B = carry
        reward_B, value_B, terminated_B, truncated_B, truncation_value_B, acting_B = inputs
        ended_B = terminated_B | truncated_B
        beyond_B = jnp.where(terminated_B, 0.0, truncation_value_B)
        next_value_B = jnp.where(ended_B, beyond_B, next_value_B)
        next_advantage_B = jnp.where(ended_B, 0.0, next_advantage_B)
        if acting_B is not None:
            reward_B = reward_B + jnp.where(ended_B, 0.0, pending_B)
            known_B = known_B | ended_B
        error_B = reward_B + discount * next_value_B - value_B
        advantage_B = error_B + discount * gae_lambda * next_advantage_B
        if acting_B is None:
            return (value_B, advantage_B, None, None), (advantage_B, None)
        advantage_B = jnp.where(known_B, advantage_B, 0.0)
        ours = (value_B, advantage_B, jnp.zeros_like(reward_B), jnp.ones_like(known_B))
        theirs = (next_value_B, next_advantage_B, reward_B, known_B)
        carry = jax.tree.map(lambda a, b: jnp.where(acting_B, a, b), ours, theirs)
        return carry, (jnp.where(acting_B, advantage_B, 0.0), known_B & acting_B)

    zeros_B = jnp.zeros_like(trajectory.last_value_B)
    inputs = (
        trajectory.reward_TB,
        trajectory.value_TB,
        trajectory.terminated_TB,
        trajectory.truncated_TB,
        trajectory.truncation_value_TB,
        acting_TB,
    )
    start = (trajectory.last_value_B, zeros_B, None if acting_TB is None else zeros_B, trajectory.last_ours_B)
    _, (advantage_TB, known_TB) = jax.lax.scan(step, start, inputs, reverse=True)
    return advantage_TB, known_TB


@struct.dataclass
class TargetStatistics:
    """Moving averages that standardize value targets (Algorithm 3, fidelity notes 8 and 9).

    `mean`, `spread` and `weight` (float32 scalars) all average from zero; dividing by `weight`, the average of ones,
    removes the bias towards zero. Before the first update the statistics are mean 0 and deviation 1.

    Attributes:
      spread: averages the standard deviation, or with `of_squares` the mean square (fidelity note 36).
      min_std: the floor of the standard deviation.
    """

    mean: jax.Array
    spread: jax.Array
    weight: jax.Array
    min_std: float = struct.field(pytree_node=False, default=0.1)
    of_squares: bool = struct.field(pytree_node=False, default=False)

    @classmethod
    def create(cls, min_std: float = 0.1, of_squares: bool = False) -> TargetStatistics:
        """Statistics of nothing yet."""
        zero = jnp.zeros((), jnp.float32)
        return cls(mean=zero, spread=zero, weight=zero, min_std=min_std, of_squares=of_squares)

    def update(self, targets: jax.Array, mask: jax.Array | None, decay: float) -> TargetStatistics:
        """Takes in the mean and standard deviation of `targets` where `mask`; a mask of nothing changes nothing."""
        mean, std, count = _moments(targets, mask)
        keep = jnp.where(count > 0, decay, 1.0)
        spread = jnp.square(std) + jnp.square(mean) if self.of_squares else std
        return dataclasses.replace(
            self,
            mean=keep * self.mean + (1.0 - keep) * mean,
            spread=keep * self.spread + (1.0 - keep) * spread,
            weight=keep * self.weight + (1.0 - keep),
        )

    def corrected(self) -> tuple[jax.Array, jax.Array]:
        """Mean and standard deviation in use."""
        seen = self.weight > 0
        weight = jnp.where(seen, self.weight, 1.0)
        mean, spread = self.mean / weight, self.spread / weight
        std = jnp.sqrt(jnp.maximum(spread - jnp.square(mean), 0.0)) if self.of_squares else spread
        return mean, jnp.where(seen, jnp.maximum(std, self.min_std), 1.0)

    def standardize(self, targets: jax.Array) -> jax.Array:
        """From units of reward to those that the value network predicts."""
        mean, std = self.corrected()
        return (targets - mean) / std

    def denormalize(self, value: jax.Array) -> jax.Array:
        """From the value network's units to those of reward."""
        mean, std = self.corrected()
        return value * std + mean


@struct.dataclass
class PolicyTrainState:
    """All that learning a policy carries along: parameters, optimizer state (None in `acting`), target statistics."""

    params: nnx.State
    optimizer: optax.OptState | None
    targets: TargetStatistics

    @classmethod
    def create(cls, ppo: PPOConfig, optimizer: optax.GradientTransformation, params: nnx.State) -> PolicyTrainState:
        """That of a policy that has learned nothing yet; `params` is the state of `nnx.split(policy)`."""
        return cls(
            params,
            optimizer.init(params),
            TargetStatistics.create(ppo.target_min_std, ppo.target_spread == "mean_square"),
        )

    @property
    def acting(self) -> PolicyTrainState:
        """What acting needs: without the optimizer, so that training and evaluation share one compiled program."""
        return dataclasses.replace(self, optimizer=None)


def make_optimizer(ppo: PPOConfig) -> optax.GradientTransformation:
    """Adam behind gradient clipping, at the full learning rate; `update` anneals it."""
    return clipped(optax.adam(ppo.learning_rate, eps=ppo.adam_eps), ppo.max_grad_norm)


def update(
    ppo: PPOConfig,
    optimizer: optax.GradientTransformation,
    graphdef: nnx.GraphDef,
    policy_state: PolicyTrainState,
    trajectory: Trajectory,
    *,
    epochs: int,
    minibatches: int,
    entropy_coefficient: float,
    remaining: tuple[jax.Array, jax.Array] | None = None,
) -> tuple[PolicyTrainState, dict[str, jax.Array]]:
    """Algorithm 3: `epochs` passes over `minibatches` contiguous groups of environments, unshuffled (note 9).

    With `remaining`, float32 shares of the budget that are left before and after these updates, the learning rate
    falls from the first to the second share of itself, linearly by minibatch (note 11).

    Each minibatch runs the network over all T steps again, from `trajectory.hidden_BH`. Returns the new state and
    the float32 scalars that `METRICS` names, those of the loss averaged over all minibatch updates. Raises
    ValueError if `minibatches` does not divide B.
    """
    environments = trajectory.hidden_BH.shape[0]
    if environments % minibatches:
        raise ValueError(f"{minibatches} minibatches do not divide {environments} environments")
    advantage_TB, known_TB = generalized_advantages(trajectory, ppo.discount, ppo.gae_lambda)
    mean, std, _ = _moments(advantage_TB, known_TB)
    batch = _Batch(
        observation_TB=trajectory.observation_TB,
        first_TB=trajectory.first_TB,
        action_TB=trajectory.action_TB,
        log_probability_TB=trajectory.log_probability_TB,
        advantage_TB=(advantage_TB - mean) / (std + 1e-8),
        target_TB=advantage_TB + trajectory.value_TB,
        acting_TB=trajectory.acting_TB,
        known_TB=known_TB,
        legal_TBA=trajectory.legal_TBA,
    )

    minibatch = _minibatches(batch, trajectory.hidden_BH, minibatches)

    def minibatch_update(policy_state: PolicyTrainState, inputs: tuple[jax.Array, jax.Array | None]):
        index, rate = inputs
        part, hidden_BH = minibatch(index)
        targets = policy_state.targets.update(part.target_TB, part.known_TB, ppo.target_decay)
        part = dataclasses.replace(part, target_TB=targets.standardize(part.target_TB))

        def loss_of(params: nnx.State):
            policy = nnx.merge(graphdef, params)
            output, _ = policy(part.observation_TB, part.first_TB, hidden_BH, part.acting_TB)
            return _loss(ppo, output, part, entropy_coefficient)

        gradients, metrics = jax.grad(loss_of, has_aux=True)(policy_state.params)
        metrics["gradient_norm"] = optax.tree.norm(gradients)
        with jax.numpy_dtype_promotion("standard"):  # Optax raises floats to integer powers
            changes, state = optimizer.update(gradients, policy_state.optimizer, policy_state.params)
        if rate is not None:
            changes = jax.tree.map(lambda change: rate * change, changes)
        return PolicyTrainState(optax.apply_updates(policy_state.params, changes), state, targets), metrics

    order = jnp.tile(jnp.arange(minibatches), epochs)
    rates = None if remaining is None else jnp.linspace(*remaining, len(order), endpoint=False)
    policy_state, metrics = jax.lax.scan(minibatch_update, policy_state, (order, rates))
    metrics = {name: value.mean() for name, value in metrics.items()}

    _, target_std, _ = _moments(batch.target_TB, known_TB)
    metrics["explained_variance"] = 1.0 - jnp.square(std) / (jnp.square(target_std) + 1e-8)
    metrics["target_mean"], metrics["target_std"] = policy_state.targets.corrected()
    return policy_state, metrics


@struct.dataclass
class _Batch:
    """What the loss needs of each step; `advantage_TB` is standardized, `target_TB` q = A + v.

    The memory advances where `acting_TB`; the loss is of where `known_TB`.
    """

    observation_TB: jax.Array
    first_TB: jax.Array
    action_TB: jax.Array
    log_probability_TB: jax.Array
    advantage_TB: jax.Array
    target_TB: jax.Array
    acting_TB: jax.Array | None
    known_TB: jax.Array | None
    legal_TBA: jax.Array | None


def _minibatches(batch: _Batch, hidden_BH: jax.Array, number: int) -> Callable[[jax.Array], tuple[_Batch, jax.Array]]:
    """What gives the minibatch of an index (int32): so many contiguous groups of environments.

    On one device a slice, made inside the loop, so that there is no second copy. A group may lie on one of many
    devices: there environments are moved once, before the loop, so that each device has an equal part of every group.
    """
    size = len(hidden_BH) // number
    if layout.devices() == 1:

        def sliced(index: jax.Array) -> tuple[_Batch, jax.Array]:
            start = index * size
            part = jax.tree.map(lambda x_TB: jax.lax.dynamic_slice_in_dim(x_TB, start, size, axis=1), batch)
            return part, jax.lax.dynamic_slice_in_dim(hidden_BH, start, size, axis=0)

        return sliced

    def grouped(tree: Any, axis: int) -> Any:
        groups = jax.tree.map(lambda x: x.reshape(*x.shape[:axis], number, size, *x.shape[axis + 1 :]), tree)
        return layout.split(groups, axis + 1)

    batch_TMB, hidden_MBH = grouped(batch, 1), grouped(hidden_BH, 0)

    def taken(index: jax.Array) -> tuple[_Batch, jax.Array]:
        part = jax.tree.map(lambda x_TMB: jax.lax.dynamic_index_in_dim(x_TMB, index, 1, keepdims=False), batch_TMB)
        return part, jax.lax.dynamic_index_in_dim(hidden_MBH, index, 0, keepdims=False)

    return taken


def _loss(
    ppo: PPOConfig, output: PolicyOutput, batch: _Batch, entropy_coefficient: float
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """The objective of Appendix A.1.2 as a mean over our decisions (note 10), and its parts."""
    logits_TBA = mask_logits(output.logits_TBA, batch.legal_TBA)
    log_policy_TBA = jax.nn.log_softmax(logits_TBA)
    log_ratio_TB = log_probability(logits_TBA, batch.action_TB) - batch.log_probability_TB
    if batch.known_TB is not None:
        # Someone else's event may be an action that we never take: keep its ratio finite.
        log_ratio_TB = jnp.where(batch.known_TB, log_ratio_TB, 0.0)
    ratio_TB = jnp.exp(log_ratio_TB)
    clipped_TB = jnp.clip(ratio_TB, 1.0 - ppo.clip, 1.0 + ppo.clip)
    gain_TB = jnp.minimum(ratio_TB * batch.advantage_TB, clipped_TB * batch.advantage_TB)
    entropy_TB = -(jnp.exp(log_policy_TBA) * log_policy_TBA).sum(-1)
    parts_TB = {
        "policy_loss": -gain_TB,
        "value_loss": jnp.square(output.value_TB - batch.target_TB),
        "entropy": entropy_TB,
        "approx_kl": ratio_TB - 1.0 - log_ratio_TB,
        "clip_fraction": (jnp.abs(ratio_TB - 1.0) > ppo.clip).astype(jnp.float32),
    }
    metrics = {name: masked_mean(part_TB, batch.known_TB) for name, part_TB in parts_TB.items()}
    loss = (
        metrics["policy_loss"]
        + ppo.value_coefficient * metrics["value_loss"]
        - entropy_coefficient * metrics["entropy"]
    )
    return loss, metrics


def _moments(x: jax.Array, mask: jax.Array | None) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Mean, standard deviation and number of entries of `x` where `mask` (None: everywhere)."""
    mean = masked_mean(x, mask)
    count = jnp.asarray(x.size) if mask is None else mask.sum()
    return mean, jnp.sqrt(masked_mean(jnp.square(x - mean), mask)), count
