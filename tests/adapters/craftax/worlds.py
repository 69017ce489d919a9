"""States of Craftax-classic that play hardly reaches."""

from __future__ import annotations

import jax
import jax.numpy as jnp


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
