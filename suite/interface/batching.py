"""B environments side by side, with exact auto-reset.

Exact: only an environment whose episode ended is reset, each with a world of its own. Under `vmap` a
conditional becomes a select that would generate B worlds at every step; here a loop runs once per ended
environment, so the cost of a reset is paid when there is one.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from suite.interface.environment import Environment, EnvironmentSpec, State, TimeStep
from suite.interface.turns import Turn
from suite.runtime import layout


@dataclasses.dataclass(frozen=True)
class Batched:
    """`num_envs` copies of a pure environment as one `BatchedEnvironment`.

    Randomness, so that a manual reset can reproduce ours: `reset(key)` gives environment i the key
    `split(key, B)[i]`; `step(key, ...)` splits into `split(key, (2, B))`: row 0 steps, row 1 resets.

    In a two-player game environment i keeps one seat for good: 1 where i is even, 2 where it is odd.
    """

    environment: Environment
    num_envs: int

    @property
    def spec(self) -> EnvironmentSpec:
        return self.environment.spec

    def reset(self, key: jax.Array) -> tuple[State, TimeStep]:
        """B fresh episodes; every array leads with B."""
        reset = layout.per_device(jax.vmap(self._reset), (0, 0), 0)
        return reset(jax.random.split(key, self.num_envs), jnp.arange(self.num_envs))

    def step(self, key: jax.Array, state: State, action_B: jax.Array) -> tuple[State, TimeStep]:
        """One step of each environment; those that ended continue at the first frame of a new episode.

        The returned reward, flags, `final_observation` and statistics are of the step; `observation`, `first`
        and `turn` are those of the new episode where one began.
        """
        step_keys_B, reset_keys_B = jax.random.split(key, (2, self.num_envs))
        return layout.per_device(self._step, (0, 0, 0, 0), 0)(step_keys_B, reset_keys_B, state, action_B)

    def _step(
        self, step_keys_B: jax.Array, reset_keys_B: jax.Array, state: State, action_B: jax.Array
    ) -> tuple[State, TimeStep]:
        """`step` of a device's environments: each device resets its own."""
        state, stepped = jax.vmap(self.environment.step)(step_keys_B, state, action_B)
        ended_B = stepped.terminated | stepped.truncated
        # Indices of the environments that ended come first; the loop visits only those.
        order_B = jnp.argsort(~ended_B, stable=True)
        visible = {"observation": stepped.observation, "turn": stepped.turn}

        def reset_one(i, carry):
            index = order_B[i]
            number = layout.row_of_all(index, len(ended_B))
            fresh_state, fresh = self._reset(reset_keys_B[index], number)
            fresh_shown = {"observation": fresh.observation, "turn": fresh.turn}
            return jax.tree.map(lambda old, new: old.at[index].set(new), carry, (fresh_state, fresh_shown))

        state, visible = jax.lax.fori_loop(0, ended_B.sum(), reset_one, (state, visible))
        return state, dataclasses.replace(stepped, first=ended_B, **visible)

    def resumed(self, state: State, observation_BO: jax.Array, first_B: jax.Array, turn_B: Turn | None) -> Resumed:
        """The same environments, at the given states: what was seen there, whether it opens an episode, whose turn."""
        statistics = jax.eval_shape(self.reset, jax.random.key(0))[1].statistics
        no_B = jnp.zeros_like(first_B)
        time_step = TimeStep(
            observation=observation_BO,
            reward=jnp.zeros(first_B.shape, jnp.float32),
            terminated=no_B,
            truncated=no_B,
            first=first_B,
            final_observation=observation_BO,
            statistics=jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), statistics),
            turn=turn_B,
        )
        return Resumed(self, state, time_step)

    def _reset(self, key: jax.Array, index: jax.Array) -> tuple[State, TimeStep]:
        if not self.spec.two_player:
            return self.environment.reset(key)
        return self.environment.reset(key, (1 + index % 2).astype(jnp.int32))


@dataclasses.dataclass(frozen=True)
class Resumed:
    """A `BatchedEnvironment` that starts from given states. Build it inside the jitted function that uses it.

    An environment whose episode ends goes on with a fresh one, as those of `Batched` do.

    Attributes:
      batched: the rules.
      state: of each environment; every array leads with B.
      time_step: what is seen there.
    """

    batched: Batched
    state: State
    time_step: TimeStep

    @property
    def spec(self) -> EnvironmentSpec:
        """What the task is."""
        return self.batched.spec

    @property
    def num_envs(self) -> int:
        """B, the number of start states."""
        return self.batched.num_envs

    def reset(self, key: jax.Array) -> tuple[State, TimeStep]:
        """The given states as they are; `key` is not used."""
        del key
        return self.state, self.time_step

    def step(self, key: jax.Array, state: State, action_B: jax.Array) -> tuple[State, TimeStep]:
        """One step of each; see `Batched.step`."""
        return self.batched.step(key, state, action_B)
