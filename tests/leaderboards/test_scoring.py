"""Scores against computation by hand."""

from __future__ import annotations

import csv
import dataclasses
import math
from pathlib import Path

import pandas as pd
import pytest

from leaderboards import scoring
from leaderboards.best_response import Reference
from suite.configuration.schema import Config, EnvironmentConfig, PPOConfig, ProtocolConfig, ReplayConfig
from suite.records.record import RunRecord
from tests.tiny import CORRIDOR_SPEC

SPEC = dataclasses.replace(CORRIDOR_SPEC, achievements=("wood", "iron"), achievement_rewards=(1.0, 1.0))
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


def test_achievements_that_pay_more_are_also_counted_by_tier():
    spec = dataclasses.replace(SPEC, achievements=("wood", "iron", "bow"), achievement_rewards=(1.0, 1.0, 3.0))
    rows = pd.DataFrame(ROWS, columns=COLUMNS).assign(bow=[0, 0, 0, 1, 0, 1])
    rows["achievement_return"] += 3 * rows["bow"]
    scores = scoring.craftax(rows, CONFIG, spec)
    assert scores["reward_percent"] == pytest.approx(100 * (5.0 + 0.0) / 2 / 5)
    assert scores["success_percent_basic"] == pytest.approx((60 + 20) / 2)
    assert scores["success_percent_intermediate"] == pytest.approx(20)
    assert not [name for name in scoring.craftax(episodes(), CONFIG, SPEC) if name.startswith("success_percent_")]


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


GAME_ROWS = [
    # step, return, length, raw_return, seat
    (100, -1.0, 5, -13.0, 1),
    (900, 1.0, 5, 9.0, 2),  # exactly where the last tenth begins: not in it
    (901, 1.0, 5, 5.0, 1),
    (950, -1.0, 5, -2.0, 1),
    (1000, 1.0, 5, 4.0, 2),
    (1001, 1.0, 5, 13.0, 2),  # beyond the budget
]


def game_episodes(rows=GAME_ROWS):
    return pd.DataFrame(rows, columns=["step", "return", "length", "raw_return", "seat"])


def test_a_games_return_is_the_mean_of_its_seats():
    scores = scoring.games(game_episodes(), CONFIG, dataclasses.replace(SPEC, id="openspiel/other"))
    assert scores == {
        "return_seat_1": 1.5,
        "return_seat_2": 4.0,
        "return": 2.75,
        "episodes": 5,
        "final_episodes": 3,
    }


def test_a_games_normalized_return(monkeypatch):
    monkeypatch.setitem(scoring.REFERENCE, "corridor", Reference(random=(0.5, -1.0), best_response=(2.5, 9.0)))
    assert scoring.games(game_episodes(), CONFIG, SPEC)["normalized_return"] == pytest.approx((0.5 + 0.5) / 2)


def test_a_game_without_a_protocol_counts_all_episodes():
    scores = scoring.games(game_episodes().to_dict("records"), None, SPEC)
    assert (scores["episodes"], scores["final_episodes"]) == (6, 6)
    assert (scores["return_seat_1"], scores["return_seat_2"]) == (pytest.approx(-10 / 3), pytest.approx(26 / 3))


@pytest.mark.parametrize("config", [CONFIG, None])
def test_no_games_are_nan_and_not_an_error(config):
    for empty in (game_episodes([]), []):
        scores = scoring.games(empty, config, dataclasses.replace(SPEC, id="openspiel/leduc"))
        assert scores["episodes"] == scores["final_episodes"] == 0
        assert all(math.isnan(value) for name, value in scores.items() if "return" in name)


def by_hand(path, budget, final_fraction):
    """Crafter's published formulas on a real `episodes.csv`, with nothing but arithmetic."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    names = [name for name in rows[0] if name.startswith(("collect_", "place_", "make_", "defeat_", "eat_", "wake_"))]
    success = {name: 100 * math.fsum(float(row[name]) for row in rows) / len(rows) for name in names}
    score = math.exp(math.fsum(math.log(1 + percent) for percent in success.values()) / len(success)) - 1
    last = [row for row in rows if float(row["step"]) > budget * (1 - final_fraction)]
    unlocked = math.fsum(sum(float(row[name]) for name in names) for row in last) / len(last)
    returned = math.fsum(float(row["return"]) for row in last) / len(last)
    rewards = 100 * unlocked / len(names), 100 * returned / len(names)
    return dict(zip(("reward_percent", "reward_percent_with_health"), rewards, strict=True)), score, success


@pytest.mark.parametrize("agent", ["random", "mfrl", "m5"])
def test_real_records_by_hand(agent):
    folder = Path(__file__).parents[2] / "leaderboards/evidence/craftax_classic" / agent / "small/seed_0"
    record = RunRecord.open(folder, lock=False)
    found = scoring.craftax(record.episodes(), record.config, record.spec)
    rewards, score, success = by_hand(folder / "episodes.csv", 40_960, 0.2)
    assert len(success) == 22
    for name, value in rewards.items():
        assert found[name] == pytest.approx(value, rel=1e-9)
    assert found["score_percent"] == pytest.approx(score, rel=1e-9)
    for name, percent in success.items():
        assert found[f"success_percent/{name}"] == pytest.approx(percent, rel=1e-9)
