"""Our frames are craftax's frames, pixel by pixel."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from adapters.craftax.classic_renderer import make_renderer
from adapters.craftax.tiles import uniform
from tests.adapters.craftax.frames import check_equal, original_renderer
from tests.adapters.craftax.worlds import arbitrary_state

FRAMES = 512


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
