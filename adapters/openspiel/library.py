"""The games of the library by name, with their parameters, and why some are none for us.

Importing this module loads no engine.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Sequence
from typing import Any

from suite.runtime.errors import UserError, did_you_mean

GAMES = {"tic_tac_toe": "tic_tac_toe", "leduc": "leduc_poker", "bargaining": "bargaining"}


def canonical_name(name: str) -> str:
    """The name in `GAMES` of a game that is there, else the library's."""
    return {game: short for short, game in GAMES.items()}.get(name, name)


def load(name: str) -> Any:
    """The `pyspiel.Game` of a name in `GAMES` or in the library, with parameters as the library has them.

    Raises:
      UserError: there is none, or none for us, and why.
    """
    import pyspiel

    kinds = {kind.short_name: kind for kind in pyspiel.registered_games()}
    short, bracket, parameters = name.partition("(")
    identifier = GAMES.get(short, short)
    if identifier not in kinds:
        playable = {id for id, kind in kinds.items() if kind.default_loadable and not _obstacle(kind)}
        raise UserError(f"unknown game openspiel/{name}: {did_you_mean(short, {*GAMES, *playable})}")
    kind = kinds[identifier]
    if not (bracket or kind.default_loadable):
        first = next(iter(kind.parameter_specification))
        needed = "game=tic_tac_toe()" if "game" in kind.parameter_specification else f"{first}=..."
        raise not_played(name, f"it needs parameters, as in {identifier}({needed})")
    try:
        with _silent_stderr():
            game = pyspiel.load_game(identifier + bracket + parameters)
    except pyspiel.SpielError as error:
        raise not_played(name, " ".join(str(error).split())) from error
    kind, players = game.get_type(), game.num_players()
    if players != 2:
        more = f"; {identifier}(players=2) has" if "players" in kind.parameter_specification else ""
        raise not_played(name, f"it has {players} player{'s' if players > 1 else ''}, not two{more}")
    if kind.dynamics == pyspiel.GameType.Dynamics.SIMULTANEOUS:
        in_turns = f"openspiel/turn_based_simultaneous_game(game={identifier}{bracket}{parameters or '()'})"
        raise not_played(name, f"its players move simultaneously; in {in_turns} they take turns")
    obstacle = _obstacle(kind)
    if obstacle:
        raise not_played(name, obstacle)
    return game


def told(name: str, events: Sequence[int]) -> tuple[list[str], list[str]]:
    """A game in the library's own text.

    Args:
      name: as for `load`.
      events: T of them from the game's beginning on, of players and chance.

    Returns:
      the T + 1 states that it passes, and the T events.
    """
    state = load(name).new_initial_state()
    states, moves = [str(state)], []
    for event in events:
        moves.append(state.action_to_string(state.current_player(), int(event)))
        state.apply_action(int(event))
        states.append(str(state))
    return states, moves


def _obstacle(kind: Any) -> str:
    """Why games of this type, whatever their parameters, cannot be played here; "" if they can."""
    import pyspiel

    if not kind.min_num_players <= 2 <= kind.max_num_players:
        return "it is not for two players"
    if kind.dynamics != pyspiel.GameType.Dynamics.SEQUENTIAL:
        return "its players do not take turns"
    if not kind.provides_observation_tensor:
        return "the library gives no observation tensor for it"
    if kind.chance_mode == pyspiel.GameType.ChanceMode.SAMPLED_STOCHASTIC:
        return "it does not tell the probabilities of its chance events"
    return ""


def not_played(name: str, reason: str) -> UserError:
    """The error of a game that the library has."""
    return UserError(f"openspiel/{name} cannot be played here: {reason}")


@contextlib.contextmanager
def _silent_stderr() -> Iterator[None]:
    """The library writes there what it raises besides."""
    kept = os.dup(2)
    with open(os.devnull, "wb") as nothing:
        os.dup2(nothing.fileno(), 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
