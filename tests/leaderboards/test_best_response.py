"""Exact values against searches that know nothing of the tables."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pyspiel
import pytest
from open_spiel.python import policy as openspiel_policy
from open_spiel.python.algorithms import exploitability as openspiel_exploitability

from leaderboards import best_response as br
from tests import games

LINES = [(0, 1, 2), (3, 4, 5), (6, 7, 8), (0, 3, 6), (1, 4, 7), (2, 5, 8), (0, 4, 8), (2, 4, 6)]


@functools.cache
def board_value(board: str, mover: str, best: str) -> float:
    """x's mean result when `best` ("x", "o" or neither) plays best and the others at random; boards as strings."""
    for line in LINES:
        marks = {board[cell] for cell in line}
        if len(marks) == 1 and marks != {" "}:
            return 1.0 if marks == {"x"} else -1.0
    free = [cell for cell, mark in enumerate(board) if mark == " "]
    if not free:
        return 0.0
    other = "o" if mover == "x" else "x"
    values = [board_value(board[:cell] + mover + board[cell + 1 :], other, best) for cell in free]
    if mover == best:
        return max(values) if best == "x" else min(values)
    return sum(values) / len(values)


def test_tic_tac_toe_is_a_search_over_boards():
    found = br.reference(games.walked("tic_tac_toe"), hidden=False)
    random, first, second = (board_value(" " * 9, "x", best) for best in ("nobody", "x", "o"))
    np.testing.assert_allclose(found.random, [random, -random], atol=1e-12)
    np.testing.assert_allclose(found.best_response, [first, -second], atol=1e-12)
    assert_is_the_constant(found, "openspiel/tic_tac_toe")


def assert_is_the_constant(found, name):
    for field in ("random", "best_response"):
        np.testing.assert_allclose(getattr(found, field), getattr(br.REFERENCE[name], field), rtol=0, atol=1e-12)


def engine_value(state, seat: int, payoff) -> float:
    """Both uniform, by enumeration of all of the engine's histories."""
    if state.is_terminal():
        return payoff(state.returns()[seat - 1])
    if state.is_chance_node():
        return sum(p * engine_value(state.child(outcome), seat, payoff) for outcome, p in state.chance_outcomes())
    legal = state.legal_actions()
    return sum(engine_value(state.child(action), seat, payoff) for action in legal) / len(legal)


@pytest.mark.parametrize("learning", [False, True])
def test_leduc_against_the_engine(learning):
    game, payoff = pyspiel.load_game("leduc_poker"), np.sign if learning else float
    found = br.reference(games.walked("leduc"), hidden=True, learning=learning)
    for seat in (1, 2):
        assert found.random[seat - 1] == pytest.approx(engine_value(game.new_initial_state(), seat, payoff), abs=1e-12)
        best = engine_best_response(game, seat, payoff)
        assert found.best_response[seat - 1] == pytest.approx(best, abs=1e-12)
    if not learning:
        assert_is_the_constant(found, "openspiel/leduc")
        # Who saw the other's card would do better: hidden information is not for nothing.
        seeing = br.reference(games.walked("leduc"), hidden=False)
        assert (np.array(seeing.best_response) > np.array(found.best_response) + 0.2).all()


def engine_best_response(game, seat: int, payoff) -> float:
    """By recursion over information states, each as all of its histories: the engine's own strings tell them apart."""

    def value(states) -> float:  # of weighted states which `seat` has not yet told apart by a decision of its own
        total = 0.0
        decisions: dict[str, list] = {}
        pending = list(states)
        while pending:
            state, weight = pending.pop()
            if state.is_terminal():
                total += weight * payoff(state.returns()[seat - 1])
            elif state.is_chance_node():
                pending += [(state.child(outcome), weight * p) for outcome, p in state.chance_outcomes()]
            elif state.current_player() == seat - 1:
                decisions.setdefault(state.information_state_string(seat - 1), []).append((state, weight))
            else:
                legal = state.legal_actions()
                pending += [(state.child(action), weight / len(legal)) for action in legal]
        for together in decisions.values():
            legal = together[0][0].legal_actions()
            total += max(value([(state.child(action), weight) for state, weight in together]) for action in legal)
        return total

    return value([(game.new_initial_state(), 1.0)])


@pytest.mark.parametrize("seat", [1, 2])
def test_information_sets_are_the_engines(seat):
    """What a player saw at its own turns, and did, tells apart exactly what the engine's information states do."""
    tables, game = games.walked("leduc"), pyspiel.load_game("leduc_poker")
    sets_D, known = br.information_sets(tables, seat)
    pairs = set()
    pending = [(game.new_initial_state(), int(tables.root))]
    while pending:
        state, node = pending.pop()
        if state.is_terminal():
            continue
        if state.current_player() == seat - 1:
            number = sets_D[node - tables.num_chance]
            pairs.add((state.information_state_string(), number))
            assert known[number].observation_TO[-1].tolist() == state.observation_tensor(seat - 1)
            assert np.flatnonzero(known[number].legal_A).tolist() == state.legal_actions()
            assert known[number].seat == seat
            own = [move.action for move in state.full_history() if move.player == seat - 1]
            assert known[number].action_T.tolist() == own
            assert len(known[number].observation_TO) == len(own) + 1
        successors = tables.successors(node)
        pending += [(state.child(event), int(successors[event])) for event in state.legal_actions()]
    strings, numbers = zip(*pairs, strict=True)
    assert len(set(strings)) == len(set(numbers)) == len(pairs) == len(known) == 468


