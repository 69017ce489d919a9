"""Contract 1: the environment. A pure, single environment; batching and auto-reset live in `batching.py`.

Shapes: B environments side by side, T steps. A suffix names the leading axes of an array (`reward_TB`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, Literal, Protocol

import jax
import jax.numpy as jnp
from flax import struct

from suite.interface.turns import Turn

State = Any  # An environment's own pytree of arrays.


@dataclasses.dataclass(frozen=True)
class ObservationSpec:
    """What one observation is, known without building the game.

    Observations are uint8 throughout: they are what replay stores, and half of what a frame costs is moving it.

    Attributes:
      shape: (height, width, channels) for a grid; (symbols,) for a vector of categorical symbols.
      high: largest value; networks see `observation / high` for grids (255 pixels, 1 binary planes) and a
        one-hot of `high + 1` categories for symbols.
      kind: "pixels" (rendered), "grid" (binary object planes) or "symbols" (one-dimensional, categorical).
      patch: (height, width) of the natural patch of a grid; None for symbols.
    """

    shape: tuple[int, ...]
    high: int
    kind: Literal["pixels", "grid", "symbols"]
    patch: tuple[int, int] | None = None


def nearest_level(levels: tuple[float, ...], reward: jax.Array) -> jax.Array:
    """int32 index of the level nearest to each reward, ties to the higher level (fidelity note 22)."""
    ascending = jnp.asarray(levels, jnp.float32)
    boundaries = (ascending[1:] + ascending[:-1]) / 2
    return jnp.searchsorted(boundaries, reward, side="right").astype(jnp.int32)


@dataclasses.dataclass(frozen=True)
class EnvironmentSpec:
    """What a task is, known without building the game (so that `suite describe` answers at once).

    Attributes:
      id: the task's id.
      observation: what is seen.
      num_actions: A, the number of actions of our player.
      reward_classes: ascending reward levels that a world model tells apart (Appendix A.2.2); a real reward
        belongs to the nearest level, ties to the higher one. With (0, 1): class 1 iff r >= 0.5.
      achievements: names of the achievements, in the order of `TimeStep.statistics["achievements"]`.
      achievement_rewards: what each pays, once an episode.
      statistics: names and shapes of the per-episode statistics that time steps carry.
      package: the package whose rules these are; its version is part of the protocol.
      two_player: whether time steps carry a `Turn`, and `reset` takes our seat.
      chance_outcomes: C, how many outcomes chance has in a two-player game; 0: there is no chance.
      fully_observed: whether what is seen is all there is to know, as on a board; False: not, or it is not known.
      light_changes: whether the same thing is drawn in more than one light, as by day and by night.
      action_names: of the A actions, if they have names.
      ranges: what the rules allow of whole episodes: a column of `episodes.csv`, the least and the most. Of other
        columns nothing is known.
      step_rewards: the least and the most that one step can pay; None: that is not known.
      return_parts: statistics whose sum is the return; none: there are no such.
    """

    id: str
    observation: ObservationSpec
    num_actions: int
    reward_classes: tuple[float, ...]
    achievements: tuple[str, ...] = ()
    achievement_rewards: tuple[float, ...] = ()
    statistics: tuple[tuple[str, tuple[int, ...]], ...] = ()
    package: str = ""
    two_player: bool = False
    chance_outcomes: int = 0
    fully_observed: bool = False
    light_changes: bool = False
    action_names: tuple[str, ...] = ()
    ranges: tuple[tuple[str, float, float], ...] = ()
    step_rewards: tuple[float, float] | None = None
    return_parts: tuple[str, ...] = ()

    @property
    def max_return(self) -> float | None:
        """The sum of all achievements' rewards (22 for Craftax-classic); None where there are none."""
        return sum(self.achievement_rewards) if self.achievements else None

    def pays(self, reward: jax.Array) -> jax.Array:
        """bool: whether the level nearest to each reward is above 0."""
        return jnp.asarray(self.reward_classes, jnp.float32)[nearest_level(self.reward_classes, reward)] > 0


@struct.dataclass
class TimeStep:
    """What a step returns; every field has the batch's leading axes.

    Attributes:
      observation: what to act on next. After a batched step that ended an episode: the next episode's first.
      reward: float32, of the step just taken (0 at a reset).
      terminated: the episode ended by the rules: the future is worth nothing.
      truncated: the episode was cut by a time limit: the future still has the value of `final_observation`.
      first: `observation` is the first of an episode; memory of what came before must be dropped.
      final_observation: what the step itself led to; equals `observation` unless the episode ended.
      statistics: the episode's running statistics as named by `EnvironmentSpec.statistics`, before any reset.
      turn: who is to act at `observation`; None for single-agent tasks.
    """

    observation: jax.Array
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    first: jax.Array
    final_observation: jax.Array
    statistics: dict[str, jax.Array]
    turn: Turn | None = None


class Environment(Protocol):
    """One environment, pure: the same key, state and action give the same result. Knows nothing of batches."""

    spec: EnvironmentSpec

    @property
    def reset(self) -> Callable[..., tuple[State, TimeStep]]:
        """`reset(key)`: a freshly generated episode and its first time step (`first` true, reward 0).

        Of a two-player game `reset(key, seat)`; `seat`: int32 scalar, which of its players is ours (1 or 2).
        """

    def step(self, key: jax.Array, state: State, action: jax.Array) -> tuple[State, TimeStep]:
        """One step; never resets. `action`: int32 scalar in [0, A); of a game, the event, as `choose_event` says."""


class BatchedEnvironment(Protocol):
    """B environments side by side: the real ones behind `batching.Batched`, or the dream of a world model."""

    @property
    def spec(self) -> EnvironmentSpec:
        """What the task is."""

    @property
    def num_envs(self) -> int:
        """B."""

    def reset(self, key: jax.Array) -> tuple[State, TimeStep]:
        """First time steps of B episodes; every array leads with B."""

    def step(self, key: jax.Array, state: State, action_B: jax.Array) -> tuple[State, TimeStep]:
        """One step of each; whatever ended goes on with a new first observation."""
