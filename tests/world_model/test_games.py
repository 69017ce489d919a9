"""Two players and chance in a world model: what its heads learn, and the dream that plays by it."""

from __future__ import annotations

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from suite import registry
from suite.diagnostics.watching import MOVERS, play, told
from suite.interface.turns import Turn
from suite.world_model.heads import TurnLogits
from suite.world_model.imagination import next_turn
from suite.world_model.training import turn_losses
from tests.tiny import PENNIES
from tests.world_model.pennies import learned, played


def test_the_stream_of_a_game():
    agent, *_ = played()
    tokens = agent.tokens
    assert (tokens.tokens_per_frame, tokens.num_codes, tokens.num_actions) == (4, 4, 2 + 2 + 3)
    assert (tokens.player_actions, tokens.chance_outcomes, tokens.placed) == (2, 3, True)


def test_the_rules_are_learned():
    *_, metrics = learned()
    assert metrics["changed_token_accuracy"] > 0.95  # who is next, and how the coin fell
    assert metrics["player_accuracy"] > 0.99 and metrics["legal_accuracy"] > 0.99
    assert metrics["reward_accuracy"] > 0.95
    assert 0 <= metrics["chance_excess"] < 0.01 and metrics["chance_loss"] == pytest.approx(np.log(2), abs=0.01)


def test_the_dream_plays_by_the_rules():
    """Chance, player 1 and player 2 take turns; each seat's reward is its own, and follows from coin and guess."""
    agent, state, replay, model, _ = learned()
    dreamed = jax.jit(lambda key: agent.dream(
        state.policy, nnx.merge(agent.world_model_graph, model.params), state.tokenizer, replay, key
    ))(jax.random.key(7))  # fmt: skip
    turn = dreamed.turn_TB
    player = np.asarray(turn.player)
    in_turn = player[1:] == (player[:-1] + 1) % 3
    assert in_turn.mean() > 0.97
    assert set(np.asarray(turn.seat).ravel()) == {1, 2}
    np.testing.assert_array_equal(turn.seat, np.broadcast_to(turn.seat[:1], player.shape))
    legal = np.asarray(turn.legal_A)
    assert (legal[player == 0] == 0).all()
    assert (legal[player == 1] == [True, True]).all(-1).mean() > 0.97
    assert (legal[player == 2] == [True, False]).all(-1).mean() > 0.97
    chance = np.asarray(turn.chance_C)
    np.testing.assert_allclose(chance.sum(-1), player == 0, atol=1e-5)
    np.testing.assert_allclose(chance[player == 0].mean(0), [0.5, 0, 0.5], atol=0.05)
    np.testing.assert_array_equal(dreamed.acting_TB, player == np.asarray(turn.seat))
    paid = np.asarray(dreamed.reward_TB) != 0
    assert (paid == (player == 2)).mean() > 0.95

    # Coin (in player 1's observation) and guess decide who is paid.
    right, total = 0, 0
    for t, b in zip(*np.nonzero(player[1:-1] == 1), strict=True):
        seat = int(turn.seat[t + 1, b])
        of_1 = dreamed.observation_TB if seat == 1 else turn.opponent_observation
        won = (int(of_1[t + 1, b, 1]) - 1 == int(dreamed.action_TB[t + 1, b])) == (seat == 1)
        right += float(dreamed.reward_TB[t + 2, b]) == (1 if won else -1)
        total += 1
    assert total > 20 and right / total > 0.9


def test_what_the_opponent_sees_never_reaches_our_policy():
    """Not in acting and not in learning: other observations of the opponent's, and other odds, change nothing."""
    agent, state, _, trajectory = played()
    other = trajectory.replace(
        turn_TB=trajectory.turn_TB.replace(
            opponent_observation=3 - trajectory.turn_TB.opponent_observation,
            chance_C=jnp.ones_like(trajectory.turn_TB.chance_C),
        )
    )
    steps = jnp.array([0.0, 32.0])
    fresh = jax.tree.map(jnp.copy, (state.policy, state.policy))
    learners = [agent.learn(mine, t, steps)[0] for mine, t in zip(fresh, (trajectory, other), strict=True)]
    chex.assert_trees_all_equal(*learners)

    player = jax.tree.map(jnp.copy, state.rollout)
    shown = player.time_step
    hidden = shown.replace(turn=shown.turn.replace(opponent_observation=3 - shown.turn.opponent_observation))
    results = [
        agent.collect(state.policy.acting, jax.tree.map(jnp.copy, player.replace(time_step=x)), jax.random.key(3))[1]
        for x in (shown, hidden)
    ]
    chex.assert_trees_all_equal(*(t.action_TB for t in results))
    chex.assert_trees_all_equal(*(t.value_TB for t in results))


