"""PettingZoo's environments as tasks, played on the host (`suite.interface.host`): `pettingzoo/<id>`.

A game of two agents is a task if it has discrete actions and observations of small whole numbers.

Importing this module imports no game and no JAX.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pettingzoo
from gymnasium import spaces

from adapters.gymnasium.observations import MAX_CATEGORIES, Encode, UnseenError, symbols
from adapters.gymnasium.task import distribution, one_line
from suite.runtime.errors import RunError, UserError, did_you_mean

if TYPE_CHECKING:
    from suite.interface.environment import Environment, EnvironmentSpec
    from suite.interface.host import HostStep


class PettingZooTask(NamedTuple):
    """An imported game: what it is, and how to make an engine."""

    spec: EnvironmentSpec
    make_engine: Callable[[], PettingZooEngine]


class PettingZooEngine:
    """An AEC environment of two agents as a host engine; see `suite.interface.host.HostEngine`.

    A game goes on as long as one of them lives: for the dead nobody acts, and they go on seeing what they saw last. All
    actions are legal where neither an agent's observation nor its info has an "action_mask".
    """

    def __init__(self, env: pettingzoo.AECEnv, encoders: list[Encode]):
        self.env, self._encoders = env, encoders
        self._first_action = int(env.action_space(env.possible_agents[0]).start)

    def reset(self, seed: int) -> HostStep:
        self.env.reset(seed=seed)
        self._parts: dict[str, dict[str, Any]] = {}
        self._seen: dict[str, np.ndarray] = {}
        return self._show(np.zeros(2, np.float32))

    def step(self, action: int) -> HostStep:
        env = self.env
        env.step(self._first_action + action)
        rewards = np.array([env.rewards.get(agent, 0.0) for agent in env.possible_agents], np.float32)
        while not self._over() and self._dead(env.agent_selection):
            self._look()
            env.step(None)
        return self._show(rewards)

    def _dead(self, agent: str) -> bool:
        return self.env.terminations[agent] or self.env.truncations[agent]

    def _over(self) -> bool:
        return all(map(self._dead, self.env.agents))

    def _look(self) -> None:
        for agent, encode in zip(self.env.possible_agents, self._encoders, strict=True):
            if agent in self.env.agents:
                self._parts[agent] = _parts(self.env.observe(agent))
                self._seen[agent] = encode(self._parts[agent]["observation"])

    def _show(self, rewards: np.ndarray) -> HostStep:
        from suite.interface.host import HostStep

        env, actor, over = self.env, self.env.agent_selection, self._over()
        self._look()
        mask = (env.infos.get(actor, {}) | self._parts[actor]).get("action_mask", True)
        legal_A = np.ones(env.action_space(actor).n, bool) & np.asarray(mask, bool)
        if not (over or legal_A.any()):
            raise RunError(f"{actor} has no legal action")
        terminated = over and any(env.terminations.values())
        return HostStep(
            observation=np.stack([self._seen[agent] for agent in env.possible_agents]),
            reward=rewards,
            terminated=terminated,
            truncated=over and not terminated,
            player=env.possible_agents.index(actor) + 1,
            legal_A=legal_A & (not over),
            chance_C=np.zeros(0, np.float32),
        )


def _parts(observed: Any) -> dict[str, Any]:
    """An observation, or a space of them, by parts: "observation" and, if there is one, "action_mask"."""
    parts = observed.spaces if isinstance(observed, spaces.Dict) else observed
    return parts if isinstance(parts, dict) and "observation" in parts else {"observation": observed}


def spec(id: str) -> EnvironmentSpec:
    """What the task `pettingzoo/<id>` is. Makes the environment once, to look at it.

    The first agent is player 1, the second player 2. Observations are flattened to symbols. There is no chance player:
    what an engine draws itself comes from its seed and cannot be told apart from its rules. Reward classes are -1, 0, 1
    and the rewards of 1,000 random steps; see `suite.interface.random_play.reward_classes`.

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
    from suite.interface.random_play import random_play, require_determined, reward_classes, rewards_of

    env = _make(id)
    count = len(env.possible_agents)
    if count != 2:
        raise _unsupported(id, f"it has {count} agent{'s' if count != 1 else ''}, not two")
    actions, observed = [
        [ask(agent) for agent in env.possible_agents] for ask in (env.action_space, env.observation_space)
    ]
    if not all(isinstance(space, spaces.Discrete) for space in actions) or actions[0].n < 2:
        raise _unsupported(id, "its actions are not Discrete with two or more")
    try:
        seen = [symbols(_parts(space)["observation"]) for space in observed]
    except UnseenError:
        seen = []
    known = [each for each in seen if each is not None]
    if len(known) < 2:
        raise _unsupported(id, f"its observations are not whole numbers of at most {MAX_CATEGORIES} values")
    if actions[0] != actions[1] or known[0].spec.shape != known[1].spec.shape:
        raise _unsupported(id, "its two agents have different spaces")
    encoders = [each.encode for each in known]

    def play() -> Iterator[HostStep]:
        return random_play(f"pettingzoo/{id}", PettingZooEngine(env, encoders), int(actions[0].n))

    require_determined(f"pettingzoo/{id}", play)
    task = EnvironmentSpec(
        id=f"pettingzoo/{id}",
        observation=ObservationSpec(known[0].spec.shape, max(each.spec.high for each in known), "symbols"),
        num_actions=int(actions[0].n),
        reward_classes=reward_classes({-1.0, 1.0} | rewards_of(play())),
        statistics=(("seat", ()),),
        package=distribution(env.unwrapped),
        two_player=True,
    )
    env.close()
    return PettingZooTask(task, lambda: PettingZooEngine(_make(id), encoders))


def _make(id: str) -> pettingzoo.AECEnv:
    family, _, name = id.replace(".", "/").rpartition("/")
    name = re.sub(r"_v(?=\d+$)", "-v", f"{family or 'classic'}/{name}")  # as the registry spells versions
    if name not in pettingzoo.aec_registry:
        raise UserError(f"PettingZoo has no {id!r}; {did_you_mean(name, pettingzoo.aec_registry)}")
    try:
        return pettingzoo.make("aec", name)
    except Exception as error:  # whatever an optional dependency that is missing leads to
        raise UserError(f"pettingzoo/{id}: {one_line(error)}") from error


def _unsupported(id: str, reason: str) -> UserError:
    return UserError(f"pettingzoo/{id} cannot be a task: {reason}")
