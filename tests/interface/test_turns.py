from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from suite.interface.turns import CHANCE, Turn, choose_event, stream_action

N = 4000


def turns(player, legal, chance, seat=1):
    return Turn(
        player=jnp.full(N, player, jnp.int32),
        seat=jnp.full(N, seat, jnp.int32),
        legal_A=jnp.tile(jnp.array(legal, bool), (N, 1)),
        chance_C=jnp.tile(jnp.array(chance, jnp.float32), (N, 1)),
        opponent_observation=jnp.zeros((N, 1), jnp.uint8),
    )


def events(turn, action=2, seed=0):
    return jax.jit(choose_event)(jax.random.key(seed), turn, jnp.full(N, action, jnp.int32))


def shares(event, count):
    return np.bincount(event, minlength=count) / N


@pytest.mark.parametrize("seat", [1, 2])
def test_ours_passes_through(seat):
    turn = turns(seat, [True, True, True], [0.0, 0.0], seat)
    event = events(turn)
    assert event.dtype == jnp.int32
    assert (event == 2).all() and turn.ours.all()


@pytest.mark.parametrize(("player", "seat"), [(2, 1), (1, 2)])
def test_the_opponent_is_uniform_over_its_legal_actions(player, seat):
    event = events(turns(player, [True, False, True, True, False], [0.0, 0.0], seat), action=1)
    np.testing.assert_allclose(shares(event, 5), [1 / 3, 0, 1 / 3, 1 / 3, 0], atol=0.04)
    assert not np.isin(event, [1, 4]).any()


def test_chance_follows_its_probabilities():
    event = events(turns(CHANCE, [False, False, False], [0.1, 0.0, 0.6, 0.3]), action=1)
    np.testing.assert_allclose(shares(event, 4), [0.1, 0, 0.6, 0.3], atol=0.04)
    assert not (event == 1).any()


@pytest.mark.parametrize("outcomes", [64, 65, 1002])
def test_chance_follows_its_probabilities_among_many_outcomes(outcomes):
    """Those that a program draws in one go and those that it draws group by group; most cannot happen."""
    likely = np.zeros(outcomes)
    likely[[0, 1, outcomes // 2, outcomes - 1]] = 0.1, 0.4, 0.3, 0.2
    event = events(turns(CHANCE, [False, False, False], likely.tolist()))
    np.testing.assert_allclose(shares(event, outcomes), likely, atol=0.04)
    assert (likely[event] > 0).all()


def test_a_mixed_batch_goes_to_each_its_own():
    player = jnp.arange(N, dtype=jnp.int32) % 3
    turn = turns(1, [True, True, True], [0.0, 1.0]).replace(
        player=player,
        legal_A=(player > 0)[:, None] & jnp.array([[False, False, True]]),
        chance_C=jnp.where((player == CHANCE)[:, None], jnp.array([[0.0, 1.0]]), 0.0),
    )
    event = events(turn, action=0)
    np.testing.assert_array_equal(event, np.array([1, 0, 2])[np.asarray(player)])


def test_keys_decide():
    turn = turns(2, [True, True], [0.0, 0.0])
    np.testing.assert_array_equal(events(turn, seed=1), events(turn, seed=1))
    assert (events(turn, seed=1) != events(turn, seed=2)).any()


def test_no_two_players_share_an_action_of_the_stream():
    seen = {int(stream_action(turns(p, [1, 1, 1], [0.5, 0.5]), jnp.full(N, a))[0]) for p in (1, 2) for a in range(3)}
    assert seen == set(range(6))
    assert [int(stream_action(turns(CHANCE, [0, 0, 0], [0.5, 0.5]), jnp.full(N, c))[0]) for c in (0, 1)] == [6, 7]


def test_a_game_without_chance():
    assert (events(turns(2, [False, True], [])) == 1).all()