def test_one_action_is_always_legal_and_nobody_moves_for_chance():
    n = 1000
    logits = TurnLogits(
        player=jnp.zeros((n, 3)), legal=jnp.tile(jnp.array([[-3.0, -1.0, -2.0]]), (n, 1)), chance=jnp.zeros((n, 2))
    )
    turn = next_turn(jax.random.key(0), logits, jnp.ones(n, jnp.int32), jnp.zeros((n, 1), jnp.uint8))
    player = np.asarray(turn.player)
    assert (np.bincount(player) > n / 4).all()
    assert (np.asarray(turn.legal_A)[player > 0] == [False, True, False]).all()
    assert not np.asarray(turn.legal_A)[player == 0].any()
    np.testing.assert_allclose(turn.chance_C.max(-1), np.where(player == 0, 0.5, 0.0))


def test_chance_never_acts_in_a_game_without_it():
    n = 500
    logits = TurnLogits(player=jnp.zeros((n, 3)).at[:, 0].set(9.0), legal=jnp.ones((n, 3)), chance=jnp.zeros((n, 0)))
    turn = next_turn(jax.random.key(0), logits, jnp.ones(n, jnp.int32), jnp.zeros((n, 1), jnp.uint8))
    assert set(np.asarray(turn.player)) == {1, 2}


def test_losses_of_turns_against_numpy():
    rng = np.random.default_rng(0)
    logits = TurnLogits(*(jnp.asarray(rng.normal(size=(4, 3, k)), jnp.float32) for k in (3, 5, 2)))
    player = rng.integers(0, 3, (4, 3))
    odds = np.where((player == 0)[..., None], rng.dirichlet([1, 1], (4, 3)), 0)
    legal = (rng.random((4, 3, 5)) < 0.5) & (player != 0)[..., None]
    weight = (rng.random((4, 3)) < 0.8).astype(np.float32)
    none = jnp.zeros((4, 3))
    turn = Turn(jnp.asarray(player), none, jnp.asarray(legal), jnp.asarray(odds, jnp.float32), none)
    total, metrics = turn_losses(logits, turn, jnp.asarray(weight))

    def log_softmax(x):
        return x - np.log(np.exp(x).sum(-1, keepdims=True))

    def mean(x, w):
        return (x * w).sum() / w.sum()

    of_player, of_legal, of_chance = (np.asarray(x, np.float64) for x in (logits.player, logits.legal, logits.chance))
    next_player = mean(-np.take_along_axis(log_softmax(of_player), player[..., None], -1)[..., 0], weight)
    p = 1 / (1 + np.exp(-of_legal))
    next_legal = mean(-np.where(legal, np.log(p), np.log(1 - p)).mean(-1), weight * (player != 0))
    next_chance = mean(-(odds * log_softmax(of_chance)).sum(-1), weight * (player == 0))
    np.testing.assert_allclose(
        [metrics["player_loss"], metrics["legal_loss"], metrics["chance_loss"]],
        [next_player, next_legal, next_chance],
        rtol=1e-4,
    )
    assert total == pytest.approx(next_player + next_legal + next_chance, rel=1e-4)
    entropy = mean(-(odds * np.log(np.where(odds > 0, odds, 1))).sum(-1), weight * (player == 0))
    assert metrics["chance_excess"] == pytest.approx(next_chance - entropy, rel=1e-3)


def test_the_film_of_a_game(monkeypatch):
    """`suite watch`: chance, then both players, whichever is ours; where a game has no text, its symbols' values."""
    monkeypatch.setattr(registry, "TASKS", (PENNIES,))
    agent, state, *_ = played()
    episodes = play(agent, state.policy, jax.random.key(3), 2, 9)
    movers = [[MOVERS[mover] for mover in episode.mover] for episode in episodes]
    assert movers == [["chance", "agent", "opponent"], ["chance", "opponent", "agent"]]
    notes, texts = told(episodes, agent.spec)
    assert len(notes) == len(texts) == 6
    assert notes[0].startswith(f"episode 1, step 1: chance: action {episodes[0].action[0]}\nreturn ")
    assert [list(map(int, text.split())) for text in texts[:3]] == episodes[0].frames.tolist()
