"""Our frames are craftax's frames, pixel by pixel."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from adapters.craftax.classic_renderer import make_renderer
from adapters.craftax.tiles import uniform
from tests.adapters.craftax.frames import check_equal, original_renderer

FRAMES = 512


def arbitrary_state(key: jax.Array, state):
    """`state` with everything that is drawn made arbitrary: far denser than play ever is."""
    keys = iter(jax.random.split(key, 64))

    def integers(shape, low, high):
        return jax.random.randint(next(keys), shape, low, high)

    def chance(shape, p=0.5):
        return jax.random.bernoulli(next(keys), p, shape)

    edge = jnp.where(chance((2,)), integers((2,), 0, 4), 63 - integers((2,), 0, 4))
    position = jnp.where(chance(()), edge, integers((2,), 0, 64))

    def scatter(mobs):
        count = mobs.mask.shape[0]
        crowded = jnp.where(chance(()), 1, 6)  # on few tiles, or also beyond the view
        at = position[None] + jax.random.randint(next(keys), (count, 2), -crowded, crowded + 1)
        return mobs.replace(position=at, mask=chance((count,), 0.8))

    light = jax.random.uniform(next(keys))
    light = jnp.where(chance((), 0.2), jnp.array([0.0, 0.5, 1.0])[integers((), 0, 3)], light)
    inventory = jax.tree.map(lambda _: integers((), 0, 10), state.inventory)
    directions = jnp.array([[0, 1], [0, -1], [1, 0], [-1, 0], [1, 1], [0, 0]])
    return state.replace(
        map=integers((64, 64), 0, 17),
        player_position=position,
        player_direction=integers((), 1, 5),
        is_sleeping=chance((), 0.3),
        light_level=light,
        zombies=scatter(state.zombies),
        cows=scatter(state.cows),
        skeletons=scatter(state.skeletons),
        arrows=scatter(state.arrows),
        arrow_directions=directions[integers((3,), 0, 6)],
        player_health=integers((), 0, 10),
        player_food=integers((), 0, 10),
        player_drink=integers((), 0, 10),
        player_energy=integers((), 0, 10),
        inventory=inventory,
        state_rng=next(keys),
    )


@pytest.fixture(scope="module")
def renderers():
    """Both renderers over 512 states: ours and craftax's, float32 in [0, 255]."""
    from craftax.craftax_classic import constants, renderer

    original = original_renderer(constants, renderer, "make_craftax_pixel_renderer")
    return tuple(jax.jit(jax.vmap(render)) for render in (make_renderer(), original))


def test_arbitrary_states(environment, renderers):
    template = jax.jit(environment.reset)(jax.random.key(0))[0]
    keys = jax.random.split(jax.random.key(1), FRAMES)
    states = jax.jit(jax.vmap(arbitrary_state, in_axes=(0, None)))(keys, template)
    ours, original = renderers
    check_equal(ours(states), original(states))
    # Not by drawing nothing: the player's own tile differs from the map's, nights and sleep are there.
    assert states.is_sleeping.any() and (states.light_level < 0.1).any() and (states.light_level == 1).any()


def test_play_at_all_hours(play, renderers):
    """What an agent sees while it plays: day, night, sleep, creatures."""
    step, index = np.divmod(np.random.default_rng(0).choice(play.ended.size, FRAMES, replace=False), 8)
    parts = play.states, play.shown.observation
    states, observation = jax.tree.map(lambda array: jnp.asarray(array[step, index]), parts)
    ours, original = (render(states) for render in renderers)
    # The prepared lava is under the player from step 0 on, but was not there when the first frames were drawn.
    check_equal(ours, original)
    drawn = step > 0
    assert (np.asarray(observation) != np.round(original).astype(np.uint8))[drawn].mean() < 1e-5
    assert (states.light_level < 0.2).any() and (states.light_level > 0.95).any()
    assert states.is_sleeping.any() and (states.zombies.mask | states.cows.mask).any()


@pytest.mark.parametrize("shape", [(49, 63), (7,), (1, 3)])
def test_the_nights_noise_is_the_number_stream_of_jax(shape):
    for seed in range(20):
        key = jax.random.key(seed)
        expected = jax.random.uniform(key, shape)
        np.testing.assert_array_equal(uniform(key, shape), expected)
        np.testing.assert_array_equal(uniform(jax.random.key_data(key), shape), expected)
