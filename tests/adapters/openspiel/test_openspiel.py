"""The tables are the engine's games: every field of thousands of games, and every way to refuse one."""

from __future__ import annotations

import dataclasses
import importlib.metadata
import subprocess
import sys
from types import SimpleNamespace
from unittest.mock import ANY

import jax
import jax.numpy as jnp
import numpy as np
import pyspiel
import pytest

from adapters.openspiel import tables as game_tables
from adapters.openspiel import task as openspiel
from adapters.openspiel.library import GAMES
from suite import registry
from suite.runtime.errors import UserError
from tests import games
from tests.contract import check_environment

NAMES = ["tic_tac_toe", "leduc", "bargaining", "kuhn_poker"]
SIZES = {"tic_tac_toe": 5478, "leduc": 9457, "bargaining": 412_712, "kuhn_poker": 58}


def engine(name):
    return pyspiel.load_game(GAMES.get(name, name))


@pytest.mark.parametrize("name", NAMES)
def test_the_specification_is_the_engines(name):
    spec, tables, game = games.game(name).spec, games.walked(name), engine(name)
    assert spec.num_actions == game.num_distinct_actions()
    assert spec.chance_outcomes == game.max_chance_outcomes()
    assert spec.observation.shape == (np.prod(game.observation_tensor_shape()),)
    assert spec.observation.high == tables.observation_2NO.max()
    assert len(tables.player_N) == SIZES[name]
    measured = openspiel.measured(name, tables)
    if name == "leduc":  # learned from the sign of -13..13
        assert (measured.reward_classes[0], measured.reward_classes[-1]) == (-13, 13)
        *others, paid = measured.ranges
        assert paid == ("return", -13, 13)
        measured = dataclasses.replace(
            measured, reward_classes=(-1.0, 0.0, 1.0), ranges=(*others, ("return", -1.0, 1.0))
        )
    assert spec == measured
    if name in GAMES:
        assert openspiel.spec(name) is openspiel.spec(GAMES[name]) is spec


@pytest.mark.parametrize(
    ("name", "steps", "num_envs", "least"),
    [
        ("tic_tac_toe", 400, 64, 3000),
        ("leduc", 400, 64, 3000),
        ("bargaining", 120, 32, 300),
        ("kuhn_poker", 100, 32, 500),
    ],
)
def test_random_games_are_the_engines(name, steps, num_envs, least):
    played = games.play(games.game(name), steps, num_envs)
    assert games.check_against_engine(played, engine(name), signs=name == "leduc") >= least
    if name == "tic_tac_toe":  # where no player's returns are the other's, or none are lost, the seats differ
        stepped = played[2]
        returns = [stepped.reward[:, seat::2].sum() / stepped.terminated[:, seat::2].sum() for seat in (0, 1)]
        np.testing.assert_allclose(returns, [0.297, -0.297], atol=0.08)


@pytest.mark.parametrize("name", NAMES)
def test_chance_probabilities_sum_to_one_over_what_can_happen(name):
    tables = games.walked(name)
    np.testing.assert_allclose(tables.chance_KC.sum(-1), 1, atol=1e-12)
    np.testing.assert_array_equal(tables.chance_KC > 0, tables.outcome_KC >= 0)
    reached = np.concatenate([tables.outcome_KC[tables.outcome_KC >= 0], tables.next_DA[tables.next_DA >= 0]])
    np.testing.assert_array_equal(np.unique(reached), np.setdiff1d(np.arange(len(tables.player_N)), tables.root))
    assert tables.nbytes < 300e6


@pytest.mark.parametrize(("name", "steps"), [("tic_tac_toe", 100), ("leduc", 100), ("bargaining", 30)])
def test_the_contract(name, steps):
    assert check_environment(games.game(name), jax.random.key(1), steps).ended.any()


