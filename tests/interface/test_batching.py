"""Exact auto-reset, compared with a loop over single environments; Craftax's own is in tests/contract.py."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from suite.interface.batching import Batched
from tests.tiny import Corridor, Pennies

BATCH = 5


def select(tree, index):
    return jax.tree.map(lambda array: array[index], tree)


def assert_equal(actual, expected):
    jax.tree.map(np.testing.assert_array_equal, actual, expected)


def reset(environment, key, index):
    return environment.reset(key, jnp.int32(1 + index % 2)) if environment.spec.two_player else environment.reset(key)


def one_by_one(environment, key, states, action_B):
    """The documented meaning of `Batched.step`, without vmap or loops of JAX."""
    step_keys, reset_keys = jax.random.split(key, (2, BATCH))
    results = []
    for index in range(BATCH):
        state, shown = environment.step(step_keys[index], select(states, index), action_B[index])
        if shown.terminated or shown.truncated:
            state, fresh = reset(environment, reset_keys[index], index)
            shown = shown.replace(observation=fresh.observation, first=fresh.first, turn=fresh.turn)
        results.append((state, shown))
    return jax.tree.map(lambda *arrays: jnp.stack(arrays), *results)


def follow(environment, steps):
    batched = Batched(environment, BATCH)
    key = jax.random.key(0)
    states, shown = batched.reset(key)
    singles = [reset(environment, key, index) for index, key in enumerate(jax.random.split(key, BATCH))]
    assert_equal((states, shown), jax.tree.map(lambda *arrays: jnp.stack(arrays), *singles))
    step, seen = jax.jit(batched.step), []
    for key in jax.random.split(jax.random.key(1), steps):
        action_B = jax.random.randint(key, (BATCH,), 0, 2)
        expected = one_by_one(environment, key, states, action_B)
        states, shown = step(key, states, action_B)
        assert_equal((states, shown), expected)
        seen.append(shown)
    assert step._cache_size() == 1
    return jax.tree.map(lambda *arrays: jnp.stack(arrays), *seen)


def test_corridor_one_by_one():
    seen = follow(Corridor(limit=4), 30)
    ended_B = np.asarray(seen.terminated | seen.truncated).sum(axis=1)
    assert seen.terminated.any() and seen.truncated.any()
    assert {0, 1, 2} <= set(ended_B.tolist())  # none, one, several at once


def test_turns_are_those_of_the_new_episode():
    seen = follow(Pennies(), 9)
    assert seen.turn.player[seen.terminated].tolist() == [0] * 15
    assert (np.asarray(seen.turn.seat) == [1, 2, 1, 2, 1]).all()  # an environment keeps its seat


def test_all_end_at_once():
    seen = follow(Corridor(limit=1), 3)
    assert seen.first.all()


def test_under_an_outer_vmap_over_seeds():
    batched = Batched(Corridor(), BATCH)

    def play(key):
        def step(carry, key):
            state, shown = batched.step(key, carry, jax.random.randint(key, (BATCH,), 0, 2))
            return state, shown

        return jax.lax.scan(step, batched.reset(key)[0], jax.random.split(key, 12))

    keys = jax.random.split(jax.random.key(3), 3)
    together = jax.jit(jax.vmap(play))(keys)
    assert together[1].first.any()
    for index, key in enumerate(keys):
        assert_equal(select(together, index), jax.jit(play)(key))
