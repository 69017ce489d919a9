"""What frames of Craftax-classic show: craftax's own symbolic observation, but for what the pixels hide."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from adapters.craftax.classic_renderer import ITEMS, NEEDS
from adapters.craftax.symbols import ARROW, PLAYER, VALUES, classic_symbols
from adapters.numerics import loose_numerics
from suite import registry
from tests.adapters.craftax.worlds import arbitrary_state

BLOCKS, CREATURES, COUNTS = slice(0, 63), slice(63, 126), slice(126, 142)
FACING, ASLEEP, DAYLIGHT = 142, 143, 144


@pytest.fixture(scope="module")
def state(environment):
    return jax.jit(environment.reset)(jax.random.key(0))[0]


@pytest.fixture(scope="module")
def states(state):
    """Sixty-four arbitrary states, whose worlds lack the number that stands for what is hidden."""
    many = jax.jit(jax.vmap(arbitrary_state, in_axes=(0, None)))(jax.random.split(jax.random.key(3), 64), state)
    return many.replace(map=jnp.maximum(many.map, 1))


def test_as_craftax_says(states):
    from craftax.craftax_classic.renderer import render_craftax_symbolic

    day = states.replace(light_level=jnp.ones(64))
    symbols = np.asarray(jax.jit(jax.vmap(classic_symbols))(day))
    assert symbols.shape == (64, 145) and symbols.dtype == np.int32
    assert symbols.min() >= 0 and symbols.max() < VALUES == registry.task("craftax_classic").symbol_values
    with loose_numerics():
        theirs = np.asarray(jax.vmap(render_craftax_symbolic)(day), np.float32)
    tiles = theirs[:, : 63 * 21].reshape(64, 63, 21)
    assert (tiles[..., :17].argmax(-1) == symbols[:, BLOCKS]).all()
    # Of those on a tile, zombie, cow, skeleton, arrow, the last is seen; the player, on the middle one, under them all.
    seen = (tiles[..., 17:] * np.arange(2, 6)).max(-1)
    seen[:, 31] = np.maximum(seen[:, 31], PLAYER)
    assert (seen == symbols[:, CREATURES]).mean() > 0.98  # craftax forgets one whose dead double stands on its tile
    assert {0, PLAYER, ARROW} <= set(symbols[:, CREATURES].flat)
    for i, name in enumerate(NEEDS):
        assert (symbols[:, COUNTS][:, i] == getattr(day, f"player_{name}")).all()
    for i, name in enumerate(ITEMS):
        assert (symbols[:, COUNTS][:, 4 + i] == getattr(day.inventory, name)).all()
    asleep = np.asarray(day.is_sleeping)
    assert (symbols[:, ASLEEP] == asleep).all() and asleep.any() and not asleep.all()
    assert (symbols[:, FACING] == np.where(asleep, 0, day.player_direction)).all()
    assert (symbols[:, DAYLIGHT] == 2).all()


def test_what_the_night_hides(states):
    state = jax.tree.map(lambda x: x[0], states)

    def at(light):
        return np.asarray(classic_symbols(state.replace(light_level=jnp.float32(light))))

    day, dusk, night = at(1), at(0.5), at(0)
    assert (day[BLOCKS] == dusk[BLOCKS]).all() and (day[BLOCKS] > 0).all()
    hidden = night[BLOCKS].reshape(7, 9) == 0
    assert hidden[0, 0] and hidden[0].sum() == 9 and not hidden[3, 2:7].any()  # noise lies over the edges
    assert (hidden == hidden[::-1, ::-1]).all()
    assert (night[CREATURES].reshape(7, 9)[hidden] == 0).all()
    assert (night[BLOCKS].reshape(7, 9)[~hidden] == day[BLOCKS].reshape(7, 9)[~hidden]).all()
    assert [x[DAYLIGHT] for x in (day, dusk, night)] == [2, 1, 0]
    assert (night[COUNTS] == day[COUNTS]).all()


def test_beyond_the_edge(state):
    corner = state.replace(player_position=jnp.zeros(2, jnp.int32), light_level=jnp.float32(1))
    blocks = np.asarray(classic_symbols(corner))[BLOCKS].reshape(7, 9)
    assert (blocks[:3] == 1).all() and (blocks[:, :4] == 1).all()
    assert (blocks[3:, 4:] == np.asarray(state.map)[:4, :5]).all()