def test_the_end_of_a_game_and_what_cannot_happen():
    environment, key = games.game("tic_tac_toe"), jax.random.key(0)
    step = jax.jit(environment.step)
    state, shown = environment.reset(key, jnp.int32(2))
    for action in (-1, 9, 1000):
        assert_nothing_happens(step(key, state, jnp.int32(action)), state, shown)
    for action in (0, 3, 1, 4):
        state, shown = step(key, state, jnp.int32(action))
        assert_nothing_happens(step(key, state, jnp.int32(0)), state, shown)
    state, shown = step(key, state, jnp.int32(2))
    assert bool(shown.terminated) and float(shown.reward) == -1 == float(shown.statistics["raw_return"])
    assert int(shown.turn.player) == 0 and not shown.turn.legal_A.any() and shown.turn.chance_C.shape == (0,)
    board = engine("tic_tac_toe").new_initial_state()
    for action in (0, 3, 1, 4, 2):
        board.apply_action(action)
    assert shown.observation.tolist() == shown.turn.opponent_observation.tolist() == board.observation_tensor(0)
    assert_nothing_happens(step(key, state, jnp.int32(8)), state, shown)


def test_chance_cannot_draw_what_cannot_happen():
    environment, key = games.game("leduc"), jax.random.key(0)
    state, shown = environment.reset(key, jnp.int32(1))
    state, shown = environment.step(key, state, jnp.int32(2))
    assert shown.turn is not None and shown.turn.chance_C[2] == 0
    for outcome in (2, -1, 6):
        assert_nothing_happens(environment.step(key, state, jnp.int32(outcome)), state, shown)


def assert_nothing_happens(after, state, shown):
    assert jax.tree.all(jax.tree.map(lambda a, b: bool((a == b).all()), after[0], state))
    assert float(after[1].reward) == 0
    expected = dataclasses.replace(shown, reward=after[1].reward, first=after[1].first)
    assert jax.tree.all(jax.tree.map(lambda a, b: bool((a == b).all()), after[1], expected))


@pytest.mark.parametrize(
    ("name", "key"),
    [
        ("tic_tac_toe", lambda history, state: len(history)),
        ("tic_tac_toe", lambda history, state: str(state()).replace("o", "x")),  # forgets whose marks they are
        ("leduc_poker", lambda history, state: (*history[:1], *history[2:])),  # forgets player 2's card
        ("leduc_poker", lambda history, state: (*history[:2], len(history))),  # forgets the bets
        ("bargaining", lambda history, state: (*history[:1], *history[-1:], len(history) % 2)),  # forgets the turn
    ],
)
def test_a_wrong_key_is_detected(name, key):
    with pytest.raises(game_tables.NotMarkovError, match="differ"):
        game_tables.build(pyspiel.load_game(name), key)


@pytest.mark.parametrize(
    ("field", "change"),
    [
        ("players", lambda t: {"player_N": 3 - t.player_N}),
        ("observations", lambda t: {"observation_2NO": np.stack([t.observation_2NO[0], 1 - t.observation_2NO[1]])}),
        ("returns", lambda t: {"return_2N": t.return_2N + np.array([[0], [1]], np.float32)}),
        ("legal actions", lambda t: {"next_DA": np.where(np.arange(2) == 0, t.next_DA, -1)}),
        ("chance's probabilities", lambda t: {"chance_KC": t.chance_KC * np.array([1, 1, 0.999])}),
        ("keys", lambda t: {"next_DA": t.next_DA[:, ::-1], "outcome_KC": t.outcome_KC[:, ::-1]}),
    ],
)
def test_every_difference_is_seen(field, change):
    game = engine("kuhn_poker")
    walk = game_tables._walk(game, game_tables.whole_history, lambda fraction: None, 100)
    dealt, played = game.new_initial_state(), game.new_initial_state()
    for card in (2, 1):
        played.apply_action(card)
    changed = dataclasses.replace(walk.tables, **change(walk.tables))

    def difference(state, tables):
        node = walk.node_of[tuple(state.history())]
        return game_tables._difference(state, node, tables, game_tables.whole_history, walk.node_of)

    assert difference(dealt, walk.tables) is difference(played, walk.tables) is None
    assert field in (difference(dealt, changed), difference(played, changed))


