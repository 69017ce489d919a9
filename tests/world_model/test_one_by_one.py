"""Frames imagined token by token (M1 to M4)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from suite.world_model.block_teacher_forcing import sample_one_by_one
from suite.world_model.imagination import next_frame
from suite.world_model.training import losses
from tests.world_model.small import SPEC, random_sequences, small_config, small_model

SEQUENCES = random_sequences(batch=4)
VALID = jnp.arange(SPEC.num_codes) < 7


def nats(logits, target):
    return -np.take_along_axis(np.asarray(jax.nn.log_softmax(logits), np.float64), np.asarray(target)[..., None], -1)[
        ..., 0
    ]


@pytest.mark.parametrize("positions", ["flat", "grid"])
def test_the_samplers_joint_probability_is_the_teacher_forced_one(positions):
    """The last frame too, which needs room in the cache beyond `length` steps."""
    model = small_model(std=0.2, positions=positions, block_teacher_forcing=False)
    steps = 4
    cache = model.init_cache(4, steps)
    frames, actions = SEQUENCES.tokens_BTL, SEQUENCES.action_BT
    for time in range(steps):
        cache, hidden_BSD = model.step(cache, frames[:, time], actions[:, time])
    tokens_BL, log_BL = sample_one_by_one(jax.random.key(0), model, cache, hidden_BSD[:, -1], VALID)
    assert tokens_BL.shape == (4, 6) and int(tokens_BL.max()) < 7

    forced = jnp.concatenate([frames[:, :steps], tokens_BL[:, None]], axis=1)
    logits_BTLK = model.observation_logits(model(forced, actions[:, : steps + 1]))
    logits_BTLK = jnp.where(VALID[None, None, None], logits_BTLK, -jnp.inf)
    first = -nats(logits_BTLK[:, steps - 1, -1], tokens_BL[:, 0])
    rest = -nats(logits_BTLK[:, steps, :-1], tokens_BL[:, 1:])
    np.testing.assert_allclose(log_BL[:, 0], first, atol=1e-5)
    np.testing.assert_allclose(log_BL[:, 1:], rest, atol=1e-5)
    np.testing.assert_allclose(log_BL.sum(1), first + rest.sum(1), atol=1e-4)


def test_the_next_step_starts_behind_the_frame_not_behind_its_samples():
    model = small_model(std=0.2, block_teacher_forcing=False)
    cache = model.init_cache(4, 5)
    frames, actions = SEQUENCES.tokens_BTL, SEQUENCES.action_BT
    cache, _, tokens_BL = next_frame(jax.random.key(0), model, cache, frames[:, 0], actions[:, 0], VALID)
    assert int(cache.index) == 7
    _, hidden_BSD = model.step(cache, tokens_BL, actions[:, 1])
    whole = model(jnp.stack([frames[:, 0], tokens_BL], axis=1), actions[:, :2])
    np.testing.assert_allclose(hidden_BSD, whole[:, 1], atol=1e-5)


def test_losses_by_hand():
    """Fidelity note 19, one sequence and token at a time."""
    config = small_config(block_teacher_forcing=False)
    model = small_model(std=0.2, block_teacher_forcing=False)
    _, metrics = losses(model, SEQUENCES, config, SPEC)
    frames = np.asarray(SEQUENCES.tokens_BTL)
    hidden_BTSD = model(
        SEQUENCES.tokens_BTL, jnp.concatenate([SEQUENCES.action_BT, SEQUENCES.action_BT[:, :1]], axis=1)
    )
    total, correct, changed, count, changes = 0.0, 0, 0, 0, 0
    for b in range(4):
        for t in range(6):
            for place in range(7):
                if place == 5 or (t, place) == (5, 6):  # a frame's last token predicts nothing, and the end neither
                    continue
                when, which = (t + 1, 0) if place == 6 else (t, place + 1)
                target = frames[b, when, which]
                logits = model.observation_head(hidden_BTSD[b, t, place][None])[0]
                total += float(nats(logits, target))
                right = int(np.argmax(logits)) == target
                correct, count = correct + right, count + 1
                if when > 0 and frames[b, when - 1, which] != target:
                    changes, changed = changes + 1, changed + right
    np.testing.assert_allclose(metrics["observation_loss"], total / count, rtol=1e-5)
    np.testing.assert_allclose(metrics["token_accuracy"], correct / count, rtol=1e-5)
    np.testing.assert_allclose(metrics["changed_token_accuracy"], changed / changes, rtol=1e-5)
    assert count == 4 * (5 * 6 + 5)
    rewards = nats(model.reward_logits(hidden_BTSD[:, :5]), SPEC.reward_to_class(SEQUENCES.reward_BT))
    np.testing.assert_allclose(metrics["reward_loss"], rewards.mean(), rtol=1e-5)


def test_masking_after_an_end_keeps_the_frame_that_led_to_it():
    """Sequence 0 ends at its step 1: tokens of frames 0 and 1 count, the first one of frame 2 and later ones do not."""
    ended = jnp.zeros((4, 5), bool).at[0, 1].set(True)
    sequences = SEQUENCES.replace(terminated_BT=ended)
    config = small_config(block_teacher_forcing=False, mask_after_done=True)
    model = small_model(std=0.2, block_teacher_forcing=False)
    _, metrics = losses(model, sequences, config, SPEC)
    frames = sequences.tokens_BTL
    logits = model.observation_logits(model(frames, jnp.pad(sequences.action_BT, ((0, 0), (0, 1)))))
    behind = jnp.concatenate([frames[:, 1:], frames[:, :1]], axis=1)
    loss = nats(logits, model.factorization.targets(frames, behind))
    weight = np.ones((4, 6, 6))
    weight[0, 1, 5] = weight[0, 2:] = weight[:, 5, 5] = 0
    np.testing.assert_allclose(metrics["observation_loss"], (loss * weight).sum() / weight.sum(), rtol=1e-5)
