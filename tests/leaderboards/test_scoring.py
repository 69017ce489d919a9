"""Scores against computation by hand."""

from __future__ import annotations

import dataclasses
import math

import pandas as pd
import pytest

from leaderboards import scoring
from suite.config import Config, EnvironmentConfig, PPOConfig, ProtocolConfig, ReplayConfig
from tests.tiny import CORRIDOR_SPEC

SPEC = dataclasses.replace(CORRIDOR_SPEC, achievements=("wood", "iron"), max_return=2.0)
CONFIG = Config(
    "corridor",
    "m5",
    "paper",
    protocol=ProtocolConfig(steps=1000, final_fraction=0.1),
    environment=EnvironmentConfig(num_envs=2, rollout_length=40),
    ppo=PPOConfig(minibatches=1),
    replay=ReplayConfig(capacity=1000),
)
COLUMNS = ["step", "return", "length", "achievement_return", "wood", "iron"]
ROWS = [
    (100, -0.9, 10, 0.0, 0, 0),
    (500, 0.1, 10, 1.0, 1, 0),
    (900, 0.1, 10, 1.0, 1, 0),  # exactly where the last tenth begins: not in it
    (901, 1.1, 10, 2.0, 1, 1),
    (1000, 0.0, 10, 0.0, 0, 0),  # exactly at the budget's end: in it
    (1001, 2.0, 10, 2.0, 1, 1),  # beyond: counts nowhere
]


def episodes(rows=ROWS):
    return pd.DataFrame(rows, columns=COLUMNS)


def test_reward_is_the_mean_over_the_last_tenth_and_success_over_all():
    scores = scoring.craftax(episodes(), CONFIG, SPEC)
    assert scores["reward_percent"] == pytest.approx(100 * (2.0 + 0.0) / 2 / 2)
    assert scores["reward_percent_with_health"] == pytest.approx(100 * (1.1 + 0.0) / 2 / 2)
    assert scores["success_percent/wood"] == pytest.approx(60)  # 3 of 5
    assert scores["success_percent/iron"] == pytest.approx(20)
    # exp((ln 61 + ln 21) / 2) - 1 = sqrt(61 * 21) - 1
    assert scores["score_percent"] == pytest.approx(math.sqrt(61 * 21) - 1)
    assert (scores["episodes"], scores["final_episodes"]) == (5, 2)


def test_without_a_protocol_all_episodes_count():
    scores = scoring.craftax(ROWS and episodes().to_dict("records"), None, SPEC)
    assert (scores["episodes"], scores["final_episodes"]) == (6, 6)
    assert scores["reward_percent"] == pytest.approx(100 * 6 / 6 / 2)


@pytest.mark.parametrize(("rates", "score"), [([0.0] * 22, 0.0), ([100.0] * 22, 100.0), ([100.0] + [0.0] * 21, 0.2334)])
def test_crafter_score(rates, score):
    """The last: 101 ** (1 / 22) - 1. One mastered achievement is worth little."""
    assert scoring.crafter_score(rates) == pytest.approx(score, abs=1e-4)


@pytest.mark.parametrize("config", [CONFIG, None])
def test_no_episodes_is_nan_and_not_an_error(config, tmp_path):
    path = tmp_path / "episodes.csv"
    path.write_text(",".join(COLUMNS) + "\n")
    for empty in (pd.read_csv(path), []):
        scores = scoring.craftax(empty, config, SPEC)
        assert scores["episodes"] == scores["final_episodes"] == 0
        assert all(math.isnan(value) for name, value in scores.items() if "percent" in name)


def test_no_episode_in_the_last_tenth_leaves_the_score():
    scores = scoring.craftax(episodes(ROWS[:2]), CONFIG, SPEC)
    assert math.isnan(scores["reward_percent"])
    assert scores["score_percent"] == pytest.approx(math.sqrt(51 * 1) - 1)
