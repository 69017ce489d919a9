"""Two-player games of OpenSpiel (Lanctot et al. 2019) as pure environments: the engine, walked once into tables.

Games that are too large for tables are played by the engine, on the host (`adapters.openspiel.host`).

Importing this module, and `spec` of the games in `GAMES`, load no engine.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import importlib.metadata
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import quote

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from adapters.openspiel import host
from adapters.openspiel import tables as game_tables
from adapters.openspiel.host import MAX_REWARD_CLASSES, SIGNS
from adapters.openspiel.library import canonical_name, load, not_played
from adapters.openspiel.tables import Tables
from suite.interface.environment import Environment, EnvironmentSpec, ObservationSpec, TimeStep
from suite.interface.turns import Turn
from suite.runtime.cache import cache_dir, read_arrays
from suite.runtime.errors import UserError

Progress = Callable[[str, float], None]


def _specification(
    name: str,
    symbols: int,
    high: int,
    actions: int,
    outcomes: int,
    rewards: tuple[float, ...],
    fully_observed: bool,
    utility: tuple[float, float],
    longest: int,
) -> EnvironmentSpec:
    """`utility`: the least and the most that a game pays a player; `longest`: events that it has at most."""
    return EnvironmentSpec(
        id=f"openspiel/{name}",
        observation=ObservationSpec(shape=(symbols,), high=high, kind="symbols"),
        num_actions=actions,
        reward_classes=rewards,
        statistics=(("raw_return", ()), ("seat", ())),
        package="open_spiel",
        two_player=True,
        chance_outcomes=outcomes,
        fully_observed=fully_observed,
        ranges=(
            ("length", 1, longest),
            ("raw_return", *utility),
            ("seat", 1, 2),
            ("return", rewards[0], rewards[-1]),  # paid once, at the end
        ),
    )


SPECS = {
    "tic_tac_toe": _specification("tic_tac_toe", 27, 1, 9, 0, SIGNS, True, (-1.0, 1.0), 9),
    "leduc": _specification(
        "leduc", 16, 13, 3, 6, SIGNS, False, (-13.0, 13.0), 11
    ),  # pays -13..13, learned from the sign: fidelity note 32
    "bargaining": _specification("bargaining", 93, 1, 121, 1002, tuple(map(float, range(11))), False, (0.0, 10.0), 19),
}


def spec(name: str) -> EnvironmentSpec:
    """What the game is: at once for those in `GAMES`; any other sequential two-player game is walked for it.

    One that is too large for tables is played at random instead: see `host.measured`. That it is too large
    is remembered in the cache folder.

    Args:
      name: a name in `GAMES`, or a game's name in the library, with its parameters in the library's own way:
        "goofspiel(num_cards=4)".

    Raises:
      UserError: no such game, or none that can be played here; see `make`.
    """
    name = canonical_name(name)
    return SPECS.get(name) or _specified(name, _walked(name, None))


def make(name: str, progress: Progress | None = None) -> Environment:
    """The game `name`, ready to be compiled; its tables are built once and kept in the cache folder.

    A game that is too large for tables steps on the host, and is truncated after `host.LIMIT` events.

    Args:
      name: as for `spec`.
      progress: called with a message and the fraction done; bargaining takes some 20 seconds when it is new.

    Raises:
      UserError: the game or a parameter is unknown; or its players move at once, or are not two; or what they see is
        not a vector of symbols.
    """
    name = canonical_name(name)
    tables = _walked(name, progress)
    spec = SPECS.get(name) or _specified(name, tables)
    return host.make(load(name), spec) if tables is None else TableGame(spec, tables)


def walked(name: str, progress: Progress | None = None) -> Tables:
    """The game's tables in NumPy, from the cache folder or from the engine.

    Args:
      name, progress: as for `make`.

    Raises:
      UserError: as `make`; or the game is too large for tables.
    """
    tables = _walked(canonical_name(name), progress)
    if tables is None:
        raise UserError(f"openspiel/{name} is too large for tables")
    return tables


def _walked(name: str, progress: Progress | None) -> Tables | None:
    """As `walked`; None if the game is too large for tables."""
    message = f"Loading openspiel/{name}"
    report = functools.partial(progress, message) if progress else lambda fraction: None
    report(0.0)
    version = importlib.metadata.version("open_spiel")
    path = cache_dir() / "openspiel" / f"{quote(name, '(),=')}-{version}-{_builder()}.npz"
    too_large = path.with_name(f"{path.stem}.too_large")  # an empty file
    tables = read_tables(path)
    if tables is None and not too_large.exists():
        game = load(name)
        key = game_tables.last_offer if name == "bargaining" else None
        try:
            tables = game_tables.build(game, key, report)
        except game_tables.TooLargeError:
            with contextlib.suppress(OSError):
                too_large.parent.mkdir(parents=True, exist_ok=True)
                too_large.touch()
        except game_tables.NotCategoricalError:
            raise _not_categorical(name) from None
        else:
            _write(path, tables)
    report(1.0)
    return tables


@functools.cache
def _builder() -> str:
    """Tells versions of what builds tables apart, so that none of another version are read from the cache folder."""
    return hashlib.sha256(Path(game_tables.__file__).read_bytes()).hexdigest()[:8]


@struct.dataclass
class GameState:
    """Where a game is: `node` of its tables and which `seat` is ours (1 or 2), both int32."""

    node: jax.Array
    seat: jax.Array


class TableGame:
    """One game between our player, the other and chance; see `suite.interface.environment.Environment`.

    A time step is an event: chance's are played like the players' (`Turn.player` 0). An observation is uint8, what the
    engine shows our seat (`observation_tensor`), at every event, the others' too.

    The reward is paid where the game ends: our seat's return, or its sign where `reward_classes` are -1, 0 and 1.
    Statistics, float32: `raw_return`, the return so far; `seat`. At an end nobody acts: `player` is 0, and nothing is
    legal or likely.

    An event that cannot happen (illegal, out of range, after the end) changes nothing and pays nothing: compiled code
    cannot raise.
    """

    def __init__(self, spec: EnvironmentSpec, tables: Tables):
        self.spec = spec
        self._tables = _compact(tables, spec.observation.high)
        self._num_chance, self._num_open = tables.num_chance, tables.num_open
        self._binary = spec.observation.high == 1

    def reset(self, key: jax.Array, seat: jax.Array) -> tuple[GameState, TimeStep]:
        """The start of a game in which ours is `seat`; chance, if any, has not acted yet. `key` is not used."""
        state = GameState(self._tables["root"], jnp.asarray(seat, jnp.int32))
        return state, self._time_step(state, jnp.zeros((), jnp.float32), first=jnp.ones((), bool))

    def step(self, key: jax.Array, state: GameState, event: jax.Array) -> tuple[GameState, TimeStep]:
        """What `event` leads to: an action of the player to act, or an outcome of chance. `key` is not used."""
        following = self._following(state.node, event)
        moved = following >= 0
        state = GameState(jnp.where(moved, following, state.node), state.seat)
        reward = self._tables["return_2N"][state.seat - 1, state.node]
        if self.spec.reward_classes == SIGNS:
            reward = jnp.sign(reward)
        ended = moved & (state.node >= self._num_open)
        reward = jnp.where(ended, reward, jnp.float32(0))
        return state, self._time_step(state, reward, first=jnp.zeros((), bool))

    def _following(self, node: jax.Array, event: jax.Array) -> jax.Array:
        """int32: the node that `event` leads to; -1 if it cannot happen."""
        tables, acting = self._tables, node - self._num_chance
        rank = _entry(tables["rank_LA"], (self._legal_set(node), event), -1)
        following = jnp.where(
            rank >= 0, tables["next_E"][_entry(tables["first_D"], acting, 0) + rank.astype(jnp.int32)], -1
        )
        if self._num_chance:
            outcome = _entry(tables["outcome_KC"], (node, event), -1)
            following = jnp.where(acting < 0, outcome, following)
        return following

    def _legal_set(self, node: jax.Array) -> jax.Array:
        """int32: the row of `rank_LA`; -1 where no player acts."""
        return _entry(self._tables["legal_D"], node - self._num_chance, -1)

    def _observation(self, seat: jax.Array, node: jax.Array) -> jax.Array:
        symbols = self._tables["observation_2NO"][seat - 1, node]
        return jnp.unpackbits(symbols, count=self.spec.observation.shape[0]) if self._binary else symbols

    def _time_step(self, state: GameState, reward: jax.Array, first: jax.Array) -> TimeStep:
        tables, node, seat = self._tables, state.node, state.seat
        observation = self._observation(seat, node)
        chance_C = jnp.zeros(self.spec.chance_outcomes, jnp.float32)
        if self._num_chance:
            chance_C = _entry(tables["chance_KC"], node, 0)
        turn = Turn(
            player=tables["player_N"][node].astype(jnp.int32),
            seat=seat,
            legal_A=_entry(tables["rank_LA"], self._legal_set(node), -1) >= 0,
            chance_C=chance_C,
            opponent_observation=self._observation(3 - seat, node),
        )
        return TimeStep(
            observation=observation,
            reward=reward,
            terminated=node >= self._num_open,
            truncated=jnp.zeros((), bool),
            first=first,
            final_observation=observation,
            statistics={"raw_return": tables["return_2N"][seat - 1, node], "seat": seat.astype(jnp.float32)},
            turn=turn,
        )


def _compact(tables: Tables, high: int) -> dict[str, jax.Array]:
    """The tables as a program holds them, a sixth as large for bargaining, since every program gets a copy of its own.

    Observations of bits are packed. L distinct sets of legal actions are kept once, as each action's rank in its set
    (-1: illegal); a player's node has a set, `legal_D`, and its successors are one after another in `next_E` from
    `first_D` on.
    """
    legal_DA = tables.next_DA >= 0
    sets, legal_D = np.unique(np.packbits(legal_DA, axis=-1), axis=0, return_inverse=True)
    legal_LA = np.unpackbits(sets, axis=-1, count=legal_DA.shape[-1]).astype(bool)
    count_D = legal_DA.sum(-1)
    observation_2NO = tables.observation_2NO
    compact = {
        "player_N": tables.player_N,
        "observation_2NO": np.packbits(observation_2NO, axis=-1) if high == 1 else observation_2NO,
        "return_2N": tables.return_2N,
        "chance_KC": tables.chance_KC.astype(np.float32),
        "outcome_KC": tables.outcome_KC,
        "rank_LA": np.where(legal_LA, legal_LA.cumsum(-1) - 1, -1).astype(np.int16),
        "legal_D": legal_D.reshape(-1).astype(np.int32),
        "first_D": (count_D.cumsum() - count_D).astype(np.int32),
        "next_E": tables.next_DA[legal_DA],
        "root": tables.root,
    }
    return {name: jnp.asarray(table) for name, table in compact.items()}


def _entry(table: jax.Array, index: Any, otherwise: int) -> jax.Array:
    """The table's entry or row; `otherwise` where it has none, negative indices included."""
    return table.at[index].get(mode="fill", fill_value=otherwise, wrap_negative_indices=False)


