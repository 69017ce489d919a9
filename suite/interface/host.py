"""Engines that are not JAX, as pure environments: the host plays them, and callers cannot tell.

A state holds what determines an engine: the seed that it was reset with and the actions since. A step calls the host,
where live engines wait, each filed under the state that it is in; normally one of them advances by one action. A state
that no engine is in (a resumed run, an evaluation beside training, a state stepped twice) is reached by resetting an
engine and replaying the actions. So results depend on the state alone, as long as `reset(seed)` determines an engine.
"""

from __future__ import annotations

import collections
import threading
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from suite.interface.environment import EnvironmentSpec, TimeStep
from suite.interface.turns import Turn
from suite.runtime.errors import RunError

LIMIT = 1000  # steps of an episode where an engine names no limit of its own
MIN_ENGINES, ENGINES_PER_ENVIRONMENT = 16, 4  # ended episodes and another user's engines may wait beside the live ones


class HostStep(NamedTuple):
    """What an engine returns, in NumPy. In a game: N = 2 players, both sides at once.

    Attributes:
      observation: uint8, of the spec's shape; in a game [N, ...].
      reward: float32, of the step just taken (0 at a reset); in a game [N].
      terminated: the episode ended by the rules.
      truncated: the episode was cut by a time limit.
      player: in a game, who acts next: 0 chance, 1 or 2.
      legal_A: in a game, bool; legal actions of a player to act, else all false.
      chance_C: in a game, float32; probabilities where chance acts, else all zero.
      raw_return: float32 [N], the engine's own returns so far; only of a game whose specification names this statistic.
    """

    observation: Any
    reward: Any
    terminated: Any
    truncated: Any
    player: Any = None
    legal_A: Any = None
    chance_C: Any = None
    raw_return: Any = None


class HostEngine(Protocol):
    """A stateful environment on the host, which its seed and actions determine."""

    def reset(self, seed: int) -> HostStep:
        """A new episode; `seed` is in [0, 2^31)."""

    def step(self, action: int) -> HostStep:
        """One step: an action in [0, A), or an outcome in [0, C) where chance acts. Never after an end."""


class CheckedEngine:
    """An engine whose faults are lines that say which engine, which episode and which step of it.

    `reset` and `step` raise a `RunError` where the engine raises anything, pays what is no finite float32, or begins
    an episode that is over.
    """

    def __init__(self, id: str, engine: HostEngine):
        self._id, self._engine = id, engine

    def reset(self, seed: int) -> HostStep:
        self._seed, self._time = seed, 0
        host_step = self._checked(self._engine.reset, seed)
        if host_step.terminated or host_step.truncated:
            raise RunError(f"{self._id}: the episode of seed {seed} is over before its first step")
        return host_step

    def step(self, action: int) -> HostStep:
        self._time += 1
        return self._checked(self._engine.step, action)

    def _checked(self, call: Callable[[int], HostStep], argument: int) -> HostStep:
        where = f"{self._id}, step {self._time} of the episode of seed {self._seed}"
        try:
            host_step = call(argument)
        except RunError as error:
            raise RunError(f"{where}: {error}") from error
        except Exception as error:  # whatever somebody else's code raises
            raise RunError(f"{where}: {type(error).__name__}: {' '.join(str(error).split())}") from error
        if not np.isfinite(host_step.reward).all():
            raise RunError(f"{where}: the reward is {np.asarray(host_step.reward).tolist()}, not a finite float32")
        return host_step


@struct.dataclass
class HostState:
    """What determines an engine.

    Attributes:
      seed: int32.
      actions: int32 [limit], zero from `length` on.
      length: int32; steps since the reset.
      seat: int32; ours, in a game; else None.
    """

    seed: jax.Array
    actions: jax.Array
    length: jax.Array
    seat: jax.Array | None = None


