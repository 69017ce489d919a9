"""The games of OpenSpiel, walked once for all tests, and played at random."""

from __future__ import annotations

import functools
import tempfile

import jax
import jax.numpy as jnp
import pytest

from adapters import openspiel
from adapters.game_tables import Tables
from suite.interface.batching import Batched
from suite.interface.turns import choose_event


@functools.cache
def walked(name: str) -> Tables:
    """From the engine, not from the user's cache folder."""
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        patch.setenv("SUITE_CACHE_DIR", folder)
        return openspiel.walked(name)


@functools.cache
def game(name: str) -> openspiel.TableGame:
    tables = walked(name)
    return openspiel.TableGame(openspiel._SPECS.get(name) or openspiel._measure(name, tables), tables)


def play(name: str, steps: int, num_envs: int, seed: int = 0):
    """Random events, all that is legal being as likely: what was shown [T, B], the events and what they led to."""
    batched = Batched(game(name), num_envs)

    def event(carry, key):
        state, shown = carry
        action_key, turn_key, step_key = jax.random.split(key, 3)
        action_B = jax.random.categorical(action_key, jnp.where(shown.turn.legal_A, 0.0, -jnp.inf)).astype(jnp.int32)
        event_B = choose_event(turn_key, shown.turn, action_B)
        state, stepped = batched.step(step_key, state, event_B)
        return (state, stepped), (shown, event_B, stepped)

    @jax.jit
    def run(key):
        reset_key, steps_key = jax.random.split(key)
        return jax.lax.scan(event, batched.reset(reset_key), jax.random.split(steps_key, steps))[1]

    return jax.device_get(run(jax.random.key(seed)))
