"""What rollouts are measured by: the environment itself is perfect, and a constant is as wrong as counting says."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from suite.diagnostics.evaluation_set import EvaluationSet
from suite.diagnostics.rollouts import (
    Rollouts,
    calibration_error,
    compare,
    mean_per_step,
    precision_recall,
    squared_error,
)
from suite.interface.tokens import TokenSpec

TOKENS = TokenSpec(tokens_per_frame=4, num_codes=8, num_actions=2, reward_classes=(0.0, 1.0))
# Three walks of three steps; the second ends at its second step, paid; the third is paid first and goes on.
ENDED = np.array([[0, 0, 0], [0, 1, 0], [0, 0, 0]], bool)
REWARD = np.array([[0, 0, 0], [0, 1, 1], [0.9, -0.1, 0]], np.float32)
PLACE = np.array([[0, 1, 2, 3], [1, 2, 0, 0], [2, 2, 1, 0]])


def frames_of(place):
    """A white pixel of four."""
    return (255 * np.eye(4, dtype=np.uint8)[place]).reshape(*place.shape, 2, 2, 1)


def read(frames):
    """Two symbols: where the white pixel is, and whether there is one."""
    flat = frames.reshape(*frames.shape[:-3], 4)
    return np.stack([flat.argmax(-1), flat.max(-1) > 0], -1).astype(np.int32)


@pytest.fixture
def real():
    frames = frames_of(PLACE)
    return EvaluationSet(
        frames=frames,
        action=np.zeros((3, 3), np.int32),
        reward=REWARD,
        terminated=ENDED,
        ended=ENDED,
        symbols=read(frames[:, 1:]),
        paid=np.zeros((3, 3, 2), np.uint8),
    )


@pytest.fixture
def perfect(real):
    odds = np.eye(2, dtype=np.float32)[(REWARD >= 0.5).astype(int)]
    return Rollouts(
        frames=real.frames[:, 1:],
        reward=(REWARD >= 0.5).astype(np.float32),
        terminated=ENDED,
        tokenized=real.frames,
        reward_odds=odds,
        termination_odds=ENDED.astype(np.float32),
        codes=np.arange(4),
        copied=np.full(REWARD.shape, 0.5, np.float32),
    )


def test_the_environment_itself(real, perfect):
    rows, summary = compare(real, perfect, TOKENS, 255, read)
    for row in (*rows, summary):
        assert row["error"] == row["tokenizer_error"] == 0
        for name in ("frames", "symbols", "tokenizer_symbols", "real_symbols", "reward", "termination"):
            assert row[f"{name}_percent"] == 100
        assert row["copied_percent"] == 50
        for event in ("reward", "termination"):
            assert row[f"{event}_probability"] == row[f"{event}_frequency"]
    for event in ("reward", "termination"):
        assert summary[f"{event}_precision_percent"] == summary[f"{event}_recall_percent"] == 100
        assert summary[f"{event}_calibration_error"] == 0
    assert [row["reward_recall_percent"] for row in rows[:2]] == [row["reward_precision_percent"] for row in rows[:2]]
    assert rows[0]["reward_recall_percent"] == 100
    assert summary["codes_used"] == 4 and summary["steps"] == 3 and summary["trajectories"] == 3
    assert [row["step"] for row in rows] == [1, 2, 3]


def test_a_constant(real, perfect):
    """Always the frame of place 0, no reward, no end, ends foreseen with 0.25."""
    constant = dataclasses.replace(
        perfect,
        frames=frames_of(np.zeros((3, 3), int)),
        tokenized=frames_of(np.zeros((3, 4), int)),
        reward=np.zeros((3, 3), np.float32),
        terminated=np.zeros((3, 3), bool),
        reward_odds=np.tile(np.float32([1, 0]), (3, 3, 1)),
        termination_odds=np.full((3, 3), 0.25, np.float32),
        codes=None,
    )
    rows, summary = compare(real, constant, TOKENS, 255, read)
    # Frames that count: places 1 2 2, then 2 1 (an end), then 3 0. A wrong one has two wrong pixels of four.
    assert [row["error"] for row in rows] == pytest.approx([2, 2, 1])
    # The second symbol is always right, the first where the place is 0.
    assert [row["symbols_percent"] for row in rows] == pytest.approx([50, 50, 75])
    assert [row["real_symbols_percent"] for row in rows] == [100, 100, 100]
    # Repeating the first frames 0 1 2: right in the third trajectory's first step alone.
    assert [row["repeated_error"] for row in rows] == pytest.approx([4 / 3, 2, 2])
    assert [row["repeated_symbols_percent"] for row in rows] == pytest.approx([100 * 4 / 6, 50, 50])
    # Steps that count: 3, 3 and, after the end, 2.
    assert [row["reward_percent"] for row in rows] == pytest.approx([100 * 2 / 3, 100 * 2 / 3, 100])
    assert [row["reward_recall_percent"] for row in rows] == pytest.approx([0, 0, math.nan], nan_ok=True)
    assert [row["termination_percent"] for row in rows] == pytest.approx([100, 100 * 2 / 3, 100])
    assert [row["termination_frequency"] for row in rows] == pytest.approx([0, 100 / 3, 0])
    assert summary["error"] == pytest.approx(12 / 7)
    assert summary["tokenizer_error"] == pytest.approx(16 / 10)  # first frames besides, of which one is right
    assert summary["reward_frequency"] == pytest.approx(25) and summary["reward_probability"] == 0
    assert summary["reward_recall_percent"] == summary["termination_recall_percent"] == 0
    assert math.isnan(summary["reward_precision_percent"])
    assert summary["reward_calibration_error"] == pytest.approx(25)
    assert summary["termination_calibration_error"] == pytest.approx(100 * (0.25 - 1 / 8))
    assert "codes_used" not in summary


def test_whole_frames(real, perfect):
    """Of the frames that count (see above) only the last one shows place 0."""
    found = dataclasses.replace(perfect, frames=frames_of(np.zeros((3, 3), int)), copied=None)
    rows, summary = compare(real, found, TOKENS, 255, None)
    assert [row["frames_percent"] for row in rows] == pytest.approx([0, 0, 50])
    assert [row["repeated_frames_percent"] for row in rows] == pytest.approx([100 / 3, 0, 0])
    assert "copied_percent" not in summary


def test_without_symbols_and_for_fewer_steps(real, perfect):
    cut = {name: value[:, :2] for name, value in vars(perfect).items() if name not in ("codes", "tokenized")}
    short = Rollouts(**cut, tokenized=perfect.tokenized[:, :3], codes=None)
    rows, summary = compare(real, short, TOKENS, 255, None)
    assert len(rows) == 2 and summary["error"] == 0
    assert not [name for name in summary if "symbols" in name]


def test_the_measures_themselves():
    a = np.zeros((1, 2, 1, 1, 2), np.uint8)
    assert squared_error(a + np.uint8(1), a, 2).tolist() == [[0.5, 0.5]]
    assert squared_error(a, a + np.uint8(255), 255).tolist() == [[2, 2]]  # no wrapping of bytes
    means = mean_per_step(np.array([[1.0, 5], [3, 7]]), np.array([[True, False], [True, False]]))
    assert means[0] == 2 and math.isnan(means[1])
    assert precision_recall(np.array([1, 1, 1, 0, 2]), np.array([1, 0, 0, 1, 1]), 0) == (1 / 4, 1 / 3)
    assert all(map(math.isnan, precision_recall(np.zeros(3), np.zeros(3), 0)))
    # Two bins: 0.9 said of what happens half the time, 0.1 of what never happens.
    probability, happened = np.array([0.9, 0.9, 0.1, 0.1]), np.array([True, False, False, False])
    assert calibration_error(probability, happened) == pytest.approx((0.4 + 0.1) / 2)
    assert calibration_error(np.ones(2), np.ones(2, bool)) == 0
    assert math.isnan(calibration_error(np.zeros(0), np.zeros(0, bool)))
