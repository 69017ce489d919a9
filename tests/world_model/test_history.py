"""What a model is told of how long every token has been where it is, and Muon, by which it learns."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from suite import registry
from suite.runtime.errors import UserError
from suite.world_model import training
from suite.world_model.history import History, ages_of, next_ages
from suite.world_model.sequences import Sequences
from suite.world_model.transformer import WorldModel
from tests.world_model.small import GRID, SPEC, small_config, small_model

LIMIT, PERIOD = 6, 4
FRAMES = np.array([[1, 1], [1, 2], [1, 2], [1, 3], [0, 3], [0, 3]], np.int32)[None]  # [B, T, L] of one sequence


def test_ages():
    assert ages_of(jnp.asarray(FRAMES), 2)[0].tolist() == [[0, 0], [1, 0], [2, 1], [2, 0], [0, 1], [1, 2]]


def test_ages_frame_by_frame():
    tokens_BTL = jax.random.randint(jax.random.key(0), (3, 9, 5), 0, 2)
    whole_BTL = ages_of(tokens_BTL, LIMIT)
    age_BL = whole_BTL[:, 0]
    for t in range(1, 9):
        age_BL = next_ages(age_BL, tokens_BTL[:, t - 1], tokens_BTL[:, t], LIMIT)
        np.testing.assert_array_equal(age_BL, whole_BTL[:, t])


def test_learning_a_timer_by_muon():
    """All places blink together, every fourth step. One frame does not tell when; its ages do."""
    config = small_config(layers=1, ages=LIMIT, optimizer="muon", learning_rate=3e-3, initial_std=0.1)
    graph, params = nnx.split(WorldModel(config, SPEC, GRID, nnx.Rngs(0)))
    optimizer = training.make_optimizer(config)

    def batch(key):
        place_key, time_key = jax.random.split(key)
        first_BL = jax.random.randint(place_key, (16, SPEC.tokens_per_frame), 0, 2)
        time_BT = jax.random.randint(time_key, (16, 1), 0, 2 * PERIOD) + jnp.arange(LIMIT + 2)[None]
        tokens_BTL = (first_BL[:, None] + time_BT[..., None] // PERIOD) % 2
        none = jnp.zeros((16, 1))
        age_BTL = ages_of(tokens_BTL, LIMIT)[:, LIMIT:-1]
        return Sequences(
            tokens_BTL[:, LIMIT:], none.astype(jnp.int32), none, none.astype(bool), history_BT=History(age_BTL)
        )

    def update(model_state, key):
        return training.update(config, optimizer, graph, SPEC, model_state, batch(key), key)

    model_state = training.WorldModelTrainState(params, optimizer.init(params))
    _, metrics = jax.jit(lambda *x: jax.lax.scan(update, *x))(model_state, jax.random.split(jax.random.key(0), 200))
    assert metrics["token_accuracy"][-20:].mean() > 0.99  # a model of single frames gets 0.75
    assert metrics["changed_token_accuracy"][-20:].mean() > 0.99


def test_muon_makes_steps_of_hidden_matrices_orthogonal():
    """A step is as large in every direction, and of the size of Adam's. What is no hidden matrix is left to Adam."""
    _, params = nnx.split(small_model())
    leaves, tree = jax.tree.flatten(params)
    keys = jax.random.split(jax.random.key(0), len(leaves))
    narrow = [  # the last axis' directions differ in size by a factor of ten
        0.01 * jax.random.normal(key, x.shape) * jnp.logspace(0, -1, x.shape[-1]).reshape((1,) * (x.ndim - 1) + (-1,))
        for key, x in zip(keys, leaves, strict=True)
    ]
    steps = {}
    for name in ("adam", "muon"):
        optimizer = training.make_optimizer(small_config(optimizer=name, learning_rate=0.01))
        with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
            step, _ = optimizer.update(jax.tree.unflatten(tree, narrow), optimizer.init(params), params)
        steps[name] = dict(nnx.to_flat_state(step))
    adam, muon = steps["adam"], steps["muon"]
    for layer in range(2):
        values = np.linalg.svd(muon["layers", "contract", "kernel"][...][layer], compute_uv=False)
        assert values.max() < 2 * values.min()
        assert 0.5 < values.mean() / (0.01 * 0.2 * np.sqrt(128)) < 1.2  # `consistent_rms`; 128 is the longer side
    logits, embedding = ("observation_head", "kernel"), ("token_embedding", "embedding")
    for path in (logits, embedding, ("layers", "mlp_norm", "scale")):
        ratio = muon[path][...] / adam[path][...]
        np.testing.assert_allclose(ratio, ratio.mean(), rtol=1e-3)  # above 1: Optax's has Nesterov's momentum there


def test_symbols_have_no_ages():
    config = small_config(ages=LIMIT)
    model = WorldModel(config, dataclasses.replace(SPEC, spatial=False), GRID, nnx.Rngs(0))
    assert model.ages == 0 and model.age_embedding is None


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["world_model.block_teacher_forcing=false", "world_model.ages=2"], "world_model.ages=2 needs world_model.bl"),
        (["tokenizer.kind=continuous", "world_model.ages=2"], "world_model.ages=2 needs .* tokens are codes"),
        (["world_model.ages=76"], r"rollout_length=96 must exceed world_model.sequence_length=20 \+ world_model.ages"),
    ],
)
def test_what_ages_need(overrides, message):
    with pytest.raises(UserError, match=message):
        registry.resolve("craftax_classic", "m5", "paper", overrides)
