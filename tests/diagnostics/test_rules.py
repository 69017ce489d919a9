"""The check that a world model keeps a game's rules: it sees a good model and a bad one for what they are."""

from __future__ import annotations

import math

import jax
import numpy as np
import pytest

from suite import registry
from suite.diagnostics import rules
from suite.diagnostics.rules import rules_kept, rules_of_run
from suite.runs import training
from suite.runtime.errors import UserError
from suite.runtime.reporting import QuietReporter
from tests.tiny import CORRIDOR, PENNIES
from tests.world_model.pennies import learned

EVENTS = ("legal", "player", "legal_set", "observations", "reward", "terminated")


@pytest.mark.parametrize("uniform", [False, True])
def test_a_model_that_knows_the_rules_and_one_that_knows_nothing(uniform):
    agent, state, _, model, _ = learned()

    def kept_by(params):
        return rules_kept(agent, state.policy, params, state.tokenizer, jax.random.key(0), 200, uniform)

    kept = kept_by(model.params)
    assert kept["games"] == 200 and kept["events"] > 300
    for name in EVENTS:
        assert kept[f"{name}_percent"] > 90, name
    assert kept["return_percent"] > 80
    assert kept["chance_largest_z"] < 4
    assert math.isnan(kept["chance_error_percent"])  # chance acts at a game's start only, which is not imagined

    broken = kept_by(agent.init(jax.random.key(5)).world_model.params)
    assert broken["legal_percent"] < 95 and broken["player_percent"] < 70
    assert broken["observations_percent"] < 50 and broken["return_percent"] < 50


def test_chance_that_does_as_it_should_and_chance_that_does_not():
    odds = np.tile([0.5, 0.3, 0.2, 0.0], (4000, 1))
    fair = np.random.default_rng(0).choice(4, 4000, p=odds[0])
    assert rules.largest_z(fair, odds) < 4
    assert rules.largest_z(np.where(np.arange(4000) % 10 == 0, 2, fair), odds) > 8
    by_hand = np.array([0] * 60 + [1] * 40)
    assert rules.largest_z(by_hand, np.full((100, 2), 0.5)) == pytest.approx(2)  # 10 too many, deviation 5
    assert math.isnan(rules.largest_z(np.full(10, -1), np.zeros((10, 2))))  # nowhere did chance act


def test_of_a_run(tmp_path, monkeypatch):
    monkeypatch.setattr(registry, "TASKS", (CORRIDOR, PENNIES))
    game = training.run(registry.resolve("pennies", "m5", "smoke"), tmp_path, QuietReporter())
    kept = rules_of_run(game.folder, games=8)
    assert kept["agent"]["games"] == 8 and 0 <= kept["uniform"]["legal_percent"] <= 100
    alone = training.run(registry.resolve("corridor", "random", "smoke"), tmp_path, QuietReporter())
    with pytest.raises(UserError, match="has no world model of a two-player game"):
        rules_of_run(alone.folder)
