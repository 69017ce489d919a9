from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from suite.interface.tokens import TokenSpec, decode_frame, encode_frame
from suite.interface.turns import Turn


def spec_of(levels):
    return TokenSpec(tokens_per_frame=1, num_codes=2, num_actions=2, reward_classes=tuple(levels))


@pytest.mark.parametrize(
    ("reward", "expected"), [(-0.9, 0), (0.0, 0), (0.4999, 0), (0.5, 1), (0.9, 1), (1.0, 1), (1.1, 1), (7.0, 1)]
)
def test_binary_reward_is_at_least_a_half(reward, expected):
    assert int(spec_of((0.0, 1.0)).reward_to_class(jnp.float32(reward))) == expected


@given(
    st.lists(st.integers(-20, 20), min_size=1, max_size=8, unique=True),
    st.lists(st.integers(-120, 120), min_size=1, max_size=8),
)
@settings(max_examples=60, deadline=None)
def test_nearest_level_and_ties_go_up(levels, quarters):
    """Quarters and whole levels are exact in float32, so ties are real ties."""
    levels = np.array(sorted(levels), np.float32)
    rewards = np.array(quarters, np.float32) / 4
    distance = np.abs(rewards[:, None] - levels)
    expected = [int(np.flatnonzero(row == row.min())[-1]) for row in distance]
    index = spec_of(levels.tolist()).reward_to_class(jnp.asarray(rewards))
    assert index.dtype == jnp.int32
    assert index.tolist() == expected


def test_classes_and_levels_are_inverse():
    spec = spec_of((0.0, 1.0, 3.0, 5.0, 8.0))
    index = jnp.arange(5).reshape(5, 1)
    rewards = spec.class_to_reward(index)
    assert rewards.dtype == jnp.float32 and rewards.shape == (5, 1)
    assert rewards.ravel().tolist() == [0, 1, 3, 5, 8]
    np.testing.assert_array_equal(spec.reward_to_class(rewards), index)


class Identity:
    encode = decode = staticmethod(lambda state, x: x)


@pytest.mark.parametrize("seat", [1, 2])
def test_a_frame_of_a_game_is_both_observations_player_one_first(seat):
    ours, theirs = jnp.array([[1, 2, 3]]), jnp.array([[4, 5, 6]])
    no = jnp.zeros((1, 0))
    turn = Turn(jnp.array([1]), jnp.array([seat]), no, no, theirs)
    tokens = encode_frame(Identity(), None, ours, turn)
    assert tokens.tolist() == ([[1, 2, 3, 4, 5, 6]] if seat == 1 else [[4, 5, 6, 1, 2, 3]])
    back = decode_frame(Identity(), None, tokens, turn.seat)
    assert [x.tolist() for x in back] == [ours.tolist(), theirs.tolist()]


def test_a_frame_for_one_player_is_its_observation():
    frame = jnp.array([[1, 2, 3]])
    assert encode_frame(Identity(), None, frame, None) is frame
    ours, theirs = decode_frame(Identity(), None, frame, None)
    assert ours is frame and theirs is None
