"""MinAtar (Young and Tian 2019) as gymnax plays it, each game a pure environment. Importing this loads no game.

Against the original package (fidelity note 31): actions never stick (there 0.1), only those that do something in the
game can be chosen, and episodes are cut after 1,000 steps, Freeway's after 2,500 (there it ends, one step later; the
other games have no limit). Where the randomness is the same, observations, rewards and ends are the original's, but
for the oxygen in the frame with which surfacing ends Seaquest: here it is full.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from adapters.numerics import like, loose_numerics, strong
from suite.interface.environment import Environment, EnvironmentSpec, ObservationSpec, TimeStep
from suite.runtime.errors import UserError, did_you_mean

SIDE, PATCH = 10, 2


@dataclasses.dataclass(frozen=True)
class Game:
    """One of MinAtar's.

    Attributes:
      reference: gymnax's class at "module:name".
      objects: planes of its observation.
      actions: those that do something.
      rewards: all that a step can pay, ascending.
      longest: steps after which an episode is cut off.
    """

    reference: str
    objects: int
    actions: tuple[str, ...]
    rewards: tuple[float, ...] = (0.0, 1.0)
    longest: int = 1_000


GAMES = {
    "asterix": Game("asterix:MinAsterix", 4, ("none", "left", "up", "right", "down")),
    "breakout": Game("breakout:MinBreakout", 4, ("none", "left", "right")),
    "freeway": Game("freeway:MinFreeway", 7, ("none", "up", "down"), longest=2_500),
    # Not one of the paper's games. Surfacing with six divers pays up to 10; a shot may hit in the same step.
    "seaquest": Game(
        "seaquest:MinSeaquest", 10, ("none", "left", "up", "right", "down", "fire"), tuple(map(float, range(12)))
    ),
    "space_invaders": Game("space_invaders:MinSpaceInvaders", 6, ("none", "left", "right", "fire")),
}


def spec(name: str) -> EnvironmentSpec:
    """What the game of this name is."""
    if name not in GAMES:
        raise UserError(f"unknown task 'minatar/{name}'; {did_you_mean(name, GAMES)}")
    game = GAMES[name]
    return EnvironmentSpec(
        id=f"minatar/{name}",
        observation=ObservationSpec(shape=(SIDE, SIDE, game.objects), high=1, kind="grid", patch=(PATCH, PATCH)),
        num_actions=len(game.actions),
        reward_classes=game.rewards,
        package="gymnax",
        action_names=game.actions,
        ranges=(("length", 1, game.longest),),
        step_rewards=(game.rewards[0], game.rewards[-1]),
    )


def make(name: str, progress: Callable[[str, float], None] | None = None) -> Environment:
    """The game of this name, ready to be compiled; `progress` is not used: nothing takes long."""
    del progress
    return MinAtar(name)


class MinAtar:
    """One game; see `suite.interface.environment.Environment`. The state is gymnax's own.

    Observations are uint8 [10, 10, objects], 1 where there is such an object.
    """

    def __init__(self, name: str):
        import importlib

        self.spec = spec(name)
        module, kind = GAMES[name].reference.split(":")
        self.game = getattr(importlib.import_module(f"gymnax.environments.minatar.{module}"), kind)()
        self.params = self.game.default_params

    def reset(self, key: jax.Array) -> tuple[Any, TimeStep]:
        """A new game."""
        with loose_numerics():
            frame, state = self.game.reset_env(key, self.params)
        no = jnp.zeros((), bool)
        return jax.tree.map(strong, state), _time_step(frame, jnp.zeros(()), no, no, ~no)

    def step(self, key: jax.Array, state: Any, action: jax.Array) -> tuple[Any, TimeStep]:
        """One step of the game."""
        with loose_numerics():
            frame, stepped, reward, terminated, _ = self.game.step_env(key, state, action, self.params)
            truncated = self.game.is_truncated(stepped, self.params) & ~terminated
        return like(stepped, state), _time_step(frame, reward, terminated, truncated, jnp.zeros((), bool))


def _time_step(frame, reward, terminated, truncated, first) -> TimeStep:
    observation = frame.astype(jnp.uint8)
    return TimeStep(
        observation=observation,
        reward=strong(reward, jnp.dtype(jnp.float32)),
        terminated=strong(terminated, jnp.dtype(bool)),
        truncated=strong(truncated, jnp.dtype(bool)),
        first=first,
        final_observation=observation,
        statistics={},
    )
