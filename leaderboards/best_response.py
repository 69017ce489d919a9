"""What a two-player game's return is worth: exact values on the game's tables, in NumPy.

Shapes: N nodes (K chance's, then D players', then ends) and A actions as in `adapters.openspiel.tables`; M nodes of one
level, G information sets.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:  # scoring needs `REFERENCE` only, and no adapter
    from adapters.openspiel.tables import Tables


@dataclasses.dataclass(frozen=True)
class Reference:
    """Exact mean returns against the uniform random opponent, in the game's own units, of seat 1 and of seat 2.

    Attributes:
      random: of the uniform random player.
      best_response: of the best player there is, who knows that the opponent is uniform but sees only what its seat
        sees.
    """

    random: tuple[float, float]
    best_response: tuple[float, float]


# Computed by `reference` from open_spiel 2.0.2.
REFERENCE = {
    "openspiel/tic_tac_toe": Reference(
        (0.29682539682539677, -0.29682539682539677), (0.9947916666666666, 0.924867724867725)
    ),
    "openspiel/leduc": Reference((-0.078125, 0.078125), (2.0875, 2.6597222222222223)),
    "openspiel/bargaining": Reference((1.7276355129647833, 1.7276355129647833), (8.051626875317885, 8.25731499938787)),
}


def normalized(mean_return: float, random: float, best_response: float) -> float:
    """A mean return on the scale where 0 is the uniform random player and 1 the exact best response."""
    return (mean_return - random) / (best_response - random)


@dataclasses.dataclass(frozen=True)
class Information:
    """What a player knows who forgets nothing: the T turns of its own so far, the last of which is now.

    Attributes:
      seat: which player it is, 1 or 2.
      observation_TO: uint8, what it saw when it was to act.
      action_T: int32 [T - 1], what it did.
      legal_A: bool, what it may do now.
    """

    seat: int
    observation_TO: np.ndarray
    action_T: np.ndarray
    legal_A: np.ndarray


def reference(tables: Tables, hidden: bool, learning: bool = False) -> Reference:
    """The exact values of a game.

    Args:
      tables: the game's.
      hidden: whether what a seat cannot see matters to what it should do; then its best response is searched over
        its information sets, for which the tables must be a tree. Not in tic-tac-toe, where all is seen. Nor in
        bargaining against a uniform opponent, though values are private there: what the opponent may do depends on
        the pool and on whether there is an offer, so its moves tell nothing of its values; and what a deal pays us
        depends on our values and the offer. So the best action is a function of pool, own values, turn and last
        offer, all of them in our observation, and the best response that sees everything gains nothing by it.
      learning: values of the sign of the return, which is what Leduc is learned from, instead of the return.

    Raises:
      ValueError: the tables are not layered by depth, or `hidden` and no tree.
    """
    payoff_2N = np.sign(tables.return_2N) if learning else tables.return_2N
    sets_D = [information_sets(tables, seat)[0] if hidden else None for seat in (1, 2)]
    random = [float(values(tables, payoff_N)[tables.root]) for payoff_N in payoff_2N]
    best = [best_response(tables, seat, payoff_2N[seat - 1], None, sets_D[seat - 1]) for seat in (1, 2)]
    return Reference((random[0], random[1]), (best[0], best[1]))


def values(tables: Tables, payoff_N: np.ndarray, policy_DA: np.ndarray | None = None) -> np.ndarray:
    """float64 [N]: the expected payoff from each node on.

    Args:
      tables: the game's.
      payoff_N: what each end pays.
      policy_DA: both players' action probabilities; None: uniform over what is legal.
    """
    value_N = payoff_N.astype(np.float64)
    for level in reversed(levels(tables)):
        _draw(tables, level, value_N)
        nodes, q_MA = _decisions(tables, level, value_N)
        value_N[nodes] = (_policy(tables, nodes, policy_DA) * q_MA).sum(-1)
    return value_N


def best_response(
    tables: Tables,
    seat: int,
    payoff_N: np.ndarray,
    policy_DA: np.ndarray | None = None,
    sets_D: np.ndarray | None = None,
) -> float:
    """The largest expected payoff that `seat` can reach against the other's fixed policy.

    Args:
      tables: the game's.
      seat: 1 or 2.
      payoff_N: what each end pays this seat.
      policy_DA: the other's action probabilities (this seat's rows do not matter); None: uniform.
      sets_D: this seat's information set at each of its nodes: it must act alike in all nodes of a set. None: it sees
        the node.

    Raises:
      ValueError: nodes of one information set lie at different depths.
    """
    reach_N = _reach(tables, seat, policy_DA)
    value_N = payoff_N.astype(np.float64)
    searched: list[np.ndarray] = []
    for level in reversed(levels(tables)):
        _draw(tables, level, value_N)
        nodes, q_MA = _decisions(tables, level, value_N)
        legal_MA = tables.next_DA[nodes - tables.num_chance] >= 0
        value_M = (_policy(tables, nodes, policy_DA) * q_MA).sum(-1)
        ours_M = tables.player_N[nodes] == seat
        masked_MA = np.where(legal_MA, q_MA, -np.inf)
        if sets_D is None:
            best_M = masked_MA.argmax(-1)
        else:
            sets, set_M = np.unique(np.where(ours_M, sets_D[nodes - tables.num_chance], -1), return_inverse=True)
            weighted_GA = np.zeros((len(sets), q_MA.shape[-1]))
            np.add.at(weighted_GA, set_M, reach_N[nodes][:, None] * q_MA)
            # What is legal is the same throughout a set: a player sees it.
            best_M = np.where(legal_MA, weighted_GA[set_M], -np.inf).argmax(-1)
            searched.append(sets[sets >= 0])
        value_N[nodes] = np.where(ours_M, masked_MA[np.arange(len(nodes)), best_M], value_M)
    if searched and len(np.unique(np.concatenate(searched))) != sum(map(len, searched)):
        raise ValueError("an information set has nodes at different depths")
    return float(value_N[tables.root])


def information_sets(tables: Tables, seat: int) -> tuple[np.ndarray, list[Information]]:
    """What `seat` can tell apart when it is to act, remembering all its earlier turns.

    Returns:
      int64 [D]: the information set of each of its nodes, -1 at the other's; and what each set knows.

    Raises:
      ValueError: the tables are no tree, so that a node does not say what was seen before.
    """
    if (tables.outcome_KC >= 0).sum() + (tables.next_DA >= 0).sum() != len(tables.player_N) - 1:
        raise ValueError("information sets need a game's whole tree")
    first = tables.num_chance
    set_D = np.full(len(tables.next_DA), -1)
    known: list[Information] = []
    number_of: dict[tuple[int, int, bytes], int] = {}  # by the last own turn's set, the action there and what is seen
    start = -1, -1
    pending: list[tuple[int, tuple[int, int]]] = [(int(tables.root), start)]
    while pending:
        node, last = pending.pop()
        ours = tables.player_N[node] == seat
        if ours:
            observation_O = tables.observation_2NO[seat - 1, node]
            number = number_of.setdefault((*last, observation_O.tobytes()), len(known))
            if number == len(known):
                before = known[last[0]] if last != start else None
                known.append(
                    Information(
                        seat,
                        np.vstack([*([before.observation_TO] if before else []), observation_O[None]]),
                        np.append(before.action_T, np.int32(last[1])) if before else np.zeros(0, np.int32),
                        tables.next_DA[node - first] >= 0,
                    )
                )
            set_D[node - first] = number
        if node < tables.num_open:
            for event, child in enumerate(tables.successors(node)):
                if child >= 0:
                    pending.append((int(child), (set_D[node - first], event) if ours else last))
    return set_D, known


def exploitability(tables: Tables, policy: Callable[[Information], np.ndarray]) -> float:
    """How much a policy for both seats loses to its best responses, in the game's units: NashConv / 2, 0 at best.

    Args:
      tables: a game's whole tree, as Leduc's are.
      policy: action probabilities [A] by what a player knows; called once for each information set.

    Raises:
      ValueError: `policy` gives no probabilities over the legal actions.
    """
    policy_DA = np.zeros(tables.next_DA.shape)
    sets_D = {}
    for seat in (1, 2):
        sets_D[seat], known = information_sets(tables, seat)
        policy_GA = np.array([policy(information) for information in known], np.float64)
        legal_GA = np.array([information.legal_A for information in known])
        if (policy_GA < 0).any() or policy_GA[~legal_GA].any() or not np.allclose(policy_GA.sum(-1), 1, atol=1e-4):
            raise ValueError("a policy must give probabilities over the legal actions that sum to one")
        ours_D = sets_D[seat] >= 0
        policy_DA[ours_D] = policy_GA[sets_D[seat][ours_D]]
    gains = (
        best_response(tables, seat, tables.return_2N[seat - 1], policy_DA, sets_D[seat])
        - values(tables, tables.return_2N[seat - 1], policy_DA)[tables.root]
        for seat in (1, 2)
    )
    return float(sum(gains)) / 2


def levels(tables: Tables) -> list[np.ndarray]:
    """All nodes by their depth, each level ascending.

    Raises:
      ValueError: some node can be reached in different numbers of events.
    """
    levels, level = [], np.array([tables.root])
    total = 0
    while len(level):
        levels.append(level)
        total += len(level)
        drawn, acted = level[level < tables.num_chance], level[level >= tables.num_chance]
        acted = acted[acted < tables.num_open] - tables.num_chance
        level = np.unique(np.concatenate([tables.outcome_KC[drawn].ravel(), tables.next_DA[acted].ravel()]))
        level = level[level >= 0]
        if total + len(level) > len(tables.player_N):
            raise ValueError("some states can be reached in different numbers of events")
    return levels


def _draw(tables: Tables, level: np.ndarray, value_N: np.ndarray) -> None:
    """Fills in the values of the level's chance nodes."""
    nodes = level[level < tables.num_chance]
    value_N[nodes] = (tables.chance_KC[nodes].astype(np.float64) * value_N[tables.outcome_KC[nodes]]).sum(-1)


