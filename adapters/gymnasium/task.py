"""`gymnasium/<id>` as a task: a Gymnasium environment played on the host (`suite.interface.host`).

Its actions must be discrete, and its observations images or few numbers (`adapters.gymnasium.observations`). Importing
this module imports no game and no JAX. Our tasks as Gymnasium environments are in `adapters.gymnasium.export`.
"""

from __future__ import annotations

import functools
import importlib.metadata
import math
import warnings
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium import spaces

from adapters.gymnasium import observations
from adapters.gymnasium.observations import Encode
from suite.runtime.errors import UserError

if TYPE_CHECKING:
    from suite.interface.environment import Environment, EnvironmentSpec
    from suite.interface.host import HostStep

MAX_COMBINATIONS = 256
# Packages whose environments need not be asked for as "module:id".
HOMES = {"MiniGrid-": "minigrid", "BabyAI-": "minigrid"}
# Rewards that random steps hardly find: MiniGrid pays 1 - 0.9 x (steps taken / steps allowed) at the goal.
PAYS = {"minigrid": {0.1, 0.5, 0.9, 1.0}}


class GymnasiumTask(NamedTuple):
    """An imported environment: what it is, how to make an engine, and after how many steps it is truncated."""

    spec: EnvironmentSpec
    make_engine: Callable[[], GymnasiumEngine]
    limit: int


class GymnasiumEngine:
    """A Gymnasium environment as a host engine; see `suite.interface.host.HostEngine`."""

    def __init__(self, env: gymnasium.Env, encode: Encode, native: Callable[[int], Any]):
        self.env = env
        self._encode, self._native = encode, native

    def reset(self, seed: int) -> HostStep:
        observation, _ = self.env.reset(seed=seed)
        return self._show(observation, 0.0, False, False)

    def step(self, action: int) -> HostStep:
        observation, reward, terminated, truncated, _ = self.env.step(self._native(action))
        return self._show(observation, reward, terminated, truncated)

    def _show(self, observation: Any, reward: Any, terminated: bool, truncated: bool) -> HostStep:
        from suite.interface.host import HostStep

        with np.errstate(over="ignore"):  # what overflows is refused by who asks
            paid = np.float32(reward)
        return HostStep(self._encode(observation), paid, terminated, truncated and not terminated)


def spec(id: str) -> EnvironmentSpec:
    """What the task `gymnasium/<id>` is. Makes the environment once, to look at it.

    Args:
      id: Gymnasium's own: "FrozenLake-v1", or "module:id" for environments that another package registers when it is
        imported (not needed for MiniGrid's).

    Reward classes are the rewards in an environment's own transition table (Gymnasium's toy texts), else those of
    1,000 random steps; see `suite.interface.random_play.reward_classes`. `adapters.gymnasium.observations.seen` says
    what is seen. The same random steps are played for everyone: neither depends on a run.

    Raises:
      UserError: no such environment, or one that cannot be a task, and why.
    """
    return _imported(id).spec


def make(id: str, progress: Callable[[str, float], None] | None = None) -> Environment:
    """The task `gymnasium/<id>`; see `spec`.

    Episodes are truncated after the environment's own `max_episode_steps` (or MiniGrid's `max_steps`), or 1,000.

    Args:
      id: Gymnasium's own.
      progress: called with a message and the fraction done.

    Raises:
      UserError: as `spec`.
    """
    from suite.interface.host import HostEnvironment

    report = progress or (lambda message, fraction: None)
    report(f"Loading gymnasium/{id}", 0.0)
    environment = HostEnvironment(*_imported(id))
    report(f"Loading gymnasium/{id}", 1.0)
    return environment


