"""Craftax-classic from pixels (Matthews et al. 2024) as a pure environment.

Importing this module loads no game and touches no device; `make_classic` does.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from adapters.numerics import like, loose_numerics, strong
from suite.interface.environment import Environment, EnvironmentSpec, ObservationSpec, TimeStep

CLASSIC_SPEC = EnvironmentSpec(
    id="craftax_classic",
    observation=ObservationSpec(shape=(63, 63, 3), high=255, kind="pixels", patch=(7, 7)),
    num_actions=17,
    reward_classes=(0.0, 1.0),
    max_return=22.0,
    achievements=(
        "collect_wood",
        "place_table",
        "eat_cow",
        "collect_sapling",
        "collect_drink",
        "make_wood_pickaxe",
        "make_wood_sword",
        "place_plant",
        "defeat_zombie",
        "collect_stone",
        "place_stone",
        "eat_plant",
        "defeat_skeleton",
        "make_stone_pickaxe",
        "make_stone_sword",
        "wake_up",
        "place_furnace",
        "collect_coal",
        "collect_iron",
        "collect_diamond",
        "make_iron_pickaxe",
        "make_iron_sword",
    ),
    statistics=(("achievements", (22,)), ("achievement_return", ()), ("health_return", ())),
    package="craftax",
)

START_HEALTH = 9
HEALTH_REWARD = 0.1  # per point of health gained or lost


def make_classic(progress: Callable[[str, float], None] | None = None) -> Environment:
    """Craftax-classic, ready to be compiled.

    Args:
      progress: called with a message and the fraction done; loading the game takes a second or two.
    """
    report = progress or (lambda message, fraction: None)
    report("Loading Craftax-classic", 0.0)
    environment = CraftaxClassic()
    report("Loading Craftax-classic", 1.0)
    return environment


class CraftaxClassic:
    """One game of Craftax-classic; see `suite.interface.environment.Environment`.

    Observations are uint8 [63, 63, 3]: craftax's frames before it divides them by 255, rounded (fidelity note 14). The
    reward is the game's own. An episode ends by death (terminated) or, alive, after `max_timesteps` (truncated).

    The state is craftax's `EnvState`. The statistics need none of their own: an achievement is never lost, and what
    health adds to the return telescopes to 0.1 x (health - 9) (fidelity note 29).
    """

    spec = CLASSIC_SPEC

    def __init__(self, max_timesteps: int = 10_000):
        from craftax.craftax_classic import game_logic, world_gen
        from craftax.craftax_classic.envs.craftax_state import EnvParams, StaticEnvParams

        from adapters.craftax_renderer import make_renderer

        self._params, self._sizes = EnvParams(max_timesteps=max_timesteps), StaticEnvParams()
        self._game, self._generate_world, self._render = game_logic, world_gen.generate_world, make_renderer()

    def reset(self, key: jax.Array) -> tuple[Any, TimeStep]:
        """A freshly generated world."""
        with loose_numerics():
            state = self._generate_world(key, self._params, self._sizes)
        state = jax.tree.map(strong, state)
        no = jnp.zeros((), bool)
        return state, self._time_step(state, jnp.zeros(()), terminated=no, truncated=no, first=~no)

    def step(self, key: jax.Array, state: Any, action: jax.Array) -> tuple[Any, TimeStep]:
        """One step of the game."""
        with loose_numerics():
            stepped, reward = self._game.craftax_step(key, state, action, self._params, self._sizes)
            over = self._game.is_game_over(stepped, self._params)
        stepped = like(stepped, state)
        truncated = (stepped.timestep >= self._params.max_timesteps) & (stepped.player_health > 0)
        flags = {"terminated": over & ~truncated, "truncated": truncated, "first": jnp.zeros((), bool)}
        return stepped, self._time_step(stepped, strong(reward, jnp.dtype(jnp.float32)), **flags)

    def _time_step(self, state: Any, reward: jax.Array, **flags: Any) -> TimeStep:
        observation = jnp.round(self._render(state)).astype(jnp.uint8)
        return TimeStep(
            observation=observation,
            final_observation=observation,
            reward=reward,
            statistics=_statistics(state),
            **flags,
        )


class BuiltInAutoReset:
    """Craftax-classic with the package's own auto-reset and our renderer: what `suite bench` measures ours against.

    A `BatchedEnvironment` that generates a world for every environment at every step. As in the package, an end is
    not told from a time limit (always `terminated`), and an episode's last frame and statistics are lost.
    """

    spec = CLASSIC_SPEC

    def __init__(self, num_envs: int):
        from craftax.craftax_classic.envs.craftax_pixels_env import CraftaxClassicPixelsEnv

        from adapters.craftax_renderer import make_renderer

        class Game(CraftaxClassicPixelsEnv):
            def __init__(self):  # not the package's own, which prepares textures for half a minute
                self.static_env_params = self.default_static_params()
                self._render_fn = make_renderer()

        self.num_envs = num_envs
        self._game = Game()

    def reset(self, key: jax.Array) -> tuple[Any, TimeStep]:
        """First time steps of B episodes; every array leads with B."""
        with loose_numerics():
            frame_B, state = jax.vmap(self._game.reset)(jax.random.split(key, self.num_envs))
        state = jax.tree.map(strong, state)
        no_B = jnp.zeros(self.num_envs, bool)
        return state, self._time_step(frame_B, state, jnp.zeros(self.num_envs), no_B, ~no_B)

    def step(self, key: jax.Array, state: Any, action_B: jax.Array) -> tuple[Any, TimeStep]:
        """One step of each environment, and B new worlds of which those that ended get theirs."""
        keys_B = jax.random.split(key, self.num_envs)
        with loose_numerics():
            frame_B, stepped, reward_B, done_B, _ = jax.vmap(self._game.step)(keys_B, state, action_B)
        stepped = like(stepped, state)
        return stepped, self._time_step(frame_B, stepped, strong(reward_B, jnp.dtype(jnp.float32)), done_B, done_B)

    def _time_step(self, frame_B, state, reward_B, terminated_B, first_B) -> TimeStep:
        observation_B = jnp.round(frame_B * 255).astype(jnp.uint8)
        return TimeStep(
            observation=observation_B,
            reward=reward_B,
            terminated=terminated_B,
            truncated=jnp.zeros(self.num_envs, bool),
            first=first_B,
            final_observation=observation_B,
            statistics=jax.vmap(_statistics)(state),
        )


def _statistics(state: Any) -> dict[str, jax.Array]:
    return {
        "achievements": state.achievements,
        "achievement_return": state.achievements.sum(dtype=jnp.float32),
        "health_return": HEALTH_REWARD * (state.player_health - START_HEALTH).astype(jnp.float32),
    }