def _specified(name: str, tables: Tables | None) -> EnvironmentSpec:
    """The specification that a game's tables imply, or random play where there are none."""
    return measured(name, tables) if tables else measured_by_play(name)


def measured(name: str, tables: Tables) -> EnvironmentSpec:
    """What a game's tables say that it is."""
    levels = tuple(float(level) for level in np.union1d(tables.return_2N[:, tables.num_open :], [0.0]))
    game = load(name)
    return _specification(
        name,
        symbols=tables.observation_2NO.shape[-1],
        high=max(1, int(tables.observation_2NO.max())),
        actions=tables.next_DA.shape[-1],
        outcomes=tables.chance_KC.shape[-1],
        rewards=levels if len(levels) <= MAX_REWARD_CLASSES else SIGNS,
        fully_observed=_fully_observed(game),
        utility=(game.min_utility(), game.max_utility()),
        longest=game.max_history_length(),
    )


@functools.lru_cache(maxsize=16)
def measured_by_play(name: str) -> EnvironmentSpec:
    """What random play says that a game is."""
    game = load(name)
    symbols = int(np.prod(game.observation_tensor_shape()))
    actions, outcomes = game.num_distinct_actions(), game.max_chance_outcomes()
    known = _specification(
        name,
        symbols,
        1,
        actions,
        outcomes,
        SIGNS,
        _fully_observed(game),
        (game.min_utility(), game.max_utility()),
        min(game.max_history_length(), host.LIMIT),
    )
    try:
        return host.measured(game, known)
    except game_tables.NotCategoricalError:
        raise _not_categorical(name) from None


def _fully_observed(game: Any) -> bool:
    import pyspiel

    return game.get_type().information == pyspiel.GameType.Information.PERFECT_INFORMATION


def _not_categorical(name: str) -> UserError:
    return not_played(name, "its observations are not whole numbers from 0 to 255")


def read_tables(path: Path) -> Tables | None:
    """The tables in a cache file; None if there is no file, or it is broken and must be made again."""
    arrays = read_arrays(path)
    names = {field.name for field in dataclasses.fields(Tables)}
    return Tables(**arrays) if arrays is not None and arrays.keys() == names else None


def _write(path: Path, tables: Tables) -> None:
    """Atomically, so that no other process sees half a file; a folder that cannot be written costs only time."""
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".tmp", delete=False) as file:
            try:
                np.savez_compressed(file, **{f.name: getattr(tables, f.name) for f in dataclasses.fields(tables)})
                file.close()
                os.replace(file.name, path)
            except BaseException:
                os.unlink(file.name)
                raise
