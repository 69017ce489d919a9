"""Environments of other libraries with one peculiarity each."""

from __future__ import annotations

import copy

import gymnasium
import numpy as np
import pettingzoo
from gymnasium import spaces


class Env(gymnasium.Env):
    """Shows random members of any space.

    Args:
      observation, actions: its spaces.
      pay: the reward of a step, of the actions since the reset (of several at once, the last).
      length: steps after which it terminates; None: never.
      shows: what it shows instead, of the time.
      seeded: whether `reset` heeds its seed.
      raises: "reset" or "step", which fails.
      own: attributes.
    """

    def __init__(
        self,
        observation=spaces.Discrete(3),  # noqa: B008
        actions=spaces.Discrete(2),  # noqa: B008
        pay=lambda taken: 0.5 * (len(taken) % 3),
        length=None,
        shows=None,
        seeded=True,
        raises="",
        own=(),
    ):
        self.observation_space, self.action_space = copy.deepcopy(observation), actions
        self.pay, self.length, self.shows, self.seeded, self.raises = pay, length, shows, seeded, raises
        vars(self).update(own)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if self.raises == "reset":
            raise OSError("no display\nfound")
        if self.seeded:
            self.observation_space.seed(seed)
        self.taken = []
        return self._show(), {}

    def step(self, action):
        assert self.action_space.contains(action), f"{action!r} is no action"
        if self.raises == "step":
            raise ZeroDivisionError("division by zero")
        self.taken.append(int(np.ravel(action)[-1]))
        return self._show(), self.pay(self.taken), len(self.taken) == self.length, False, {}

    def _show(self):
        return self.observation_space.sample() if self.shows is None else self.shows(len(self.taken))


class Game(pettingzoo.AECEnv):
    """Agents act one after another; each sees how often it acted, and is paid 1 for its last action.

    Args:
      observation, actions: spaces.
      agents: how many.
      masked: whether observations have an action mask.
      lives: of each agent, after how many actions it is dead; all are at 0: the game is over at once.
      reward: what is paid at a death.
      legal: the mask.
    """

    metadata = {"name": "game"}  # noqa: RUF012

    def __init__(
        self,
        observation=spaces.Discrete(9),  # noqa: B008
        actions=spaces.Discrete(2),  # noqa: B008
        agents=2,
        masked=True,
        lives=(3, 3),
        reward=1.0,
        legal=(1, 1),
    ):
        super().__init__()
        self.possible_agents = [f"agent_{n}" for n in range(agents)]
        self.mask = np.array(legal, np.int8)
        mask = spaces.Box(0, 1, (2,), np.int8)
        seen = spaces.Dict({"observation": observation, "action_mask": mask}) if masked else observation
        self.observation_spaces = dict.fromkeys(self.possible_agents, seen)
        self.action_spaces = dict.fromkeys(self.possible_agents, actions)
        self.masked, self.lives, self.reward = masked, dict(zip(self.possible_agents, lives, strict=False)), reward

    def observation_space(self, agent):
        return self.observation_spaces[agent]

    def action_space(self, agent):
        return self.action_spaces[agent]

    def reset(self, seed=None, options=None):
        self.agents = self.possible_agents[:]
        self.acted = dict.fromkeys(self.agents, 0)
        self.rewards = dict.fromkeys(self.agents, 0.0)
        self._cumulative_rewards = dict.fromkeys(self.agents, 0.0)
        self.terminations = {agent: self.lives[agent] == 0 for agent in self.agents}
        self.truncations = dict.fromkeys(self.agents, False)
        self.infos = {agent: {} for agent in self.agents}
        self.agent_selection = self.agents[0]
        self._skip_agent_selection = None

    def observe(self, agent):
        number = np.int64(self.acted[agent])
        return {"observation": number, "action_mask": self.mask} if self.masked else number

    def step(self, action):
        agent = self.agent_selection
        if self.terminations[agent]:
            self._was_dead_step(action)
            return
        assert self.action_spaces[agent].contains(action), f"{action!r} is no action"
        self._clear_rewards()
        self.acted[agent] += 1
        if self.acted[agent] == self.lives[agent]:
            self.terminations[agent], self.rewards[agent] = True, self.reward
        self.agent_selection = self.agents[(self.agents.index(agent) + 1) % len(self.agents)]
        self._accumulate_rewards()
        self._deads_step_first()
