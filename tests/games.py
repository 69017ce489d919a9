"""The games of OpenSpiel, walked once for all tests, played at random and compared with the engine."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np

from adapters.openspiel import task as openspiel
from adapters.openspiel.tables import Tables
from suite.interface.batching import Batched
from suite.interface.turns import choose_event


@functools.cache
def walked(name: str) -> Tables:
    """The game's tables, once for each process."""
    return openspiel.walked(name)


@functools.cache
def game(name: str) -> openspiel.TableGame:
    tables = walked(name)
    return openspiel.TableGame(openspiel.SPECS.get(name) or openspiel.measured(name, tables), tables)


def play(environment, steps: int, num_envs: int, seed: int = 0):
    """Random events, all that is legal being as likely: what was shown [T, B], the events and what they led to."""
    batched = Batched(environment, num_envs)

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


def check_against_engine(played, game, signs: bool) -> int:
    """Asserts that what `play` returned is what the engine does with these events; how many games ended.

    `signs`: a game's end pays the sign of its return.
    """
    shown, event, stepped = played
    steps, num_envs = event.shape
    ends = 0
    for i in range(num_envs):
        seat = 1 + i % 2
        state, first = game.new_initial_state(), True
        for t in range(steps):
            turn = jax.tree.map(lambda array: array[t, i], shown.turn)  # noqa: B023
            chance = state.is_chance_node()
            assert (turn.player, turn.seat) == (0 if chance else state.current_player() + 1, seat)
            assert shown.observation[t, i].tolist() == state.observation_tensor(seat - 1)
            assert turn.opponent_observation.tolist() == state.observation_tensor(2 - seat)
            assert np.flatnonzero(turn.legal_A).tolist() == ([] if chance else state.legal_actions())
            likely = dict(state.chance_outcomes()) if chance else {}
            assert np.flatnonzero(turn.chance_C).tolist() == sorted(likely)
            np.testing.assert_allclose(turn.chance_C[sorted(likely)], [likely[c] for c in sorted(likely)], rtol=1e-6)
            assert shown.first[t, i] == first
            assert event[t, i] in (likely or state.legal_actions())
            state.apply_action(int(event[t, i]))
            first = state.is_terminal()
            raw = state.returns()[seat - 1]
            assert stepped.terminated[t, i] == first and not stepped.truncated[t, i]
            assert stepped.final_observation[t, i].tolist() == state.observation_tensor(seat - 1)
            assert stepped.statistics["raw_return"][t, i] == raw
            assert stepped.statistics["seat"][t, i] == seat
            assert stepped.reward[t, i] == (0 if not first else np.sign(raw) if signs else raw)
            if first:
                state = game.new_initial_state()
                ends += 1
    return ends
