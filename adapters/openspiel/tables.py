"""A game of OpenSpiel walked once into lookup tables: where it can be, who acts, what is seen, what events lead to.

NumPy only. `adapters.openspiel.task` makes a pure JAX environment of the tables, and `leaderboards.best_response`
searches them.

Shapes: N nodes, of which the first K are chance's, the next D the players', the rest ends; O symbols of an
observation, A actions of a player, C outcomes of chance, 2 seats.
"""

from __future__ import annotations

import array
import collections
import dataclasses
import functools
from collections.abc import Callable, Hashable
from typing import Any

import numpy as np

History = list[int]
Key = Callable[[History, Callable[[], Any]], Hashable]  # of a history and a function that makes its engine state

MAX_NODES = 500_000  # of tables: they take seconds to walk
MAX_BYTES = 400_000_000  # of tables
MAX_SYMBOL = 255  # observations are uint8
AGREE = 120  # bargaining's action
CHECKS = 5_000  # of a key, see `_check_key`


class TooLargeError(Exception):
    """The game has more nodes than allowed; the exception's argument is how many are."""


class NotCategoricalError(Exception):
    """An observation holds a number that is no integer in [0, 255]."""


class NotMarkovError(Exception):
    """Two histories have the same key, but the game goes on differently after them."""


@dataclasses.dataclass(frozen=True)
class Tables:
    """A whole game; nodes are in breadth-first order within their kind.

    Attributes:
      player_N: int8, who acts: 0 chance (and nobody, at an end), 1 or 2.
      observation_2NO: uint8, what each seat sees.
      return_2N: float32, each seat's return so far.
      chance_KC: float64, probabilities of the outcomes.
      outcome_KC: int32, the node each outcome leads to; -1: it cannot happen.
      next_DA: int32, the node each action leads to; -1: it is illegal.
      root: the first node, int32.
    """

    player_N: np.ndarray
    observation_2NO: np.ndarray
    return_2N: np.ndarray
    chance_KC: np.ndarray
    outcome_KC: np.ndarray
    next_DA: np.ndarray
    root: np.ndarray

    @property
    def num_chance(self) -> int:
        """K."""
        return len(self.chance_KC)

    @property
    def num_open(self) -> int:
        """K + D: nodes from here on are ends."""
        return len(self.chance_KC) + len(self.next_DA)

    @property
    def nbytes(self) -> int:
        """Bytes of all tables."""
        return sum(getattr(self, field.name).nbytes for field in dataclasses.fields(self))

    def successors(self, node: int) -> np.ndarray:
        """int32 [C] or [A]: the node that each event at `node` leads to, -1 where there is none."""
        return self.outcome_KC[node] if node < self.num_chance else self.next_DA[node - self.num_chance]


def whole_history(history: History, state: Callable[[], Any]) -> Hashable:
    """The key that is always right: every history is a node of its own."""
    return tuple(history)


def position(history: History, state: Callable[[], Any]) -> Hashable:
    """The engine's own description of a state: all there is to know where nothing is hidden, as on a board."""
    return str(state())


def last_offer(history: History, state: Callable[[], Any]) -> Hashable:
    """Bargaining: the instance that chance drew, the turn and the offer on the table; whether it was agreed to.

    One number, since it is asked millions of times: there are fewer than 16 turns and 1024 instances.
    """
    if not history:
        return -1
    agreed = len(history) > 1 and history[-1] == AGREE
    return ((history[0] * 16 + len(history)) * 1024 + history[-2 if agreed else -1]) * 2 + agreed


