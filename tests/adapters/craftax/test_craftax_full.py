"""Craftax (full) as a pure environment, and its frames, which are craftax's frames, pixel by pixel."""

from __future__ import annotations

from collections import Counter

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from adapters.craftax.full_renderer import make_renderer
from adapters.craftax.task import FULL_SPEC, CraftaxFull, full_built_in_auto_reset
from tests.adapters.craftax.frames import check_equal, original_renderer
from tests.contract import check_environment, programs

STEPS, BATCH = 125, 16
FRAMES = 256
NECROMANCER = 32  # of craftax's BlockType
BOSS_LEVEL = 8


@pytest.fixture(scope="module")
def environment():
    return CraftaxFull()


@pytest.fixture(scope="module")
def play(environment):
    """Environment 0 dies exactly at the time limit, 1 only reaches it, 2 only dies, 3 has won; 4 begins at night."""

    def prepare(state):
        return state.replace(
            player_health=state.player_health.at[jnp.array([0, 2])].set(0.0),
            timestep=jnp.array([99_999, 99_999, 5, 5, 250] + 11 * [0], jnp.int32),
            boss_progress=state.boss_progress.at[3].set(BOSS_LEVEL),
        )

    return check_environment(environment, jax.random.key(3), STEPS, BATCH, prepare)


def test_achievements_are_those_of_the_game_in_its_order_and_pay_what_they_pay():
    from craftax.craftax.constants import ACHIEVEMENT_REWARD_MAP, Achievement, Action

    assert FULL_SPEC.achievements == tuple(a.name.lower() for a in sorted(Achievement, key=lambda a: a.value))
    assert FULL_SPEC.achievement_rewards == tuple(map(float, ACHIEVEMENT_REWARD_MAP))
    assert FULL_SPEC.num_actions == len(Action) == 43
    assert FULL_SPEC.action_names == tuple(a.name.lower() for a in Action)


def test_the_numbers_of_the_paper():
    """Table "Craftax-classic vs Craftax (full)" and fidelity notes 17, 22 and 34."""
    assert Counter(FULL_SPEC.achievement_rewards) == {1: 25, 3: 18, 5: 15, 8: 9}
    assert FULL_SPEC.max_return == 226 and len(FULL_SPEC.achievements) == 67
    assert FULL_SPEC.reward_classes == (0, 1, 3, 5, 8)
    assert FULL_SPEC.observation.shape == (130, 110, 3) and FULL_SPEC.observation.patch == (10, 10)


def test_death_and_victory_terminate_and_the_limit_truncates(play):
    assert play.stepped.terminated[0].tolist()[:5] == [True, False, True, True, False]
    assert play.stepped.truncated[0].tolist()[:5] == [False, True, False, False, False]


def test_random_play_achieves_and_is_counted(play):
    assert play.stepped.statistics["achievement_return"].max() >= 2
    assert play.stepped.statistics["health_return"].min() < -0.5
    assert (play.stepped.reward > 0.5).sum() >= 5


def test_a_world_does_not_depend_on_its_place_in_a_batch(environment):
    """jaxlib 0.10.2 gets this wrong on a CPU for every index from 8 on."""
    resets, _ = programs(environment, BATCH, STEPS)
    keys = jax.random.split(jax.random.key(11), BATCH)
    worlds, rolled = (resets(k, jnp.ones(BATCH, jnp.int32))[0].map for k in (keys, jnp.roll(keys, 8)))
    np.testing.assert_array_equal(worlds, np.roll(rolled, -8, axis=0))
    assert len(np.unique(np.asarray(worlds).reshape(16, -1), axis=0)) == 16


def test_built_in_auto_reset():
    """What `suite bench` compares with plays the same game: types agree with what a step returns."""
    built_in = full_built_in_auto_reset(2)
    key, action_B = jax.random.key(0), jnp.zeros(2, jnp.int32)
    first = jax.eval_shape(built_in.reset, key)
    then = jax.eval_shape(built_in.step, key, first[0], action_B)
    assert [(a.shape, a.dtype, a.weak_type) for a in jax.tree.leaves(first)] == [
        (a.shape, a.dtype, a.weak_type) for a in jax.tree.leaves(then)
    ]
    assert first[1].observation.shape == (2, 130, 110, 3)


@pytest.fixture(scope="module")
def renderers():
    """Ours and craftax's over many states, float32 in [0, 255]."""
    from craftax.craftax import constants, renderer

    original = original_renderer(constants, renderer, "make_craftax_pixel_renderer")
    return tuple(jax.jit(jax.vmap(render)) for render in (make_renderer(), original))


