"""`gymnasium/<id>` as a task: a Gymnasium environment played on the host (`suite.interface.host`).

Its actions must be discrete and its observations small images, grids or categorical. Importing this module imports no
game and no JAX. Our tasks as Gymnasium environments are in `adapters.gymnasium.export`.
"""

from __future__ import annotations

import functools
import importlib.metadata
import itertools
import math
import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium import spaces

from suite.runtime.errors import UserError

if TYPE_CHECKING:
    from suite.interface.environment import Environment, EnvironmentSpec, ObservationSpec
    from suite.interface.host import HostStep

MAX_PATCHES = 9  # a side, as Craftax-classic has
MAX_CATEGORIES = 256
MAX_CHANNELS = 3
# Packages whose environments need not be asked for as "module:id".
HOMES = {"MiniGrid-": "minigrid", "BabyAI-": "minigrid"}
# Rewards that random steps hardly find: MiniGrid pays 1 - 0.9 x (steps taken / steps allowed) at the goal.
PAYS = {"minigrid": {0.1, 0.5, 0.9, 1.0}}


class GymnasiumTask(NamedTuple):
    """An imported environment: what it is, how to make an engine, and after how many steps it is truncated."""

    spec: EnvironmentSpec
    make_engine: Callable[[], GymnasiumEngine]
    limit: int


class Seen(NamedTuple):
    """How an observation becomes one of ours."""

    spec: ObservationSpec
    encode: Callable[[Any], np.ndarray]


class GymnasiumEngine:
    """A Gymnasium environment as a host engine; see `suite.interface.host.HostEngine`."""

    def __init__(self, env: gymnasium.Env, encode: Callable[[Any], np.ndarray]):
        self.env = env
        self._encode = encode
        self._first_action = int(env.action_space.start)  # type: ignore[attr-defined]

    def reset(self, seed: int) -> HostStep:
        observation, _ = self.env.reset(seed=seed)
        return self._show(observation, 0.0, False, False)

    def step(self, action: int) -> HostStep:
        observation, reward, terminated, truncated, _ = self.env.step(self._first_action + action)
        return self._show(observation, reward, terminated, truncated)

    def _show(self, observation: Any, reward: Any, terminated: bool, truncated: bool) -> HostStep:
        from suite.interface.host import HostStep

        return HostStep(self._encode(observation), np.float32(reward), terminated, truncated and not terminated)


