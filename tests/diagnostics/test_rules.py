"""The check that a world model keeps a game's rules: it sees a good model and a bad one for what they are."""

from __future__ import annotations

import math

import jax
import pytest

from suite import registry, run
from suite.diagnostics.rules import rules_kept, rules_of_run
from suite.errors import UserError
from suite.reporting import QuietReporter
from tests.tiny import CORRIDOR, PENNIES
from tests.world_model.test_games import learned


def test_a_model_that_knows_the_rules_and_one_that_knows_nothing():
    agent, state, _, model, _ = learned()
    kept = rules_kept(agent, model.params, state.tokenizer, jax.random.key(0), plays=200)
    assert kept["plays"] == 200 and kept["events"] > 300
    for name in ("legal", "player", "legal_set", "observations", "reward", "terminated"):
        assert kept[f"{name}_percent"] > 90, name
    assert math.isnan(kept["chance_error_percent"])  # chance acts at a game's start only, which is not compared

    fresh = agent.init(jax.random.key(5)).world_model.params
    broken = rules_kept(agent, fresh, state.tokenizer, jax.random.key(0), plays=200)
    assert broken["legal_percent"] < 95 and broken["player_percent"] < 70
    assert broken["observations_percent"] < 50


def test_of_a_run(tmp_path, monkeypatch):
    monkeypatch.setattr(registry, "TASKS", (CORRIDOR, PENNIES))
    game = run.run(registry.resolve("pennies", "m5", "smoke"), tmp_path, QuietReporter())
    assert 0 <= rules_of_run(game.folder, plays=8)["legal_percent"] <= 100
    alone = run.run(registry.resolve("corridor", "random", "smoke"), tmp_path, QuietReporter())
    with pytest.raises(UserError, match="has no world model of a two-player game"):
        rules_of_run(alone.folder)
