"""Games of OpenSpiel that are too large for tables: the engine itself, played on the host (`suite.interface.host`).

Importing this module loads no engine.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import numpy as np

from adapters.openspiel.tables import MAX_SYMBOL, NotCategoricalError
from suite.interface.environment import EnvironmentSpec
from suite.interface.host import HostEnvironment, HostStep
from suite.interface.random_play import random_steps
from suite.runtime.errors import RunError

SIGNS = (-1.0, 0.0, 1.0)
MAX_REWARD_CLASSES = 32  # a game with more levels of return is learned from its sign
MEASURED_EVENTS = 5_000  # of random play: seconds where an engine is slow
LIMIT = 5_000  # events: a state holds them all, and chess allows 17,695


class OpenSpielEngine:
    """A `pyspiel.Game` of two players who take turns, as a host engine; see `suite.interface.host.HostEngine`.

    Both players' returns are paid where the game ends, or their signs where the `reward_classes` of `spec` are -1, 0
    and 1. At an end nobody acts: `player` is 0, and nothing is legal or likely. An event that cannot happen changes
    nothing and pays nothing.

    `reset` and `step` raise a `RunError` where an observation holds what `spec` does not allow.
    """

    def __init__(self, game: Any, spec: EnvironmentSpec):
        self._game, self._spec = game, spec

    def reset(self, seed: int) -> HostStep:
        """A new game. `seed` is not used: what chance does are events."""
        self._state = self._game.new_initial_state()
        return self._show()

    def step(self, action: int) -> HostStep:
        """An action of the player to act, or an outcome of chance."""
        if action in self._possible:
            self._state.apply_action(action)
        return self._show()

    def _show(self) -> HostStep:
        state, spec = self._state, self._spec
        chance, ended = state.is_chance_node(), state.is_terminal()
        legal_A = np.zeros(spec.num_actions, bool)
        chance_C = np.zeros(spec.chance_outcomes, np.float32)
        if chance:
            self._possible, probabilities = zip(*state.chance_outcomes(), strict=True)
            chance_C[list(self._possible)] = probabilities
        else:
            self._possible = state.legal_actions()
            legal_A[self._possible] = True
        raw_return = np.array(state.returns(), np.float32)
        payment = np.sign(raw_return) if spec.reward_classes == SIGNS else raw_return
        return HostStep(
            observation=self._observation(),
            reward=payment if ended else np.zeros(2, np.float32),
            terminated=ended,
            truncated=False,
            player=0 if chance or ended else state.current_player() + 1,
            legal_A=legal_A,
            chance_C=chance_C,
            raw_return=raw_return,
        )

    def _observation(self) -> np.ndarray:
        exact = np.array([self._state.observation_tensor(player) for player in (0, 1)], np.float32)
        high = self._spec.observation.high
        wrong = exact[(exact != exact.round()) | (exact < 0) | (exact > high)]
        if wrong.size:
            raise RunError(f"an observation holds {wrong[0]:g}, not a whole number from 0 to {high}")
        return exact.astype(np.uint8)


def measured(game: Any, spec: EnvironmentSpec) -> EnvironmentSpec:
    """`spec` with its largest symbol and its reward classes, as far as random play tells; always the same.

    Symbols above 1 may be larger in other play: twice the largest one seen is allowed then. Reward classes are the
    integers in the game's range of returns, if only such are seen and they are at most `MAX_REWARD_CLASSES`; else
    -1, 0 and 1.

    Args:
      game: a `pyspiel.Game`.
      spec: right in all else.

    Raises:
      NotCategoricalError: an observation holds a number that is no integer in [0, 255].
    """
    anything = dataclasses.replace(spec.observation, high=MAX_SYMBOL)
    engine = OpenSpielEngine(game, dataclasses.replace(spec, observation=anything, reward_classes=()))
    high, returns = 1, {0.0, game.min_utility(), game.max_utility()}
    try:
        for host_step in random_steps(engine, spec.num_actions, MEASURED_EVENTS):
            high = max(high, int(host_step.observation.max()))
            returns |= set(host_step.reward.tolist())
    except RunError:
        raise NotCategoricalError from None
    rewards: tuple[float, ...] = SIGNS
    if all(value.is_integer() for value in returns) and max(returns) - min(returns) < MAX_REWARD_CLASSES:
        rewards = tuple(float(level) for level in range(int(min(returns)), int(max(returns)) + 1))
    observation = dataclasses.replace(spec.observation, high=min(2 * high, MAX_SYMBOL) if high > 1 else 1)
    ranges = (*(row for row in spec.ranges if row[0] != "return"), ("return", rewards[0], rewards[-1]))
    return dataclasses.replace(spec, observation=observation, reward_classes=rewards, ranges=ranges)


def make(game: Any, spec: EnvironmentSpec) -> HostEnvironment:
    """The game as an environment; truncated after `LIMIT` events where it may be longer.

    Args:
      game: a `pyspiel.Game`.
      spec: as `measured` gives it.
    """
    return HostEnvironment(spec, functools.partial(OpenSpielEngine, game, spec), min(game.max_history_length(), LIMIT))
