"""Craftax-classic and Craftax (full) from pixels (Matthews et al. 2024) as pure environments.

Importing this module loads no game and touches no device; `make_classic` and `make_full` do.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from adapters.numerics import like, loose_numerics, strong
from suite.interface.environment import Environment, EnvironmentSpec, ObservationSpec, TimeStep

CLASSIC_ACHIEVEMENTS = (
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
)
# Those that the full game adds, in its order, by what they pay; the classic ones pay 1. Spelled as the game does.
FURTHER_ACHIEVEMENTS = (
    (1.0, ("make_arrow", "make_torch", "place_torch")),
    (3.0, ("make_diamond_sword", "make_iron_armour", "make_diamond_armour", "enter_gnomish_mines", "enter_dungeon")),
    (5.0, ("enter_sewers", "enter_vault", "enter_troll_mines")),
    (8.0, ("enter_fire_realm", "enter_ice_realm", "enter_graveyard")),
    (3.0, ("defeat_gnome_warrior", "defeat_gnome_archer", "defeat_orc_solider", "defeat_orc_mage")),
    (5.0, ("defeat_lizard", "defeat_kobold", "defeat_troll", "defeat_deep_thing")),
    (8.0, ("defeat_pigman", "defeat_fire_elemental", "defeat_frost_troll", "defeat_ice_elemental")),
    (8.0, ("damage_necromancer", "defeat_necromancer")),
    (3.0, ("eat_bat", "eat_snail", "find_bow", "fire_bow", "collect_sapphire")),
    (5.0, ("learn_fireball", "cast_fireball", "learn_iceball", "cast_iceball")),
    (3.0, ("collect_ruby", "make_diamond_pickaxe", "open_chest", "drink_potion")),
    (5.0, ("enchant_sword", "enchant_armour", "defeat_knight", "defeat_archer")),
)


# In the order of their numbers; the classic game has those of the first tuple.
CLASSIC_ACTIONS = (
    *("noop", "left", "right", "up", "down", "do", "sleep", "place_stone", "place_table", "place_furnace"),
    *("place_plant", "make_wood_pickaxe", "make_stone_pickaxe", "make_iron_pickaxe"),
    *("make_wood_sword", "make_stone_sword", "make_iron_sword"),
)
FURTHER_ACTIONS = (
    *("rest", "descend", "ascend", "make_diamond_pickaxe", "make_diamond_sword", "make_iron_armour"),
    *("make_diamond_armour", "shoot_arrow", "make_arrow", "cast_fireball", "cast_iceball", "place_torch"),
    *(f"drink_potion_{color}" for color in ("red", "green", "blue", "pink", "cyan", "yellow")),
    *("read_book", "enchant_sword", "enchant_armour", "make_torch"),
    *("level_up_dexterity", "level_up_strength", "level_up_intelligence", "enchant_bow"),
)
START_HEALTH = 9
HEALTH_REWARD = 0.1  # per point of health gained or lost


def _spec(
    id: str,
    pixels: tuple[int, int, int],
    tile: int,
    actions: tuple[str, ...],
    rewards: dict[str, float],
    longest: int,
    most_health: int,
) -> EnvironmentSpec:
    """`longest`: steps after which an episode is cut off; `most_health`: the most points that a player can have."""
    return EnvironmentSpec(
        id=id,
        observation=ObservationSpec(shape=pixels, high=255, kind="pixels", patch=(tile, tile)),
        num_actions=len(actions),
        action_names=actions,
        reward_classes=(0.0, *sorted(set(rewards.values()))),
        achievements=tuple(rewards),
        achievement_rewards=tuple(rewards.values()),
        statistics=(("achievements", (len(rewards),)), ("achievement_return", ()), ("health_return", ())),
        package="craftax",
        light_changes=True,
        ranges=(
            ("length", 1, longest),
            ("health_return", -HEALTH_REWARD * START_HEALTH, HEALTH_REWARD * (most_health - START_HEALTH)),
        ),
        return_parts=("achievement_return", "health_return"),
    )


_CLASSIC = dict.fromkeys(CLASSIC_ACHIEVEMENTS, 1.0)
CLASSIC_SPEC = _spec(
    "craftax_classic", (63, 63, 3), 7, CLASSIC_ACTIONS, _CLASSIC, longest=10_000, most_health=START_HEALTH
)
FULL_SPEC = _spec(
    "craftax_full",
    (130, 110, 3),
    10,
    CLASSIC_ACTIONS + FURTHER_ACTIONS,
    _CLASSIC | {name: reward for reward, names in FURTHER_ACHIEVEMENTS for name in names},
    longest=100_000,
    most_health=13,  # of the strongest player
)

NO_LIMIT = 2**31 - 1


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


def make_full(progress: Callable[[str, float], None] | None = None) -> Environment:
    """Craftax (full), ready to be compiled.

    Args:
      progress: called with a message and the fraction done; loading the game takes a few seconds.
    """
    report = progress or (lambda message, fraction: None)
    report("Loading Craftax", 0.0)
    environment = CraftaxFull()
    report("Loading Craftax", 1.0)
    return environment


class Craftax:
    """What both games have in common; see `suite.interface.environment.Environment`.

    Observations are uint8: craftax's frames before it divides them by 255, rounded (fidelity note 14). The reward is
    the game's own. An episode ends by death or, in the full game, by victory (terminated), or else after
    `max_timesteps` (truncated).

    The state is craftax's `EnvState`. The statistics need none of their own: an achievement is never lost, and what
    health adds to the return telescopes to 0.1 x (health - 9) (fidelity note 29).

    Args:
      spec: what the game is.
      parameters, sizes: craftax's `EnvParams` and `StaticEnvParams`.
      step: craftax's `craftax_step`.
      is_over: craftax's `is_game_over`, of a state and `EnvParams`.
      generate_world: craftax's.
      render: from a state to its frame, float32 in [0, 255].
    """

    def __init__(
        self,
        spec: EnvironmentSpec,
        parameters: Any,
        sizes: Any,
        step: Callable[..., Any],
        is_over: Callable[[Any, Any], Any],
        generate_world: Callable[..., Any],
        render: Callable[[Any], jax.Array],
    ):
        self.spec = spec
        self._params, self._sizes, self._unlimited = parameters, sizes, parameters.replace(max_timesteps=NO_LIMIT)
        self._step, self._is_over, self._generate_world, self._render = step, is_over, generate_world, render

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
            stepped, reward = self._step(key, state, action, self._params, self._sizes)
            terminated = strong(self._is_over(stepped, self._unlimited))
        stepped = like(stepped, state)
        truncated = (stepped.timestep >= self._params.max_timesteps) & ~terminated
        flags = {"terminated": terminated, "truncated": truncated, "first": jnp.zeros((), bool)}
        return stepped, self._time_step(stepped, strong(reward, jnp.dtype(jnp.float32)), **flags)

    def _time_step(self, state: Any, reward: jax.Array, **flags: Any) -> TimeStep:
        observation = jnp.round(self._render(state)).astype(jnp.uint8)
        return TimeStep(
            observation=observation,
            final_observation=observation,
            reward=reward,
            statistics=_statistics(state, self.spec),
            **flags,
        )


class CraftaxClassic(Craftax):
    """One game of Craftax-classic: 63x63 pixels, 22 achievements that pay 1 each."""

    spec = CLASSIC_SPEC

    def __init__(self, max_timesteps: int = 10_000):
        from craftax.craftax_classic import game_logic, world_gen
        from craftax.craftax_classic.envs.craftax_state import EnvParams, StaticEnvParams

        from adapters.craftax.classic_renderer import make_renderer

        super().__init__(
            CLASSIC_SPEC,
            EnvParams(max_timesteps=max_timesteps),
            StaticEnvParams(),
            game_logic.craftax_step,
            game_logic.is_game_over,
            world_gen.generate_world,
            make_renderer(),
        )


class CraftaxFull(Craftax):
    """One game of Craftax (full): 130x110 pixels, nine levels, 67 achievements worth 226."""

    spec = FULL_SPEC

    def __init__(self, max_timesteps: int = 100_000):
        from craftax.craftax import game_logic
        from craftax.craftax.craftax_state import EnvParams, StaticEnvParams
        from craftax.craftax.world_gen.world_gen import generate_world

        from adapters.craftax.full_renderer import make_renderer

        sizes = StaticEnvParams()
        super().__init__(
            FULL_SPEC,
            EnvParams(max_timesteps=max_timesteps),
            sizes,
            game_logic.craftax_step,
            lambda state, parameters: game_logic.is_game_over(state, parameters, sizes),
            generate_world,
            make_renderer(),
        )


class BuiltInAutoReset:
    """A game with the package's own auto-reset and our renderer: what `suite bench` measures ours against.

    A `BatchedEnvironment` that generates a world for every environment at every step. As in the package, an end is
    not told from a time limit (always `terminated`), and an episode's last frame and statistics are lost.

    Args:
      game: craftax's pixel environment that resets by itself, a class.
      spec: the game's.
      render: as of `Craftax`.
      num_envs: B.
    """

    def __init__(self, game: Any, spec: EnvironmentSpec, render: Callable[[Any], jax.Array], num_envs: int):
        self.spec, self.num_envs = spec, num_envs
        self._game = game.__new__(game)  # without its __init__, which prepares textures for minutes
        self._game.static_env_params = game.default_static_params()
        self._game._render_fn = render

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
            statistics=jax.vmap(lambda state: _statistics(state, self.spec))(state),
        )


def classic_built_in_auto_reset(num_envs: int) -> BuiltInAutoReset:
    """B games of Craftax-classic that reset as the package does."""
    from craftax.craftax_classic.envs.craftax_pixels_env import CraftaxClassicPixelsEnv

    from adapters.craftax.classic_renderer import make_renderer

    return BuiltInAutoReset(CraftaxClassicPixelsEnv, CLASSIC_SPEC, make_renderer(), num_envs)


def full_built_in_auto_reset(num_envs: int) -> BuiltInAutoReset:
    """B games of Craftax (full) that reset as the package does."""
    from craftax.craftax.envs.craftax_pixels_env import CraftaxPixelsEnv

    from adapters.craftax.full_renderer import make_renderer

    return BuiltInAutoReset(CraftaxPixelsEnv, FULL_SPEC, make_renderer(), num_envs)


def _statistics(state: Any, spec: EnvironmentSpec) -> dict[str, jax.Array]:
    rewards = jnp.asarray(spec.achievement_rewards, jnp.float32)
    return {
        "achievements": state.achievements,
        "achievement_return": state.achievements.astype(jnp.float32) @ rewards,
        "health_return": HEALTH_REWARD * (state.player_health - START_HEALTH).astype(jnp.float32),
    }
