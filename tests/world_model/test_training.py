from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import nnx

from suite.world_model.heads import Head
from suite.world_model.imagination import next_frame
from suite.world_model.training import (
    METRICS,
    WorldModelTrainState,
    cross_entropy,
    losses,
    make_optimizer,
    update,
    with_wrong_tokens,
)
from suite.world_model.transformer import WorldModel
from tests.world_model.small import GRID, SPEC, random_sequences, small_config, small_model

SEQUENCES = random_sequences()


def reference(model, sequences, step_weight, token_weight, reward_weight: float) -> dict[str, float]:
    """The losses in NumPy float64, from the model's logits."""
    tokens = np.asarray(sequences.tokens_BTL)
    hidden = model(sequences.tokens_BTL[:, :-1], sequences.action_BT)

    def nats(logits, target):
        logits = np.asarray(logits, np.float64)
        return np.log(np.exp(logits).sum(-1)) - np.take_along_axis(logits, target[..., None], -1)[..., 0]

    def mean(value, weight):
        return (value * weight).sum() / weight.sum()

    logits = model.observation_logits(hidden)
    token_weight = np.broadcast_to(token_weight[..., None], tokens[:, 1:].shape)
    correct = np.asarray(logits).argmax(-1) == tokens[:, 1:]
    reward = (np.asarray(sequences.reward_BT) >= 0.5).astype(int)
    result = {
        "observation_loss": mean(nats(logits, tokens[:, 1:]), token_weight),
        "reward_loss": mean(nats(model.reward_logits(hidden), reward), step_weight),
        "termination_loss": mean(
            nats(model.termination_logits(hidden), np.asarray(sequences.terminated_BT, int)), step_weight
        ),
        "token_accuracy": mean(correct, token_weight),
        "changed_token_accuracy": mean(correct, token_weight * (tokens[:, 1:] != tokens[:, :-1])),
        "reward_accuracy": mean(np.asarray(model.reward_logits(hidden)).argmax(-1) == reward, step_weight),
    }
    other = result["reward_loss"] + result["termination_loss"]
    return result | {"loss": result["observation_loss"] + reward_weight * other}


@pytest.mark.parametrize("reward_weight", [1.0, 10.0])
def test_losses_against_numpy(reward_weight):
    model, config = small_model(std=0.2), small_config(reward_weight=reward_weight)
    value, metrics = losses(model, SEQUENCES, config, SPEC)
    ones = np.ones(SEQUENCES.reward_BT.shape)
    expected = reference(model, SEQUENCES, ones, ones, reward_weight)
    for name, number in (metrics | {"loss": value}).items():
        np.testing.assert_allclose(number, expected[name], rtol=1e-5, err_msg=name)


@pytest.mark.parametrize("truncated", [False, True])
def test_mask_after_done(truncated):
    """Sequence 0 ends at its step 1: the step counts, the frame it leads to and all that follows do not."""
    ended = jnp.zeros((3, 5), bool).at[0, 1].set(True)
    sequences = SEQUENCES.replace(
        terminated_BT=jnp.zeros_like(ended) if truncated else ended, ended_BT=ended if truncated else None
    )
    step_weight, token_weight = np.ones((3, 5)), np.ones((3, 5))
    step_weight[0, 2:] = token_weight[0, 1:] = 0
    model, config = small_model(std=0.2), small_config(mask_after_done=True)
    value, metrics = losses(model, sequences, config, SPEC)
    expected = reference(model, sequences, step_weight, token_weight, 1.0)
    for name, number in (metrics | {"loss": value}).items():
        np.testing.assert_allclose(number, expected[name], rtol=1e-5, err_msg=name)
    unmasked, _ = losses(model, sequences, small_config(), SPEC)
    assert not np.allclose(unmasked, value)


def test_wrong_tokens_are_of_the_same_place_in_another_sequence():
    """Sequence b reads 1000 b + 10 t + l at step t and place l."""
    place_BTL = jnp.asarray(1000 * np.arange(8)[:, None, None] + 10 * np.arange(5)[:, None] + np.arange(4))
    noisy_BTL = np.asarray(with_wrong_tokens(place_BTL, 0.25, jax.random.key(0)))
    np.testing.assert_array_equal(noisy_BTL % 1000, place_BTL % 1000)
    assert 0.1 < (noisy_BTL != place_BTL).mean() < 0.3  # some sequences stay their own neighbours
    assert (with_wrong_tokens(place_BTL, 0.0, jax.random.key(0)) == place_BTL).all()