class Secret:
    """A game in Python with the engine's methods: a bit that nobody sees is paid out three moves later."""

    def __init__(self, moves=()):
        self.moves = list(moves)

    def get_type(self):
        return SimpleNamespace(information=pyspiel.GameType.Information.PERFECT_INFORMATION)

    observation_tensor_shape = staticmethod(lambda: [1])
    num_distinct_actions = staticmethod(lambda: 2)
    max_chance_outcomes = staticmethod(lambda: 0)
    is_chance_node = staticmethod(lambda: False)
    new_initial_state = classmethod(lambda cls: cls())

    def observation_tensor(self, player):
        return [float(len(self.moves))]

    def is_terminal(self):
        return len(self.moves) == 4

    def current_player(self):
        return len(self.moves) % 2

    def legal_actions(self):
        return [] if self.is_terminal() else [0, 1] if not self.moves else [0]

    def returns(self):
        payment = float(self.moves[0]) if self.is_terminal() else 0.0
        return [payment, -payment]

    def history(self):
        return list(self.moves)

    def child(self, action):
        return Secret([*self.moves, action])

    def apply_action(self, action):
        self.moves.append(action)

    def __str__(self):
        return f"after {len(self.moves)} moves"


def test_what_a_key_forgets_may_matter_only_later():
    with pytest.raises(game_tables.NotMarkovError, match="returns differ"):
        game_tables.build(Secret(), game_tables.position)


def test_where_the_position_is_not_enough_the_history_is():
    tables = game_tables.build(Secret())
    assert len(tables.player_N) == 9 and tables.return_2N[0].tolist() == [0] * 8 + [1]


def test_a_board_is_one_node_however_it_came_about():
    trees = [game_tables.build(engine("tic_tac_toe"), max_nodes=6000)]
    assert len(trees[0].player_N) == 5478
    with pytest.raises(game_tables.TooLargeError):
        game_tables.build(engine("tic_tac_toe"), game_tables.whole_history, max_nodes=6000)


def test_the_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("SUITE_CACHE_DIR", str(tmp_path))
    built = openspiel.walked("leduc")
    (path,) = (tmp_path / "openspiel").iterdir()
    assert path.name == f"leduc-{importlib.metadata.version('open_spiel')}-{openspiel._builder()}.npz"
    whole = path.read_bytes()

    def walk(*_):
        raise AssertionError("walked again")

    with monkeypatch.context() as patch:
        patch.setattr(game_tables, "build", walk)
        assert_equal(openspiel.walked("leduc"), built)
        assert_equal(openspiel.walked("leduc_poker"), built)
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 0xFF
    np.savez(tmp_path / "other.npz", root=np.zeros(3))
    for broken in (
        b"",
        b"not a file of arrays",
        whole[: len(whole) // 2],
        flipped,
        (tmp_path / "other.npz").read_bytes(),
    ):
        path.write_bytes(broken)
        assert_equal(openspiel.walked("leduc"), built)
        assert_equal(openspiel.read_tables(path), built)
        assert [path] == list((tmp_path / "openspiel").iterdir())


def test_a_cache_that_cannot_be_written_costs_only_time(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("SUITE_CACHE_DIR", str(tmp_path / "file"))
    assert_equal(openspiel.walked("kuhn_poker"), games.walked("kuhn_poker"))


def assert_equal(one, other):
    for field in dataclasses.fields(one):
        a, b = getattr(one, field.name), getattr(other, field.name)
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("tic_tac_to", "unknown game openspiel/tic_tac_to: did you mean 'tic_tac_toe'?"),
        ("leduk", "unknown game openspiel/leduk: did you mean 'leduc'?"),
        (
            "matrix_rps",
            "its players move simultaneously; "
            "in openspiel/turn_based_simultaneous_game(game=matrix_rps()) they take turns",
        ),
        ("mfg_garnet", "it has 1 player, not two"),
        ("hearts", "it has 4 players, not two"),
        ("oware", "its observations are not whole numbers from 0 to 255"),
        ("sheriff", "the library gives no observation tensor for it"),
        ("negotiation", "it does not tell the probabilities of its chance events"),
        ("misere", "it needs parameters, as in misere(game=tic_tac_toe())"),
        ("efg_game", "it needs parameters, as in efg_game(filename=...)"),
        ("crazy_eights", "it has 5 players, not two; crazy_eights(players=2) has"),
        ("kuhn_poker(players=99)", ANY),
        ("chess", "its observations are not whole numbers from 0 to 255"),  # too large to be walked
    ],
)
@pytest.mark.parametrize("function", [openspiel.spec, openspiel.make])
def test_other_games_are_refused_in_one_line(function, name, line, tmp_path, monkeypatch, capfd):
    monkeypatch.setenv("SUITE_CACHE_DIR", str(tmp_path))
    with pytest.raises(UserError) as error:
        function(name)
    said = str(error.value)
    assert said == line or said.removeprefix(f"openspiel/{name} cannot be played here: ") == line
    assert "\n" not in said and capfd.readouterr().err == ""