def arbitrary_state(key: jax.Array, state):
    """`state` with everything that is drawn made arbitrary: far denser than play ever is."""
    keys = iter(jax.random.split(key, 160))

    def integers(shape, low, high):
        return jax.random.randint(next(keys), shape, low, high)

    def chance(shape=(), p=0.5):
        return jax.random.bernoulli(next(keys), p, shape)

    level = jnp.where(chance(p=0.3), 0, integers((), 0, 9))
    edge = jnp.where(chance((2,)), integers((2,), 0, 6), 47 - integers((2,), 0, 6))
    position = jnp.where(chance(), edge, integers((2,), 0, 48))

    def scatter(mobs, kinds, p=0.8):
        crowded = jnp.where(chance(), 1, 7)  # on few tiles, or also beyond the view
        at = position[None, None] + jax.random.randint(next(keys), mobs.position.shape, -crowded, crowded + 1)
        return mobs.replace(
            position=at, mask=chance(mobs.mask.shape, p), type_id=integers(mobs.type_id.shape, 0, kinds)
        )

    directions = jnp.array([[0, 1], [0, -1], [1, 0], [-1, 0]])
    light = jax.random.uniform(next(keys))
    light = jnp.where(chance(p=0.2), jnp.array([0.0, 0.5, 1.0])[integers((), 0, 3)], light)
    quiet = chance(p=0.2)  # no monster, so that the boss can be hurt

    def count():
        return jnp.where(chance(p=0.7), integers((), 0, 12), integers((), 0, 100))

    inventory = state.inventory.replace(
        **{name: count() for name in ("wood", "stone", "coal", "iron", "diamond", "sapling", "arrows")},
        **{name: count() for name in ("torches", "ruby", "sapphire", "books")},
        pickaxe=integers((), 0, 5),
        sword=integers((), 0, 5),
        bow=integers((), 0, 2),
        armour=integers((4,), 0, 3),
        potions=jnp.stack([count() for _ in range(6)]),
    )
    ground = integers((9, 48, 48), 1, 37)
    return state.replace(
        map=jnp.where(chance(ground.shape, 0.2), NECROMANCER, ground),
        item_map=jnp.where(chance((9, 48, 48), 0.4), integers((9, 48, 48), 1, 5), 0),
        light_map=jnp.where(chance(), 1.0, jax.random.uniform(next(keys), (9, 48, 48))),
        monsters_killed=integers((9,), 0, 16),
        player_level=level,
        player_position=position,
        player_direction=integers((), 1, 5),
        is_sleeping=chance(p=0.3),
        light_level=light,
        melee_mobs=scatter(state.melee_mobs, 8, jnp.where(quiet, 0.0, 0.8)),
        ranged_mobs=scatter(state.ranged_mobs, 8, jnp.where(quiet, 0.0, 0.8)),
        passive_mobs=scatter(state.passive_mobs, 3),
        mob_projectiles=scatter(state.mob_projectiles, 8),
        player_projectiles=scatter(state.player_projectiles, 8),
        mob_projectile_directions=directions[integers((9, 3), 0, 4)],
        player_projectile_directions=directions[integers((9, 3), 0, 4)],
        boss_timesteps_to_spawn_this_round=integers((), -2, 3),
        player_health=jax.random.uniform(next(keys), maxval=14.0),
        **{f"player_{name}": integers((), 0, 18) for name in ("food", "drink", "energy", "mana")},
        **{f"player_{name}": integers((), 0, 6) for name in ("dexterity", "strength", "intelligence")},
        player_xp=integers((), 0, 14),
        inventory=inventory,
        learned_spells=chance((2,)),
        sword_enchantment=integers((), 0, 3),
        bow_enchantment=integers((), 0, 3),
        armour_enchantments=integers((4,), 0, 3),
        state_rng=next(keys),
    )


def test_frames_of_arbitrary_states(play, renderers):
    template = jax.tree.map(lambda array: jnp.asarray(array[0, 5]), play.states)
    states = jax.jit(jax.vmap(arbitrary_state, in_axes=(0, None)))(
        jax.random.split(jax.random.key(1), FRAMES), template
    )
    ours, original = (np.asarray(render(states)) for render in renderers)
    check_equal(ours, original)
    # Not by drawing nothing: all levels, nights and sleep are there, and frames differ everywhere.
    assert len(np.unique(states.player_level)) == 9 and states.is_sleeping.any() and (states.light_level < 0.1).any()
    varied = ours.std(axis=0).max(axis=-1) > 0
    assert varied[:90].all() and varied[90:].mean() > 0.3


def test_frames_of_play(play, renderers):
    """What an agent sees while it plays, and that it is what time steps carry."""
    step, index = np.divmod(np.random.default_rng(0).choice(play.ended.size, FRAMES, replace=False), BATCH)
    parts = play.states, play.shown.observation
    states, observation = jax.tree.map(lambda array: jnp.asarray(array[step, index]), parts)
    ours, original = (render(states) for render in renderers)
    check_equal(ours, original)
    drawn = step > 0  # the first frames were drawn before the states were prepared
    assert (np.asarray(observation) != np.round(original).astype(np.uint8))[drawn].mean() < 1e-5