def test_wrong_tokens_are_read_in_training_alone_and_never_predicted():
    model, config = small_model(std=0.2, dropout=0.0), small_config(token_noise=0.9)
    value, _ = losses(model, SEQUENCES, small_config(), SPEC)
    assert losses(model, SEQUENCES, config, SPEC)[0] == value
    key = jax.random.key(5)
    noisy, _ = losses(model, SEQUENCES, config, SPEC, key)
    read_BTL = with_wrong_tokens(SEQUENCES.tokens_BTL[:, :-1], 0.9, jax.random.fold_in(key, 1))
    assert (read_BTL != SEQUENCES.tokens_BTL[:, :-1]).any()
    logits = model.observation_logits(model(read_BTL, SEQUENCES.action_BT))
    expected, _ = cross_entropy(logits, SEQUENCES.tokens_BTL[:, 1:])
    found = losses(model, SEQUENCES, config, SPEC, key)[1]["observation_loss"]
    np.testing.assert_allclose(found, expected.mean(), rtol=1e-5)
    assert noisy != value


def test_chunked_logits_change_neither_losses_nor_gradients(monkeypatch):
    config, sequences = small_config(), random_sequences(batch=6)
    graph, params = nnx.split(small_model(std=0.2))

    def loss_and_gradient():
        return jax.value_and_grad(lambda p: losses(nnx.merge(graph, p), sequences, config, SPEC)[0])(params)

    value, gradient = loss_and_gradient()
    monkeypatch.setattr("suite.world_model.training.CHUNK_LOGITS", 2 * 5 * 6 * 8)  # two of six sequences at once
    chunked_value, chunked_gradient = loss_and_gradient()
    np.testing.assert_allclose(chunked_value, value, rtol=1e-6)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), chunked_gradient, gradient)


def test_cross_entropy_is_uniform_for_equal_logits():
    loss, _ = cross_entropy(jnp.zeros((2, 8)), jnp.asarray([0, 7]))
    np.testing.assert_allclose(loss, np.log(8), rtol=1e-6)


def test_an_update_is_clipped_adam_and_returns_the_named_metrics():
    config = small_config(max_grad_norm=1e-3, dropout=0.0, average=0.75)
    graph, params = nnx.split(small_model(std=0.2, dropout=0.0))
    optimizer = make_optimizer(config)
    model_state = WorldModelTrainState.create(config, optimizer, params)
    step = jax.jit(functools.partial(update, config, optimizer, graph, SPEC))
    after, metrics = step(model_state, SEQUENCES, jax.random.key(0))
    assert set(metrics) == set(METRICS) and len(METRICS) == len(set(METRICS))
    assert all(value.shape == () for value in metrics.values())

    gradient = jax.grad(lambda p: losses(nnx.merge(graph, p), SEQUENCES, config, SPEC)[0])(params)
    norm = optax.tree.norm(gradient)
    np.testing.assert_allclose(metrics["gradient_norm"], norm, rtol=1e-4)

    def expected(old, slope):  # Adam's first step: its moments are the clipped gradient and its square
        clipped = slope * (1e-3 / norm)
        return old - config.learning_rate * clipped / (jnp.abs(clipped) + config.adam_eps)

    jax.tree.map(
        lambda new, old, slope: np.testing.assert_allclose(new, expected(old, slope), atol=2e-6),
        after.params,
        params,
        gradient,
    )
    mean = jax.tree.map(lambda old, new: 0.75 * old + 0.25 * new, params, after.params)
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-6, atol=1e-7), after.dreaming, mean)


def test_without_an_average_dreams_use_the_newest_parameters():
    _, params = nnx.split(small_model())
    model_state = WorldModelTrainState.create(small_config(), make_optimizer(small_config()), params)
    assert model_state.averaged is None and model_state.dreaming is model_state.params