def test_an_unknown_game_suggests_none_that_is_far_off_or_cannot_be_played():
    with pytest.raises(UserError, match="valid: ") as error:
        openspiel.spec("xyzzy")  # near to none of the games, also of those that other tests may have registered
    valid = str(error.value).partition("valid: ")[2].split(", ")
    assert "leduc" in valid and not {"coin_game", "hearts", "matrix_rps", "misere"} & set(valid)
    for word, near in (("connect4", "connect_four"), ("kuhn", "kuhn_poker"), ("kuhn_pokr(players=2)", "kuhn_poker")):
        with pytest.raises(UserError, match=f"did you mean '{near}'"):
            openspiel.spec(word)


def test_parameters_are_the_librarys(tmp_path, monkeypatch):
    monkeypatch.setenv("SUITE_CACHE_DIR", str(tmp_path))
    assert_equal(openspiel.walked("kuhn_poker(players=2)"), games.walked("kuhn_poker"))
    assert openspiel.spec("kuhn_poker(players=2)").id == "openspiel/kuhn_poker(players=2)"
    wide, square = openspiel.make("mnk(m=3,n=2,k=2)"), openspiel.make("mnk(m=2,n=2,k=2)")  # each has a file of its own
    assert (wide.spec.num_actions, square.spec.num_actions) == (6, 4)
    assert openspiel.spec("leduc(suit_isomorphism=true)").observation.shape < openspiel.spec("leduc").observation.shape


def test_a_game_is_told_in_the_librarys_text():
    states, moves = registry.task("openspiel/tic_tac_toe").text()([2, 4, 0, 5, 1])
    assert (states[0], states[-1]) == ("...\n...\n...", "xxx\n.oo\n...")
    assert moves == ["x(0,2)", "o(1,1)", "x(0,0)", "o(1,2)", "x(0,1)"] and len(states) == 6
    _, dealt = registry.task("openspiel/leduc").text()([0, 1])
    assert dealt == ["Chance outcome:0", "Chance outcome:1"]


def test_making_reports_progress(tmp_path, monkeypatch):
    monkeypatch.setenv("SUITE_CACHE_DIR", str(tmp_path))
    seen = []
    made = openspiel.make("leduc", lambda message, fraction: seen.append((message, fraction)))
    assert made.spec is openspiel.spec("leduc")
    fractions = [fraction for _, fraction in seen]
    assert fractions == sorted(fractions) and fractions[0] == 0 and fractions[-1] == 1 and len(fractions) > 3
    assert {message for message, _ in seen} == {"Loading openspiel/leduc"}


def test_the_specification_loads_no_engine():
    code = (
        "import sys; from adapters.openspiel.library import GAMES; from adapters.openspiel.task import spec;"
        "specs = [spec(name) for name in GAMES];"
        "sys.exit('pyspiel' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