def _decisions(tables: Tables, level: np.ndarray, value_N: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The level's players' nodes and the value of each action there (0 if illegal), float64 [M, A]."""
    nodes = level[(level >= tables.num_chance) & (level < tables.num_open)]
    next_MA = tables.next_DA[nodes - tables.num_chance]
    return nodes, np.where(next_MA >= 0, value_N[next_MA], 0)


def _policy(tables: Tables, nodes: np.ndarray, policy_DA: np.ndarray | None) -> np.ndarray:
    """float64 [M, A]: action probabilities at players' nodes; None: uniform over what is legal."""
    if policy_DA is not None:
        return policy_DA[nodes - tables.num_chance]
    legal_MA = tables.next_DA[nodes - tables.num_chance] >= 0
    return legal_MA / legal_MA.sum(-1, keepdims=True)


def _reach(tables: Tables, seat: int, policy_DA: np.ndarray | None) -> np.ndarray:
    """float64 [N]: the probability that chance and the other player let a node be reached."""
    reach_N = np.zeros(len(tables.player_N))
    reach_N[tables.root] = 1
    for level in levels(tables):
        drawn = level[level < tables.num_chance]
        np.add.at(reach_N, tables.outcome_KC[drawn], reach_N[drawn][:, None] * tables.chance_KC[drawn])
        nodes = level[(level >= tables.num_chance) & (level < tables.num_open)]
        next_MA = tables.next_DA[nodes - tables.num_chance]
        ours_M1 = (tables.player_N[nodes] == seat)[:, None]
        share_MA = np.where(ours_M1, 1.0, _policy(tables, nodes, policy_DA))
        legal_MA = next_MA >= 0
        np.add.at(reach_N, next_MA[legal_MA], (reach_N[nodes][:, None] * share_MA)[legal_MA])
    return reach_N
