"""The suite's single-agent tasks as Gymnasium environments, one by one or as a vector.

Gymnasium loads no plug-ins, so its registry knows ours once `adapters` is imported, which it can do itself:
`gymnasium.make("adapters.gymnasium:suite/craftax_classic-v0")`. Importing this module imports no game and no JAX.
"""

from __future__ import annotations

import functools
import os
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector.utils import batch_space

from suite import registry
from suite.runtime.errors import UserError

if TYPE_CHECKING:
    from suite.interface.environment import Environment, EnvironmentSpec, ObservationSpec, TimeStep

NAMESPACE = "suite"
NOT_EXPORTED = ("openspiel", "pettingzoo", "gymnasium")  # families: games of two players, and Gymnasium's own


def register_all() -> None:
    """Registers `suite/<task's id, "/" replaced by "_">-v0` for every single-agent task; builds none of them."""
    for id, entry in registry.tasks().items():
        name = f"{NAMESPACE}/{id.replace('/', '_')}-v0"
        if entry.family in NOT_EXPORTED or name in gymnasium.registry:
            continue
        gymnasium.register(
            name,
            entry_point="adapters.gymnasium.export:SuiteEnv",
            vector_entry_point="adapters.gymnasium.export:SuiteVectorEnv",
            kwargs={"task": id},
        )


class SuiteEnv(gymnasium.Env):
    """A single-agent task as a Gymnasium environment.

    Observations are uint8 arrays of the spec's shape (int64 for symbols); `info` has the episode's statistics.
    Randomness: `reset(seed)` starts the stream of keys at `jax.random.key(seed mod 2^32)`; every reset and step takes
    the second key of a split and leaves the first. Without a seed the stream goes on.

    Args:
      task: a task's id, or an environment.
      render_mode: "rgb_array" for tasks that are seen in colour: the last observation; None: no rendering.

    Raises:
      UserError: no such task, or a two-player game, or one that cannot be rendered.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012

    def __init__(self, task: str | Environment, render_mode: str | None = None):
        spec = single_agent_spec(task)
        in_colour = spec.observation.kind == "pixels" and spec.observation.shape[-1] == 3
        if render_mode is not None and not (render_mode == "rgb_array" and in_colour):
            raise UserError(f"{spec.id} cannot be rendered as {render_mode!r}")
        self.metadata = {**self.metadata, "render_modes": ["rgb_array"] if in_colour else []}
        self.render_mode = render_mode
        self.observation_space = observation_space(spec.observation)
        self.action_space = spaces.Discrete(spec.num_actions)
        self._task: Any = task
        self._programs: Any = None  # made by the first reset: one that only shows its spaces must not use JAX
        self._key: Any = None
        self._state: Any = None
        self._frame: np.ndarray | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """A new episode; `options` are not used. Raises a `UserError` in a fork of a process that used JAX."""
        _refuse_forks()
        super().reset(seed=seed)
        self._programs = self._programs or _programs(self._task)
        if seed is not None or self._key is None:
            self._key = _first_key(self.np_random if seed is None else seed)
        self._key, self._state, time_step = self._programs[0](self._key)
        return self._observation(time_step), _episode(time_step)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """One step.

        Raises:
          gymnasium.error.ResetNeeded: there is no episode, or it has ended.
          gymnasium.error.InvalidAction: no such action.
        """
        if self._state is None:
            raise gymnasium.error.ResetNeeded("the episode has ended or none was begun: call reset() first")
        if not self.action_space.contains(action):
            raise gymnasium.error.InvalidAction(f"{action!r} is no action of {self.action_space}")
        self._key, self._state, time_step = self._programs[1](self._key, self._state, np.int32(action))
        observation = self._observation(time_step)
        terminated, truncated = bool(time_step.terminated), bool(time_step.truncated)
        if terminated or truncated:
            self._state = None
        return observation, float(time_step.reward), terminated, truncated, _episode(time_step)

    def render(self) -> Any:
        """The last observation, uint8 [height, width, 3]; None without a render mode."""
        return None if self.render_mode is None or self._frame is None else self._frame.copy()

    def _observation(self, time_step: TimeStep) -> np.ndarray:
        self._frame = _as_in(self.observation_space, time_step.observation)
        return self._frame


class SuiteVectorEnv(gymnasium.vector.VectorEnv):
    """A single-agent task as `num_envs` Gymnasium environments that step in one compiled program.

    Autoreset is SAME_STEP: an environment whose episode ended shows the next episode's first observation; what the
    step led to is in `info["final_obs"]`, and the episode's statistics in `info["final_info"]`. The statistics in
    `info` itself are those of episodes that go on, as their masks (`info["_<name>"]`) say.

    Randomness is as `SuiteEnv` has it, one stream for all: the keys go to `suite.interface.batching.Batched`.

    Args:
      task: a task's id, or an environment.
      num_envs: B.
      render_mode: None: vectors are not rendered.

    Raises:
      UserError: no such task, or a two-player game, or a render mode.
    """

    metadata = {"render_modes": [], "autoreset_mode": gymnasium.vector.AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(self, task: str | Environment, num_envs: int = 1, render_mode: str | None = None):
        spec = single_agent_spec(task)
        if render_mode is not None:
            raise UserError(f"vectors of {spec.id} cannot be rendered; make a single environment")
        self.num_envs = num_envs
        self.single_observation_space = observation_space(spec.observation)
        self.single_action_space = spaces.Discrete(spec.num_actions)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._task: Any = task
        self._programs: Any = None  # made by the first reset
        self._key: Any = None
        self._state: Any = None

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """New episodes everywhere.

        Args:
          seed: one for all environments.
          options: not used; in particular no single environment can be reset.

        Raises:
          UserError: a list of seeds, or a mask of environments, or this is a fork of a process that used JAX.
        """
        if seed is not None and not isinstance(seed, (int, np.integer)):
            raise UserError(f"a suite vector takes one seed for all its environments, not {seed!r}")
        if options and "reset_mask" in options:
            raise UserError("a suite vector resets what ended by itself; reset_mask is not supported")
        _refuse_forks()
        super().reset(seed=None if seed is None else int(seed))
        self._programs = self._programs or _programs(self._task, self.num_envs)
        if seed is not None or self._key is None:
            self._key = _first_key(self.np_random if seed is None else seed)
        self._key, self._state, time_step = self._programs[0](self._key)
        info = _masked(time_step.statistics, np.ones(self.num_envs, bool))
        return _as_in(self.observation_space, time_step.observation), info

    def step(self, actions: Any) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One step of each; rewards float32 [B], flags bool [B].

        Raises:
          gymnasium.error.ResetNeeded: no episodes were begun.
          gymnasium.error.InvalidAction: not an action for each.
        """
        if self._state is None:
            raise gymnasium.error.ResetNeeded("no episodes were begun: call reset() first")
        if not self.action_space.contains(np.asarray(actions)):
            raise gymnasium.error.InvalidAction(f"{actions!r} are no actions of {self.action_space}")
        self._key, self._state, time_step = self._programs[1](self._key, self._state, np.asarray(actions, np.int32))
        ended_B = time_step.terminated | time_step.truncated
        info = _masked(time_step.statistics, ~ended_B)
        if ended_B.any():
            final_B = np.full(self.num_envs, None, dtype=object)
            final_observation_B = _as_in(self.observation_space, time_step.final_observation)
            for index in np.flatnonzero(ended_B):
                final_B[index] = final_observation_B[index]
            info |= {"final_obs": final_B, "_final_obs": ended_B}
            info |= {"final_info": _masked(time_step.statistics, ended_B), "_final_info": ended_B}
        observation_B = _as_in(self.observation_space, time_step.observation)
        return observation_B, time_step.reward, time_step.terminated, time_step.truncated, info