def spec(id: str) -> EnvironmentSpec:
    """What the task `gymnasium/<id>` is. Makes the environment once, to look at it.

    Args:
      id: Gymnasium's own: "FrozenLake-v1", or "module:id" for environments that another package registers when it is
        imported (not needed for MiniGrid's).

    Reward classes are the rewards in an environment's own transition table (Gymnasium's toy texts), else those of
    1,000 random steps; see `suite.interface.host.reward_classes`. Patches are the smallest, square if possible, with
    at most 9 a side. Of an observation with several parts the "image" is seen. One symbol for up to 256 categories;
    more become the digits of two or more symbols.

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
    from suite.interface.host import LIMIT, random_rewards, reward_classes

    env = _make(id)
    actions = env.action_space
    if not isinstance(actions, spaces.Discrete) or int(actions.n) < 2:
        raise _unsupported(id, f"its actions are {_name(actions)}, not Discrete with two or more")
    assert env.spec is not None
    if env.spec.nondeterministic:
        raise _unsupported(id, "it is not determined by its seed")
    seen = _seen(id, env.observation_space)
    package = distribution(env.unwrapped)
    limit = env.spec.max_episode_steps or getattr(env.unwrapped, "max_steps", None) or LIMIT
    table = getattr(env.unwrapped, "P", None)
    if table is not None:
        rewards = _paid(table)
    else:
        rewards = random_rewards(GymnasiumEngine(env, seen.encode), int(actions.n)) | PAYS.get(package, set())
    task = EnvironmentSpec(
        id=f"gymnasium/{id}",
        observation=seen.spec,
        num_actions=int(actions.n),
        reward_classes=reward_classes(rewards),
        package=package,
    )
    env.close()
    return GymnasiumTask(task, lambda: GymnasiumEngine(_make(id), seen.encode), limit)


def _make(id: str) -> gymnasium.Env:
    home = next((f"{module}:" for start, module in HOMES.items() if id.startswith(start)), "")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # on versions, in colours: the id is the user's choice
            return gymnasium.make(home + id, disable_env_checker=True)
    except (gymnasium.error.Error, ImportError) as error:
        raise UserError(f"gymnasium/{id}: {one_line(error)}") from error


def _seen(id: str, space: spaces.Space) -> Seen:
    """How observations of this space become ours.

    Raises:
      UserError: they cannot.
    """
    from suite.interface.environment import ObservationSpec

    if isinstance(space, spaces.Dict) and "image" in space.spaces:
        inner = _seen(id, space["image"])
        return Seen(inner.spec, lambda observation: inner.encode(observation["image"]))
    if isinstance(space, spaces.Discrete):
        return _seen_digits(int(space.n), int(space.start))
    if isinstance(space, spaces.MultiDiscrete) and space.nvec.max() <= MAX_CATEGORIES:
        shape, start = (space.nvec.size,), space.start
        return Seen(
            ObservationSpec(shape, max(int(space.nvec.max()) - 1, 1), "symbols"),
            lambda observation: (observation - start).reshape(shape).astype(np.uint8),
        )
    if not isinstance(space, spaces.Box) or space.dtype != np.uint8:
        raise _unsupported(id, f"its observations are {_name(space)}, not uint8 boxes or discrete")
    box = space.shape if len(space.shape) == 3 else (*space.shape, 1)
    high = int(space.high.max())
    if len(box) != 3 or box[2] > MAX_CHANNELS or high < 1:
        raise _unsupported(id, f"its observations are {space.shape}, not [height, width] or [height, width, 1 to 3]")
    grid = ObservationSpec(box, high, "pixels" if high == 255 else "grid", patch(box[0], box[1]))
    return Seen(grid, lambda observation: observation.reshape(box))


def _seen_digits(categories: int, start: int) -> Seen:
    """One symbol, or as few equally large digits as hold more categories, the most significant one first."""
    from suite.interface.environment import ObservationSpec

    count = next(n for n in itertools.count(1) if MAX_CATEGORIES**n >= categories)
    base = next(b for b in itertools.count(1) if b**count >= categories)

    def encode(observation: Any) -> np.ndarray:
        number = int(observation) - start
        return np.array([number // base**place % base for place in reversed(range(count))], np.uint8)

    return Seen(ObservationSpec((count,), max(base - 1, 1), "symbols"), encode)


def patch(height: int, width: int) -> tuple[int, int]:
    """The smallest patch with at most nine a side: a square that divides both sides, or else each side by itself."""
    square = next((n for n in range(1, math.gcd(height, width) + 1) if _tiles(height, n) and _tiles(width, n)), None)
    if square is not None:
        return square, square
    rows = next(n for n in range(1, height + 1) if _tiles(height, n))
    columns = next(n for n in range(1, width + 1) if _tiles(width, n))
    return rows, columns


def _tiles(side: int, patch: int) -> bool:
    return side % patch == 0 and side // patch <= MAX_PATCHES


def _paid(table: Any) -> set[float]:
    """The rewards in a toy text's transition table: state, action, then (probability, next state, reward, end)."""
    return {float(reward) for moves in table.values() for ends in moves.values() for _, _, reward, _ in ends}


def distribution(engine: Any) -> str:
    """The name of the installed package that an object's class comes from; "" if it is part of none."""
    module = type(engine).__module__.partition(".")[0]
    return next(iter(importlib.metadata.packages_distributions().get(module, ())), "")


def one_line(error: Exception) -> str:
    """What an error says, on one line."""
    return " ".join(str(error).split())


def _name(space: spaces.Space) -> str:
    return f"{type(space).__name__}{f' of {space.dtype}' if isinstance(space, spaces.Box) else ''}"


def _unsupported(id: str, reason: str) -> UserError:
    return UserError(f"gymnasium/{id} cannot be a task: {reason}")