class HostEnvironment:
    """A host engine as an `Environment`: works under jit, vmap and loops; a batch is one call to the host.

    Args:
      spec: what the task is; of statistics, only a game's "seat" and "raw_return" can be given.
      make_engine: makes one engine; called as often as engines are needed side by side.
      limit: an episode of so many steps is truncated, unless it ended by itself.
    """

    def __init__(self, spec: EnvironmentSpec, make_engine: Callable[[], HostEngine], limit: int = LIMIT):
        self.spec = spec
        self.limit = limit
        self._pool = EnginePool(lambda: CheckedEngine(spec.id, make_engine()))
        flag, integer = jax.ShapeDtypeStruct((), jnp.bool_), jax.ShapeDtypeStruct((), jnp.int32)
        players = (2,) if spec.two_player else ()
        self._result = HostStep(
            observation=jax.ShapeDtypeStruct((*players, *spec.observation.shape), jnp.uint8),
            reward=jax.ShapeDtypeStruct(players, jnp.float32),
            terminated=flag,
            truncated=flag,
        )
        if spec.two_player:
            self._result = self._result._replace(
                player=integer,
                legal_A=jax.ShapeDtypeStruct((spec.num_actions,), jnp.bool_),
                chance_C=jax.ShapeDtypeStruct((spec.chance_outcomes,), jnp.float32),
                raw_return=jax.ShapeDtypeStruct((2,), jnp.float32) if "raw_return" in dict(spec.statistics) else None,
            )

    def reset(self, key: jax.Array, seat: jax.Array | None = None) -> tuple[HostState, TimeStep]:
        """An episode whose seed is drawn from `key`."""
        seed = (jax.random.bits(key, (), jnp.uint32) >> 1).astype(jnp.int32)
        state = HostState(seed, jnp.zeros(self.limit, jnp.int32), jnp.zeros((), jnp.int32), seat)
        return state, self._time_step(state, first=jnp.ones((), bool))

    def step(self, key: jax.Array, state: HostState, action: jax.Array) -> tuple[HostState, TimeStep]:
        """One step; `key` is not used: an engine's randomness comes from its seed."""
        actions = state.actions.at[state.length].set(action.astype(jnp.int32))
        state = state.replace(actions=actions, length=state.length + 1)  # type: ignore[attr-defined]
        return state, self._time_step(state, first=jnp.zeros((), bool))

    def _time_step(self, state: HostState, first: jax.Array) -> TimeStep:
        host_step = jax.pure_callback(
            self._visit, self._result, state.seed, state.actions, state.length, vmap_method="broadcast_all"
        )
        observation, reward, turn = host_step.observation, host_step.reward, None
        statistics = {}
        if state.seat is not None:
            turn = Turn(
                player=host_step.player,
                seat=state.seat,
                legal_A=host_step.legal_A,
                chance_C=host_step.chance_C,
                opponent_observation=observation[2 - state.seat],
            )
            observation, reward = observation[state.seat - 1], reward[state.seat - 1]
            if host_step.raw_return is not None:
                statistics["raw_return"] = host_step.raw_return[state.seat - 1]
            if "seat" in dict(self.spec.statistics):
                statistics["seat"] = state.seat.astype(jnp.float32)
        return TimeStep(
            observation=observation,
            reward=reward,
            terminated=host_step.terminated,
            truncated=(host_step.truncated | (state.length >= self.limit)) & ~host_step.terminated,
            first=first,
            final_observation=observation,
            statistics=statistics,
            turn=turn,
        )

    def _visit(self, seed: Any, actions: Any, length: Any) -> HostStep:
        """On the host: the steps that lead to these states, which have any leading axes."""
        lead = np.shape(seed)
        seeds, lengths = np.asarray(seed).reshape(-1), np.asarray(length).reshape(-1)
        histories = np.asarray(actions).reshape(-1, self.limit)
        if (lengths > self.limit).any():
            raise RunError(f"{self.spec.id}: a step after the end of an episode")
        steps = self._pool.reach([(int(s), a[:n].tobytes()) for s, a, n in zip(seeds, histories, lengths, strict=True)])

        def stacked(values: tuple[Any, ...], result: jax.ShapeDtypeStruct | None) -> np.ndarray | None:
            return None if result is None else np.asarray(values, result.dtype).reshape((*lead, *result.shape))

        return HostStep(*(stacked(v, r) for v, r in zip(zip(*steps, strict=True), self._result, strict=True)))


Place = tuple[int, bytes]  # a seed and the actions since, int32


class EnginePool:
    """Live engines, each filed under the place that it is at together with the step that led there."""

    def __init__(self, make_engine: Callable[[], HostEngine]):
        self._make_engine = make_engine
        self._capacity = MIN_ENGINES
        self._live: collections.OrderedDict[Place, tuple[HostEngine, HostStep]] = collections.OrderedDict()
        self._lock = threading.Lock()  # two compiled programs may call at once

    def reach(self, places: list[Place]) -> list[HostStep]:
        """The steps that led to these places (to a place without actions: a reset)."""
        with self._lock:
            self._capacity = max(self._capacity, ENGINES_PER_ENVIRONMENT * len(places))
            return [self._reach(place) for place in places]

    def _reach(self, place: Place) -> HostStep:
        seed, history = place
        before = (seed, history[:-4])
        if place in self._live:
            engine, host_step = self._live.pop(place)
        elif history and before in self._live:
            engine, host_step = self._live.pop(before)
            host_step = self._play(engine, host_step, history[-4:])
        else:
            engine = self._free_engine()
            host_step = self._play(engine, engine.reset(seed), history)
        self._live[place] = engine, host_step
        return host_step

    def _free_engine(self) -> HostEngine:
        """A new one, or the one not asked for for the longest time."""
        if len(self._live) < self._capacity:
            return self._make_engine()
        return self._live.popitem(last=False)[1][0]

    def _play(self, engine: HostEngine, host_step: HostStep, history: bytes) -> HostStep:
        for action in np.frombuffer(history, np.int32).tolist():
            if host_step.terminated or host_step.truncated:
                raise RunError("a step after the end of an episode, or an engine that its seed does not determine")
            host_step = engine.step(action)
        return host_step