def test_bargaining_hides_nothing_that_matters():
    """Against the uniform opponent the best that sees all values needs only what its own observation shows."""
    tables = games.walked("bargaining")
    found = br.reference(tables, hidden=False)
    assert_is_the_constant(found, "openspiel/bargaining")
    # What each gets of a uniform division is half of its values' total, 10, if there is a deal: in equal parts.
    assert found.random[0] == pytest.approx(found.random[1], abs=1e-9)
    for seat in (1, 2):
        value_N = best_values(tables, seat)
        nodes = tables.num_chance + np.flatnonzero(tables.player_N[tables.num_chance : tables.num_open] == seat)
        seen_M = np.packbits(tables.observation_2NO[seat - 1, nodes], axis=-1)
        order = np.lexsort(seen_M.T)
        same = (seen_M[order][1:] == seen_M[order][:-1]).all(-1)
        next_MA = tables.next_DA[nodes[order] - tables.num_chance]
        q_MA = np.where(next_MA >= 0, value_N[next_MA], -1).astype(np.float32)
        assert same.sum() > 1000
        np.testing.assert_allclose(q_MA[1:][same], q_MA[:-1][same], atol=1e-5)
        drawn = value_N[tables.outcome_KC[0]][tables.outcome_KC[0] >= 0]
        assert drawn.mean() == pytest.approx(found.best_response[seat - 1], abs=1e-9)


def best_values(tables, seat):
    """Every node's value for a `seat` that sees all, by repeating one step until nothing changes."""
    value_N = tables.return_2N[seat - 1].astype(np.float64)
    first, last = tables.num_chance, tables.num_open
    legal_DA = tables.next_DA >= 0
    count_D, ours_D = legal_DA.sum(-1), tables.player_N[first:last] == seat
    flat, starts_D = tables.next_DA[legal_DA], count_D.cumsum() - count_D
    while True:
        q = value_N[flat]
        new_D = np.where(ours_D, np.maximum.reduceat(q, starts_D), np.add.reduceat(q, starts_D) / count_D)
        if (new_D == value_N[first:last]).all():
            return value_N
        value_N[first:last] = new_D


def test_exploitability_is_the_engines():
    game, tables = pyspiel.load_game("leduc_poker"), games.walked("leduc")
    assert br.exploitability(tables, lambda known: known.legal_A / known.legal_A.sum()) == pytest.approx(
        openspiel_exploitability.exploitability(game, openspiel_policy.UniformRandomPolicy(game)), abs=1e-9
    )

    def aggressive(observation_O, legal_A):
        """Depends on the own card and the pot, which observations show."""
        weight_A = np.arange(1, 4) ** (1.0 + 0.2 * np.argmax(observation_O[2:8])) * (1 + observation_O[14:16].sum())
        weight_A[0] += observation_O[14]
        return legal_A * weight_A / (legal_A * weight_A).sum()

    class Aggressive(openspiel_policy.Policy):
        def action_probabilities(self, state, player_id=None):
            player = state.current_player() if player_id is None else player_id
            legal = state.legal_actions(player)
            probabilities = aggressive(np.array(state.observation_tensor(player)), np.isin(np.arange(3), legal))
            return {action: probabilities[action] for action in legal}

    theirs = openspiel_exploitability.exploitability(game, Aggressive(game, [0, 1]))
    ours = br.exploitability(tables, lambda known: aggressive(known.observation_TO[-1].astype(float), known.legal_A))
    assert ours == pytest.approx(theirs, abs=1e-9) and ours > 0.5


@pytest.mark.parametrize("policy", [lambda known: np.ones(3) / 3, lambda known: known.legal_A / 4.0])
def test_exploitability_refuses_what_is_no_policy(policy):
    with pytest.raises(ValueError, match="legal actions"):
        br.exploitability(games.walked("leduc"), policy)


def test_information_sets_need_a_tree():
    with pytest.raises(ValueError, match="whole tree"):
        br.information_sets(games.walked("tic_tac_toe"), 1)


def test_levels_refuse_a_state_at_two_depths():
    tables = games.walked("tic_tac_toe")
    next_DA = tables.next_DA.copy()
    next_DA[0, 0] = tables.next_DA[tables.next_DA[0, 1], 0]  # skips a move
    with pytest.raises(ValueError, match="numbers of events"):
        br.levels(dataclasses.replace(tables, next_DA=next_DA))


def test_normalized():
    assert br.normalized(0.5, 0.5, 2.0) == 0 and br.normalized(2.0, 0.5, 2.0) == 1 and br.normalized(-1, 0.5, 2.0) == -1