@functools.lru_cache(maxsize=16)
def _imported(id: str) -> GymnasiumTask:
    from suite.interface.environment import EnvironmentSpec
    from suite.interface.host import LIMIT
    from suite.interface.random_play import random_play, require_determined, reward_classes, rewards_of

    env = _make(id)
    count, native = _actions(id, env.action_space)
    assert env.spec is not None
    if env.spec.nondeterministic:
        raise _unsupported(id, "its seed does not determine it")

    def play(encode: Encode) -> Iterator[HostStep]:
        return random_play(f"gymnasium/{id}", GymnasiumEngine(env, encode, native), count)

    try:
        seen = observations.seen(env.observation_space, lambda encode: (step.observation for step in play(encode)))
    except observations.UnseenError as error:
        raise _unsupported(id, f"its observations are {error}") from error
    require_determined(f"gymnasium/{id}", lambda: play(seen.encode))
    package = distribution(env.unwrapped)
    longest = env.spec.max_episode_steps or getattr(env.unwrapped, "max_steps", None)
    paid = rewards_of(play(seen.encode)) | PAYS.get(package, set())
    task = EnvironmentSpec(
        id=f"gymnasium/{id}",
        observation=seen.spec,
        num_actions=count,
        reward_classes=reward_classes(_paid(getattr(env.unwrapped, "P", None)) or paid),
        package=package,
    )
    limit = longest if isinstance(longest, int) else LIMIT
    env.close()
    return GymnasiumTask(task, lambda: GymnasiumEngine(_make(id), seen.encode, native), limit)


def _make(id: str) -> gymnasium.Env:
    home = next((f"{module}:" for start, module in HOMES.items() if id.startswith(start)), "")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # on versions, in colours: the id is the user's choice
            return gymnasium.make(home + id, disable_env_checker=True)
    except Exception as error:  # whatever somebody else's code raises
        raise UserError(f"gymnasium/{id}: {one_line(error)}") from error


def _actions(id: str, space: spaces.Space) -> tuple[int, Callable[[int], Any]]:
    """How many actions there are, and what each number is in the environment's own space.

    Raises:
      UserError: they are not discrete, fewer than two, or too many combinations.
    """
    choices: np.ndarray
    start: Any = 0
    if isinstance(space, spaces.Discrete):
        choices, start = np.array([space.n]), int(space.start)
    elif isinstance(space, spaces.MultiDiscrete):
        choices, start = space.nvec, space.start
    elif isinstance(space, spaces.MultiBinary):
        choices = np.full(space.shape, 2)
    else:
        kind = type(space).__name__
        hint = " (gymnasium.wrappers has DiscretizeAction)" if isinstance(space, spaces.Box) else ""
        raise _unsupported(id, f"its actions are {kind}, not Discrete, MultiDiscrete or MultiBinary{hint}")
    count = math.prod(choices.ravel().tolist())
    if count < 2:
        raise _unsupported(id, "it has fewer than two actions")
    if choices.size > 1 and count > MAX_COMBINATIONS:
        raise _unsupported(
            id, f"its actions have {count:,} combinations, and at most {MAX_COMBINATIONS} become actions"
        )

    def native(action: int) -> Any:
        if isinstance(space, spaces.Discrete):
            return start + action
        places = np.array(np.unravel_index(action, choices.ravel())).reshape(space.shape)
        return (start + places).astype(space.dtype)

    return count, native


def _paid(table: Any) -> set[float]:
    """The rewards in a toy text's transition table: state, action, then (probability, next state, reward, end).

    None of anything else: other environments may call something of theirs P.
    """
    try:
        return {float(reward) for moves in table.values() for ends in moves.values() for _, _, reward, _ in ends}
    except (AttributeError, TypeError, ValueError):
        return set()


def distribution(engine: Any) -> str:
    """The name of the installed package that an object's class comes from; "" if it is part of none."""
    module = type(engine).__module__.partition(".")[0]
    return next(iter(importlib.metadata.packages_distributions().get(module, ())), "")


def one_line(error: Exception) -> str:
    """What an error says, on one line."""
    return " ".join(str(error).split())


def _unsupported(id: str, reason: str) -> UserError:
    return UserError(f"gymnasium/{id} cannot be a task: {reason}")
