"""PettingZoo's environments as tasks, played on the host (`suite.interface.host`): `pettingzoo/<id>`.

A game of two agents is a task if it has discrete actions, an action mask and observations of small integers.

Importing this module imports no game and no JAX.
"""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pettingzoo
from gymnasium import spaces

from adapters.gymnasium.task import distribution, one_line
from suite.runtime.errors import UserError, did_you_mean

if TYPE_CHECKING:
    from suite.interface.environment import Environment, EnvironmentSpec
    from suite.interface.host import HostStep

MAX_HIGH = 255


class PettingZooTask(NamedTuple):
    """An imported game: what it is, and how to make an engine."""

    spec: EnvironmentSpec
    make_engine: Callable[[], PettingZooEngine]


class PettingZooEngine:
    """An AEC environment as a host engine; see `suite.interface.host.HostEngine`."""

    def __init__(self, env: pettingzoo.AECEnv):
        self.env = env

    def reset(self, seed: int) -> HostStep:
        self.env.reset(seed=seed)
        return self._show(first=True)

    def step(self, action: int) -> HostStep:
        self.env.step(action)
        return self._show(first=False)

    def _show(self, first: bool) -> HostStep:
        from suite.interface.host import HostStep

        env, agents = self.env, self.env.possible_agents
        seen = [env.observe(agent) for agent in agents]
        actor = agents.index(env.agent_selection)
        terminated, truncated = any(env.terminations.values()), any(env.truncations.values())
        legal_A = np.asarray(seen[actor]["action_mask"], bool) & (not (terminated or truncated))
        return HostStep(
            observation=np.stack([np.asarray(each["observation"]).reshape(-1).astype(np.uint8) for each in seen]),
            reward=np.array([0.0 if first else env.rewards.get(agent, 0.0) for agent in agents], np.float32),
            terminated=terminated,
            truncated=truncated and not terminated,
            player=actor + 1,
            legal_A=legal_A,
            chance_C=np.zeros(0, np.float32),
        )


def spec(id: str) -> EnvironmentSpec:
    """What the task `pettingzoo/<id>` is. Makes the environment once, to look at it.

    The first agent is player 1, the second player 2. Observations are flattened to symbols. There is no chance player:
    what an engine draws itself comes from its seed and cannot be told apart from its rules. Reward classes are -1, 0, 1
    and the rewards of 1,000 random steps; see `suite.interface.host.reward_classes`.

    Args:
      id: a classic game's "connect_four_v3", or "family/name" (or "family.name") of PettingZoo's registry of AEC
        environments.

    Raises:
      UserError: no such environment, or one that cannot be a task, and why.
    """
    return _imported(id).spec


def make(id: str, progress: Callable[[str, float], None] | None = None) -> Environment:
    """The task `pettingzoo/<id>`; see `spec`. Games are truncated after 1,000 steps.

    Args:
      id: as `spec` takes it.
      progress: called with a message and the fraction done.

    Raises:
      UserError: as `spec`.
    """
    from suite.interface.host import HostEnvironment

    report = progress or (lambda message, fraction: None)
    report(f"Loading pettingzoo/{id}", 0.0)
    environment = HostEnvironment(*_imported(id))
    report(f"Loading pettingzoo/{id}", 1.0)
    return environment


@functools.lru_cache(maxsize=16)
def _imported(id: str) -> PettingZooTask:
    from suite.interface.environment import EnvironmentSpec, ObservationSpec
    from suite.interface.host import random_rewards, reward_classes

    env = _make(id)
    if len(env.possible_agents) != 2:
        raise _unsupported(id, f"it has {len(env.possible_agents)} agents, not two")
    actions, observed = [
        [ask(agent) for agent in env.possible_agents] for ask in (env.action_space, env.observation_space)
    ]
    if not all(isinstance(space, spaces.Discrete) and space.start == 0 for space in actions) or actions[0].n < 2:
        raise _unsupported(id, "its actions are not Discrete with two or more, from 0")
    if not all(isinstance(s, spaces.Dict) and {"observation", "action_mask"} <= set(s.spaces) for s in observed):
        raise _unsupported(id, "its observations have no action mask")
    highs = [_high(space["observation"]) for space in observed]
    sizes = [int(np.prod(space["observation"].shape, dtype=int)) for space in observed]
    if any(high > MAX_HIGH for high in highs):
        raise _unsupported(id, f"its observations are not integers from 0 to at most {MAX_HIGH}")
    if actions[0] != actions[1] or sizes[0] != sizes[1]:
        raise _unsupported(id, "its two agents have different spaces")
    task = EnvironmentSpec(
        id=f"pettingzoo/{id}",
        observation=ObservationSpec((sizes[0],), max(int(max(highs)), 1), "symbols"),
        num_actions=int(actions[0].n),
        reward_classes=reward_classes({-1.0, 1.0} | random_rewards(PettingZooEngine(env), int(actions[0].n))),
        statistics=(("seat", ()),),
        package=distribution(env.unwrapped),
        two_player=True,
    )
    env.close()
    return PettingZooTask(task, lambda: PettingZooEngine(_make(id)))


def _make(id: str) -> pettingzoo.AECEnv:
    family, _, name = id.replace(".", "/").rpartition("/")
    name = re.sub(r"_v(?=\d+$)", "-v", f"{family or 'classic'}/{name}")  # as the registry spells versions
    if name not in pettingzoo.aec_registry:
        raise UserError(f"PettingZoo has no {id!r}; {did_you_mean(name, pettingzoo.aec_registry)}")
    try:
        return pettingzoo.make("aec", name)
    except Exception as error:  # whatever an optional dependency that is missing leads to
        raise UserError(f"pettingzoo/{id}: {one_line(error)}") from error


def _high(space: spaces.Space) -> float:
    """The largest value of integers from 0; infinite for anything else."""
    if isinstance(space, spaces.Discrete) and space.start == 0:
        return int(space.n) - 1
    if isinstance(space, spaces.MultiDiscrete) and not space.start.any():
        return int(space.nvec.max()) - 1
    if isinstance(space, spaces.MultiBinary):
        return 1
    if isinstance(space, spaces.Box) and np.dtype(space.dtype).kind in "biu" and not space.low.any():
        return int(space.high.max())
    return math.inf


def _unsupported(id: str, reason: str) -> UserError:
    return UserError(f"pettingzoo/{id} cannot be a task: {reason}")