def test_rewards_and_ends_are_read_off_every_place():
    """Beside what the action's token says: log-mean-exp over the frame's tokens, of one network for all of them."""
    changes = {"place_heads": True, "dropout": 0.0}
    model = small_model(std=0.2, **changes)
    hidden = model(SEQUENCES.tokens_BTL[:, :-1], SEQUENCES.action_BT)
    pairs = (
        (model.reward_logits, model.reward_head, model.reward_places),
        (model.termination_logits, model.termination_head, model.termination_places),
    )
    for logits, head, places in pairs:
        each = np.stack([Head.__call__(places, hidden[..., place, :]) for place in range(model.block - 1)], axis=-2)
        expected = head(hidden[..., -1, :]) + np.log(np.exp(np.asarray(each, np.float64)).mean(-2))
        np.testing.assert_allclose(logits(hidden), expected, rtol=1e-4, atol=1e-5)
        moved = hidden[..., np.array([2, 0, 1, 5, 4, 3, 6]), :]
        np.testing.assert_allclose(logits(moved), logits(hidden), rtol=1e-5, atol=1e-6)  # wherever it happens


def test_rewards_and_ends_of_symbols_are_read_off_all_of_them():
    """Beside what the action's token says: one network of all the frame's symbols, whose order matters."""
    config = small_config(place_heads=True, dropout=0.0, initial_std=0.2)
    model = WorldModel(config, dataclasses.replace(SPEC, spatial=False), None, nnx.Rngs(0))
    hidden = model(SEQUENCES.tokens_BTL[:, :-1], SEQUENCES.action_BT)
    pairs = (
        (model.reward_logits, model.reward_head, model.reward_places),
        (model.termination_logits, model.termination_head, model.termination_places),
    )
    for logits, head, symbols in pairs:
        narrow = [symbols.narrow(hidden[..., place, :]) for place in range(model.block - 1)]
        assert {each.shape[-1] for each in narrow} == {config.embed_dim // 4}
        expected = head(hidden[..., -1, :]) + Head.__call__(symbols, np.concatenate(narrow, axis=-1))
        np.testing.assert_allclose(logits(hidden), expected, rtol=1e-4, atol=1e-5)
        moved = hidden[..., np.array([2, 0, 1, 5, 4, 3, 6]), :]
        assert np.abs(np.asarray(logits(moved) - logits(hidden))).max() > 1e-3
    without = WorldModel(small_config(), dataclasses.replace(SPEC, spatial=False), None, nnx.Rngs(0))
    assert without.reward_places is None and without.termination_places is None


def test_dropout_follows_the_key():
    config = small_config(dropout=0.3)
    model = small_model(std=0.2, dropout=0.3)
    values = [losses(model, SEQUENCES, config, SPEC, key)[0] for key in (None, jax.random.key(0), jax.random.key(1))]
    assert len({float(value) for value in values}) == 3


def test_vectors_are_regressed():
    """Tokens of three numbers: the loss is the squared distance, and sampling is the prediction."""
    spec = dataclasses.replace(SPEC, num_codes=0, token_size=3)
    config = small_config()
    model = WorldModel(config, spec, GRID, nnx.Rngs(0))
    vectors = jax.random.uniform(jax.random.key(0), (*SEQUENCES.tokens_BTL.shape, 3))
    vectors = vectors.at[:, 1].set(vectors[:, 0])
    sequences = SEQUENCES.replace(tokens_BTL=vectors)
    _, metrics = losses(model, sequences, config, spec)
    predicted = model.observation_logits(model(vectors[:, :-1], sequences.action_BT))
    distance = np.square(np.asarray(predicted - vectors[:, 1:])).sum(-1)
    np.testing.assert_allclose(metrics["observation_loss"], distance.mean(), rtol=1e-5)
    np.testing.assert_allclose(metrics["token_accuracy"], (distance <= 0.75).mean(), rtol=1e-5)
    np.testing.assert_allclose(metrics["changed_token_accuracy"], (distance[:, 1:] <= 0.75).mean(), rtol=1e-5)

    cache = model.init_cache(3, 5)
    _, hidden, frame = next_frame(
        jax.random.key(1), model, cache, vectors[:, 0], sequences.action_BT[:, 0], jnp.ones(0, bool)
    )
    np.testing.assert_array_equal(frame, jnp.clip(model.observation_logits(hidden), 0, 1))
    assert frame.shape == (3, 6, 3)
