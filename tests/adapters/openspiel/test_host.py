"""Games too large for tables are the engine's games, and small ones played so are the same as their tables."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pyspiel
import pytest

from adapters.openspiel import host as openspiel_host
from adapters.openspiel import tables as game_tables
from adapters.openspiel import task as openspiel
from adapters.openspiel.library import GAMES
from suite import registry
from suite.interface.host import HostEnvironment
from suite.runs import training
from suite.runtime.errors import RunError, UserError
from suite.runtime.reporting import QuietReporter
from tests import games
from tests.adapters.pettingzoo.standard import check
from tests.contract import check_environment

SMALL = ["tic_tac_toe", "leduc", "kuhn_poker"]


def engine(name):
    return pyspiel.load_game(GAMES.get(name, name))


@functools.cache
def hosted(name):
    """A game as if it were too large, whether it is or not; the specification of a small one is its tables'."""
    return openspiel_host.make(
        engine(name), games.game(name).spec if name in SMALL else openspiel.measured_by_play(name)
    )


@pytest.mark.parametrize(
    ("name", "steps", "num_envs", "least"), [("tic_tac_toe", 400, 32, 1500), ("leduc", 400, 32, 1500)]
)
def test_small_games_are_the_engines_and_as_in_their_tables(name, steps, num_envs, least):
    """Event by event: the same randomness chooses the same events as long as everything shown is the same."""
    played = games.play(hosted(name), steps, num_envs)
    assert games.check_against_engine(played, engine(name), signs=name == "leduc") >= least
    jax.tree.map(np.testing.assert_array_equal, played, games.play(games.game(name), steps, num_envs))


@pytest.mark.parametrize(
    ("name", "signs", "steps", "num_envs", "least"),
    [
        ("connect_four", False, 200, 16, 100),
        ("pig", False, 600, 8, 15),  # chance acts every other time
        ("hanabi", False, 200, 4, 10),  # hidden hands, and returns that are known before the end
        ("repeated_leduc_poker", True, 200, 8, 50),
    ],
)
def test_large_games_are_the_engines(name, signs, steps, num_envs, least):
    assert games.check_against_engine(games.play(hosted(name), steps, num_envs), engine(name), signs) >= least


@pytest.mark.parametrize(("name", "steps"), [("connect_four", 50), ("pig", 300)])
def test_the_contract(name, steps):
    assert check_environment(hosted(name), jax.random.key(0), steps, num_envs=4).ended.any()


def test_pettingzoo_has_them_too():
    check(hosted("pig"))


@pytest.mark.parametrize(
    ("name", "high", "rewards"),
    [
        ("connect_four", 1, (-1, 0, 1)),
        ("kuhn_poker", 4, (-2, -1, 0, 1, 2)),  # shows at most 2
        ("hanabi", 1, tuple(range(26))),  # of which random play hardly sees any but 0
        ("mancala", 142, (-1, 0, 1)),  # counts moves, and longer games may come
        ("leduc_poker", 26, tuple(range(-13, 14))),
        ("repeated_leduc_poker", 26, (-1, 0, 1)),  # pays -26..26
        ("tiny_bridge_2p", 1, (-1, 0, 1)),  # pays thirds
    ],
)
def test_what_random_play_measures(name, high, rewards):
    spec = openspiel.measured_by_play(name)
    assert (spec.observation.high, spec.reward_classes) == (high, rewards)
    if openspiel.canonical_name(name) in SMALL:
        tabled = games.game(openspiel.canonical_name(name)).spec
        assert spec.observation.shape == tabled.observation.shape
        assert (spec.num_actions, spec.chance_outcomes) == (tabled.num_actions, tabled.chance_outcomes)


def test_episodes_are_truncated_at_a_limit_that_only_the_longest_games_reach():
    assert hosted("connect_four").limit == 42 and hosted("pig").limit == 2000
    spec = hosted("connect_four").spec
    assert openspiel_host.make(engine("chinese_checkers"), spec).limit == openspiel_host.LIMIT


