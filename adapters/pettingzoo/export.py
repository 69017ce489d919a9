"""Two-player tasks of the suite as PettingZoo's AEC environments: `env("openspiel/leduc")`.

Importing this module imports no game and no JAX.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import pettingzoo
from gymnasium import spaces
from gymnasium.utils import seeding
from pettingzoo.utils import wrappers

from suite import registry
from suite.runtime.errors import UserError

if TYPE_CHECKING:
    from suite.interface.environment import Environment

AGENTS = ["player_1", "player_2"]


def env(task: str | Environment, render_mode: str | None = None) -> pettingzoo.AECEnv:
    """A two-player task as an AEC environment that insists on the order of calls.

    Args and Raises: as `SuiteAECEnv`.
    """
    return wrappers.OrderEnforcingWrapper(raw_env(task, render_mode))


def raw_env(task: str | Environment, render_mode: str | None = None) -> SuiteAECEnv:
    """A two-player task as an AEC environment without wrappers.

    Args and Raises: as `SuiteAECEnv`.
    """
    return SuiteAECEnv(task, render_mode)


class SuiteAECEnv(pettingzoo.AECEnv):
    """A two-player task as a PettingZoo AEC environment.

    Agents are "player_1" and "player_2". Each observes {"observation": uint8 of the spec's shape, "action_mask":
    int8 [A]}; the mask is zero for who is not to act. Chance is played inside, by its probabilities and a generator
    that `reset(seed)` seeds; without a seed the generator goes on. Rewards are those of the events since the last
    `step`, chance's included.

    Our environments show and pay one seat, so two copies are played in lock-step by the same keys and events.

    Args:
      task: a task's id, or an environment.
      render_mode: "ansi": `render()` returns a line of text; None: no rendering.

    Raises:
      UserError: no such task, or a single-agent one; no such render mode.
    """

    def __init__(self, task: str | Environment, render_mode: str | None = None):
        super().__init__()
        environment: Any = _built(task) if isinstance(task, str) else task
        spec = environment.spec
        if not spec.two_player:
            raise UserError(f"{spec.id} has one player: it is a Gymnasium environment (adapters.gymnasium.export)")
        if render_mode not in (None, "ansi"):
            raise UserError(f"{spec.id} cannot be rendered as {render_mode!r}; valid: ansi")
        self.metadata = {
            "name": f"suite_{spec.id.replace('/', '_')}_v0",
            "render_modes": ["ansi"],
            "is_parallelizable": False,
        }
        self.render_mode = render_mode
        self.possible_agents = AGENTS[:]
        self.agents: list[str] = []
        self.action_spaces: dict[str, spaces.Space] = {agent: spaces.Discrete(spec.num_actions) for agent in AGENTS}
        self.observation_spaces: dict[str, spaces.Space] = {
            agent: spaces.Dict(
                {
                    "observation": spaces.Box(0, spec.observation.high, spec.observation.shape, np.uint8),
                    "action_mask": spaces.Box(0, 1, (spec.num_actions,), np.int8),
                }
            )
            for agent in AGENTS
        }
        self._reset, self._step = _programs(environment)
        self._random: np.random.Generator | None = None
        self._key: Any = None
        self._state: Any = None
        self._shown: Any = None  # a time step that leads with the two seats

    def observation_space(self, agent: str) -> spaces.Space:
        return self.observation_spaces[AGENTS[_index(agent)]]

    def action_space(self, agent: str) -> spaces.Space:
        return self.action_spaces[AGENTS[_index(agent)]]

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> None:
        """A new game; `options` are not used."""
        import jax

        if seed is not None or self._random is None:
            self._random, _ = seeding.np_random(seed)
        self._key = jax.random.key(int(self._random.integers(2**32)))
        self._key, self._state, self._shown = self._reset(self._key)
        self.agents = AGENTS[:]
        self.rewards = dict.fromkeys(AGENTS, 0.0)
        self._cumulative_rewards = dict.fromkeys(AGENTS, 0.0)
        self.terminations = dict.fromkeys(AGENTS, False)
        self.truncations = dict.fromkeys(AGENTS, False)
        self.infos: dict[str, dict[str, Any]] = {agent: {} for agent in AGENTS}
        self._skip_agent_selection = None
        self.agent_selection = AGENTS[0]
        self._play_chance()

    def step(self, action: Any) -> None:
        """The selected agent acts, then chance as long as it is its turn.

        Raises:
          UserError: an illegal action.
        """
        agent = self.agent_selection
        if self.terminations[agent] or self.truncations[agent]:
            self._was_dead_step(action)
            return
        legal = np.flatnonzero(self._shown.turn.legal_A[0])
        if action not in legal:
            raise UserError(f"illegal action {action} of {agent}; legal: {', '.join(map(str, legal))}")
        self._cumulative_rewards[agent] = 0.0
        self._clear_rewards()
        self._play(int(action))
        self._play_chance()
        self._accumulate_rewards()

    def observe(self, agent: str) -> dict[str, np.ndarray]:
        """What this agent sees now, whoever is to act. Raises a `UserError` if there is no such agent."""
        index = _index(agent)
        legal_A = self._shown.turn.legal_A[index] & (agent == self.agent_selection) & (not self._over())
        return {"observation": self._shown.observation[index].copy(), "action_mask": legal_A.astype(np.int8)}

    def render(self) -> str | None:
        """Who is to act and what each sees, on a line; None without a render mode."""
        if self.render_mode is None:
            return None
        seen = "; ".join(
            f"{agent} sees {self._shown.observation[i].ravel().tolist()}" for i, agent in enumerate(AGENTS)
        )
        return f"{'over' if self._over() else f'{self.agent_selection} to act'}; {seen}"

    def close(self) -> None:
        """Nothing to release."""

    def _over(self) -> bool:
        return bool(self._shown.terminated[0] | self._shown.truncated[0])

    def _play(self, event: int) -> None:
        self._key, self._state, self._shown = self._step(self._key, self._state, np.int32(event))
        for agent, reward in zip(AGENTS, self._shown.reward, strict=True):
            self.rewards[agent] += float(reward)

    def _play_chance(self) -> None:
        """Chance's events, then whose turn it is or how the game ended."""
        assert self._random is not None
        while not self._over() and self._shown.turn.player[0] == 0:
            chance_C = self._shown.turn.chance_C[0].astype(np.float64)
            self._play(int(self._random.choice(chance_C.size, p=chance_C / chance_C.sum())))
        if self._over():
            self.terminations = dict.fromkeys(AGENTS, bool(self._shown.terminated[0]))
            self.truncations = dict.fromkeys(AGENTS, bool(self._shown.truncated[0]))
            self.agent_selection = AGENTS[1 - AGENTS.index(self.agent_selection)]  # the last to act hears it last
        else:
            self.agent_selection = AGENTS[int(self._shown.turn.player[0]) - 1]


def _index(agent: str) -> int:
    """0 or 1: the seat of an agent."""
    if agent not in AGENTS:
        raise UserError(f"no seat {agent!r}; valid: {', '.join(AGENTS)}")
    return AGENTS.index(agent)


@functools.lru_cache(maxsize=16)
def _built(id: str) -> Environment:
    return registry.task(id).make()()


@functools.lru_cache(maxsize=16)
def _programs(environment: Environment) -> tuple[Callable, Callable]:
    """Compiled reset and step of both seats' copies, shared by all who play this environment."""
    import jax
    import jax.numpy as jnp

    @jax.jit
    def reset(key):
        key, reset_key = jax.random.split(key)
        return key, *jax.vmap(environment.reset, (None, 0))(reset_key, jnp.array([1, 2], jnp.int32))

    @jax.jit
    def step(key, state, event):
        key, step_key = jax.random.split(key)
        return key, *jax.vmap(environment.step, (None, 0, None))(step_key, state, event)

    def on_the_host(program):
        def run(*args):
            key, state, shown = program(*args)
            return key, state, jax.device_get(shown)

        return run

    return on_the_host(reset), on_the_host(step)