def build(
    game: Any,
    key: Key | None = None,
    progress: Callable[[float], None] | None = None,
    max_nodes: int | None = None,
) -> Tables:
    """Walks all of `game`, a `pyspiel.Game` of two players who take turns.

    Args:
      game: the engine's game.
      key: what tells its states apart; None: `position` where nothing is hidden and that is enough, else
        `whole_history`.
      progress: called with the share of the known nodes that are done.
      max_nodes: N at most; None: what `MAX_NODES` and `MAX_BYTES` allow.

    Raises:
      TooLargeError, NotCategoricalError: the game is not for tables.
      NotMarkovError: `key` was given and is wrong.
    """
    import pyspiel

    if key is None and game.get_type().information == pyspiel.GameType.Information.PERFECT_INFORMATION:
        try:
            return build(game, position, progress, max_nodes)
        except NotMarkovError:
            pass
    key = key or whole_history
    if max_nodes is None:
        node_bytes = 2 * int(np.prod(game.observation_tensor_shape())) + 4 * game.num_distinct_actions()
        max_nodes = min(MAX_NODES, MAX_BYTES // node_bytes)
    walk = _walk(game, key, progress or (lambda fraction: None), max_nodes)
    if key is not whole_history:
        _check_key(game, key, walk)
    return walk.tables


@dataclasses.dataclass(frozen=True)
class _Walk:
    """Tables and how they came about; E transitions from node to node.

    Attributes:
      tables: the game.
      node_of: the node of each key.
      parent_E, event_E, child_E: int32, each transition.
      way_N: int64, the transition by which each node was found; -1 for the root.
    """

    tables: Tables
    node_of: dict[Hashable, int]
    parent_E: np.ndarray
    event_E: np.ndarray
    child_E: np.ndarray
    way_N: np.ndarray


def _walk(game: Any, key: Key, progress: Callable[[float], None], max_nodes: int) -> _Walk:
    """Breadth-first. Nodes are numbered as found here, then sorted by kind."""
    num_symbols = int(np.prod(game.observation_tensor_shape()))
    root = game.new_initial_state()
    node_of = {key([], lambda: root): 0}
    queue = collections.deque([root])
    kinds, players = array.array("b"), array.array("b")
    returns, chances = array.array("f"), array.array("d")
    events, children, counts = array.array("i"), array.array("i"), array.array("i")  # all nodes' one after another
    ways = array.array("q", [-1])
    observations: list[np.ndarray] = []
    pending: list[list[float]] = []
    reported = 0.0
    while queue:
        state = queue.popleft()
        pending += [state.observation_tensor(0), state.observation_tensor(1)]
        if len(pending) >= 4096:
            observations.append(_symbols(pending))
            pending.clear()
            reported = max(reported, len(kinds) / len(node_of))
            progress(reported)
        chance = state.is_chance_node()
        kinds.append(0 if chance else 2 if state.is_terminal() else 1)
        players.append(state.current_player() + 1 if kinds[-1] == 1 else 0)
        returns.extend(state.returns())
        if chance:
            legal, probabilities = zip(*state.chance_outcomes(), strict=True)
            chances.extend(probabilities)
        else:
            legal = state.legal_actions()
        history = [*state.history(), 0]
        following = functools.partial(_last_played, state, history)
        for event in legal:
            history[-1] = event
            # A key that asks for no state needs none, so that only new nodes are played.
            child = node_of.setdefault(key(history, following), len(node_of))
            if child == len(ways):
                if child >= max_nodes:
                    raise TooLargeError(max_nodes)
                queue.append(state.child(event))
                ways.append(len(children))
            children.append(child)
        events.extend(legal)
        counts.append(len(legal))
    observations.append(_symbols(pending) if pending else np.zeros((0, num_symbols), np.uint8))

    kind_N = np.frombuffer(kinds, np.int8)
    order_N = np.argsort(kind_N, kind="stable")
    rank_N = np.empty(len(order_N), np.int32)
    rank_N[order_N] = np.arange(len(order_N), dtype=np.int32)
    num_chance, num_players = int((kind_N == 0).sum()), int((kind_N == 1).sum())
    parent_E = np.repeat(rank_N, np.frombuffer(counts, np.int32))
    event_E = np.frombuffer(events, np.int32)
    child_E = rank_N[np.frombuffer(children, np.int32)]
    drawn_E = parent_E < num_chance
    chance_KC = np.zeros((num_chance, game.max_chance_outcomes()))
    outcome_KC = np.full(chance_KC.shape, -1, np.int32)
    next_DA = np.full((num_players, game.num_distinct_actions()), -1, np.int32)
    chance_KC[parent_E[drawn_E], event_E[drawn_E]] = np.frombuffer(chances)
    outcome_KC[parent_E[drawn_E], event_E[drawn_E]] = child_E[drawn_E]
    next_DA[parent_E[~drawn_E] - num_chance, event_E[~drawn_E]] = child_E[~drawn_E]
    tables = Tables(
        player_N=np.frombuffer(players, np.int8)[order_N],
        observation_2NO=np.concatenate(observations).reshape(-1, 2, num_symbols)[order_N].swapaxes(0, 1).copy(),
        return_2N=np.frombuffer(returns, np.float32).reshape(-1, 2)[order_N].T.copy(),
        chance_KC=chance_KC,
        outcome_KC=outcome_KC,
        next_DA=next_DA,
        root=rank_N[0],
    )
    nodes = {found: int(rank_N[number]) for found, number in node_of.items()}
    return _Walk(tables, nodes, parent_E, event_E, child_E, np.frombuffer(ways, np.int64)[order_N])


def _last_played(state: Any, history: History) -> Any:
    return state.child(history[-1])


def _symbols(tensors: list[list[float]]) -> np.ndarray:
    exact = np.asarray(tensors, np.float32)
    symbols = exact.astype(np.uint8)
    if exact.min() < 0 or exact.max() > MAX_SYMBOL or (symbols != exact).any():
        raise NotCategoricalError
    return symbols


def _check_key(game: Any, key: Key, walk: _Walk, checks: int = CHECKS, seed: int = 0) -> None:
    """Compares the engine with the tables along other histories than those that made the tables.

    A table knows a node from the first history that led there. Here `checks` of the other ways into some node are
    drawn (all, where there are fewer), and each is played on at random to its end, since what a key forgets may
    matter only later.

    Raises:
      NotMarkovError: a history and the first one with its key differ in who acts, what either seat sees, what is
        legal, chance's probabilities, the returns, or the keys that follow.
    """
    random, tables = np.random.default_rng(seed), walk.tables
    other_E = np.ones(len(walk.child_E), bool)
    other_E[walk.way_N[walk.way_N >= 0]] = False
    for way in random.permutation(np.flatnonzero(other_E))[:checks]:
        node, history = walk.child_E[way], []
        while way >= 0:
            history.append(int(walk.event_E[way]))
            way = walk.way_N[walk.parent_E[way]]
        state = game.new_initial_state()
        for event in reversed(history):
            state.apply_action(event)
        while True:
            field = _difference(state, int(node), tables, key, walk.node_of)
            if field:
                raise NotMarkovError(f"after {state.history()} {field} differ from those of another history's")
            if state.is_terminal():
                break
            event = random.choice(state.legal_actions())
            state.apply_action(int(event))
            node = tables.successors(int(node))[event]


def _difference(state: Any, node: int, tables: Tables, key: Key, node_of: dict[Hashable, int]) -> str | None:
    """In what the engine's state is not what the tables say of `node`; None if in nothing."""
    chance = state.is_chance_node()
    acting = not chance and not state.is_terminal()
    if (chance, acting) != (node < tables.num_chance, tables.num_chance <= node < tables.num_open):
        return "kinds"
    if tables.player_N[node] != (state.current_player() + 1 if acting else 0):
        return "players"
    if any(tables.observation_2NO[i, node].tolist() != state.observation_tensor(i) for i in (0, 1)):
        return "observations"
    if (tables.return_2N[:, node] != np.array(state.returns(), np.float32)).any():
        return "returns"
    if not chance and not acting:
        return None
    legal = state.legal_actions()
    successors = tables.successors(node)
    if np.flatnonzero(successors >= 0).tolist() != legal:
        return "legal actions"
    if chance and tables.chance_KC[node, legal].tolist() != [likely for _, likely in state.chance_outcomes()]:
        return "chance's probabilities"
    history = state.history()
    following = [node_of.get(key([*history, event], functools.partial(state.child, event))) for event in legal]
    return "keys" if following != successors[legal].tolist() else None