def observation_space(spec: ObservationSpec) -> spaces.Space:
    """The Gymnasium space of an observation: a box of uint8, or of symbols a `MultiDiscrete`."""
    if spec.kind == "symbols":
        return spaces.MultiDiscrete(np.full(spec.shape, spec.high + 1))
    return spaces.Box(0, spec.high, spec.shape, np.uint8)


@functools.lru_cache(maxsize=16)
def _built(id: str) -> Environment:
    return registry.task(id).make()()


def single_agent_spec(task: Any) -> EnvironmentSpec:
    """What a task or an environment is, without building it. Raises a `UserError` of a game of two players."""
    spec = registry.task(task).spec() if isinstance(task, str) else task.spec
    if spec.two_player:
        raise UserError(f"{spec.id} is a game of two players: use adapters.pettingzoo.export.env({spec.id!r})")
    return spec


_user_of_jax: int | None = (
    None  # the first process that had used JAX when it was forked, this one or what it comes from
)


def _note_user_of_jax() -> None:
    global _user_of_jax
    bridge = sys.modules.get("jax._src.xla_bridge")
    if _user_of_jax is None and bridge is not None and bridge.backends_are_initialized():
        _user_of_jax = os.getpid()


os.register_at_fork(before=_note_user_of_jax)


def _refuse_forks() -> None:
    """JAX's threads are not in a fork: a program would wait for them for ever."""
    if _user_of_jax not in (None, os.getpid()):
        raise UserError(
            "JAX was used before this process was forked from another, and would hang here: use AsyncVectorEnv(..., "
            'context="spawn"), or gymnasium.make_vec, which steps all environments in one program'
        )


@functools.lru_cache(maxsize=16)
def _programs(task: Any, num_envs: int | None = None) -> tuple[Callable, Callable]:
    """Compiled reset and step of a task or an environment, that carry the stream of keys; shared by all who play it."""
    import jax

    from suite.interface.batching import Batched

    environment = _built(task) if isinstance(task, str) else task
    played: Any = environment if num_envs is None else Batched(environment, num_envs)

    def reset(key):
        key, reset_key = jax.random.split(key)
        return key, *played.reset(reset_key)

    def step(key, state, action):
        key, step_key = jax.random.split(key)
        return key, *played.step(step_key, state, action)

    def on_the_host(program):
        compiled = jax.jit(program)

        def run(*args):
            key, state, time_step = compiled(*args)
            return key, state, jax.device_get(time_step)

        return run

    return on_the_host(reset), on_the_host(step)


def _first_key(source: Any) -> Any:
    """The first key of a stream: of a seed, or of one drawn from a generator."""
    import jax

    seed = source.integers(2**32) if isinstance(source, np.random.Generator) else source
    return jax.random.key(int(seed) % 2**32)


def _as_in(space: spaces.Space, observation: Any) -> np.ndarray:
    return np.array(observation, dtype=space.dtype)  # a copy: what JAX returns cannot be written to


def _episode(time_step: TimeStep) -> dict[str, Any]:
    """Statistics as `info`; scalars as Python's."""
    return {name: value.copy() if value.shape else value.item() for name, value in time_step.statistics.items()}


def _masked(statistics: dict[str, np.ndarray], mask_B: np.ndarray) -> dict[str, Any]:
    """Statistics of the environments in the mask as a vector's `info`: zeros elsewhere, and a mask for each."""
    info: dict[str, Any] = {}
    for name, value_B in statistics.items():
        wide = mask_B.reshape(-1, *(1,) * (value_B.ndim - 1))
        info |= {name: np.where(wide, value_B, np.zeros_like(value_B)), f"_{name}": mask_B.copy()}
    return info