def test_what_cannot_happen_changes_nothing():
    for name, events, impossible in [
        ("tic_tac_toe", [0, 3, 1, 4], [-1, 9, 1000, 0, 4]),
        ("leduc", [], [-1, 6]),
        ("leduc", [2], [2, -1, 6]),  # a card that is dealt
        ("leduc", [2, 4], [0, -1, 3]),  # no fold before a bet
    ]:
        hosted_engine = openspiel_host.OpenSpielEngine(engine(name), games.game(name).spec)
        for seed in (0, 1):  # which does not matter
            shown = hosted_engine.reset(seed)
            for event in events:
                shown = hosted_engine.step(event)
            for event in impossible:
                after = hosted_engine.step(event)
                jax.tree.map(np.testing.assert_array_equal, after, shown)
                assert not after.reward.any()


def test_an_unexpected_observation_is_one_line():
    spec = hosted("leduc").spec
    low = dataclasses.replace(spec, observation=dataclasses.replace(spec.observation, high=1))
    leduc = openspiel_host.OpenSpielEngine(engine("leduc"), low)
    leduc.reset(0)
    leduc.step(0)
    leduc.step(1)
    line = "an observation holds {}, not a whole number from 0 to {}"
    with pytest.raises(RunError) as error:
        leduc.step(2)
    assert str(error.value) == line.format(3, 1)
    oware = openspiel_host.OpenSpielEngine(engine("oware"), dataclasses.replace(spec, num_actions=6))
    with pytest.raises(RunError) as error:
        oware.reset(0)
    assert str(error.value) == line.format("0.0833333", spec.observation.high)
    with pytest.raises(
        Exception, match=r"openspiel/leduc, step 3 of the episode of seed [0-9]+: an observation holds 3, not a whole"
    ):
        environment = openspiel_host.make(engine("leduc"), low)
        state, _ = environment.reset(jax.random.key(0), jnp.int32(1))
        for event in (0, 1, 2):
            state, _ = environment.step(jax.random.key(0), state, jnp.int32(event))


@pytest.fixture
def small_tables(tmp_path, monkeypatch):
    monkeypatch.setenv("SUITE_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(game_tables, "MAX_NODES", 1000)
    return tmp_path


def test_that_a_game_is_too_large_is_remembered(small_tables, monkeypatch):
    spec = openspiel.spec("connect_four")
    assert spec == hosted("connect_four").spec
    (path,) = (small_tables / "openspiel").iterdir()
    assert path.name.startswith("connect_four-") and path.name.endswith(f"-{openspiel._builder()}.too_large")

    def walk(*_):
        raise AssertionError("walked again")

    monkeypatch.setattr(game_tables, "build", walk)
    seen = []
    environment = openspiel.make("connect_four", lambda message, fraction: seen.append(fraction))
    assert isinstance(environment, HostEnvironment) and environment.spec == openspiel.spec("connect_four") == spec
    assert seen == sorted(seen) and seen[-1] == 1
    with pytest.raises(UserError, match=r"^openspiel/connect_four is too large for tables$"):
        openspiel.walked("connect_four")


def test_a_cache_that_cannot_be_written_costs_only_time(small_tables, monkeypatch):
    (small_tables / "file").touch()
    monkeypatch.setenv("SUITE_CACHE_DIR", str(small_tables / "file"))
    for _ in range(2):
        assert openspiel.spec("connect_four") == hosted("connect_four").spec


@pytest.mark.parametrize("name", ["chess", "yacht"])
def test_too_large_and_not_categorical(small_tables, name):
    for ask in (openspiel.spec, openspiel.make, openspiel.spec):
        with pytest.raises(UserError) as error:
            ask(name)
        reason = "its observations are not whole numbers from 0 to 255"
        assert str(error.value) == f"openspiel/{name} cannot be played here: {reason}"


def test_a_run_is_scored_without_a_reference(small_tables, tmp_path):
    overrides = ["protocol.steps=384", "protocol.final_fraction=1"]
    config = registry.resolve("openspiel/connect_four", "random", "smoke", overrides)
    result = training.run(config, tmp_path / "runs", QuietReporter())
    assert result.status == "finished"
    assert "normalized_return" not in result.scores and result.scores["episodes"] > 0
    assert -1 <= result.scores["return"] <= 1
