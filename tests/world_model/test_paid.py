"""What a model is told of the rewards that an episode has paid, and sequences whose rewards teach less or more."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from suite import registry
from suite.interface.environment import EnvironmentSpec, ObservationSpec
from suite.runtime.errors import UserError
from suite.tokenizers.symbols import SymbolTokenizer
from suite.world_model import training
from suite.world_model.imagination import Dream
from suite.world_model.transformer import WorldModel
from tests.world_model.small import GRID, SPEC, random_sequences, small_config, small_model

LIMIT = 3


def test_step_by_step_as_whole_sequences():
    graph, params = nnx.split(small_model(std=0.3, layers=1, paid=LIMIT))
    sequences = random_sequences()
    tokens_BTL, action_BT = sequences.tokens_BTL[:, :-1], sequences.action_BT

    @jax.jit
    def whole(paid_BT):
        return nnx.merge(graph, params)(tokens_BTL, action_BT, paid_BT=paid_BT)

    @jax.jit
    def in_parts(paid_BT):
        model = nnx.merge(graph, params)
        cache = model.remember(model.init_cache(3, 5), tokens_BTL[:, :4], action_BT[:, :4], None, paid_BT[:, :4])
        return model.step(cache, tokens_BTL[:, 4], action_BT[:, 4], None, paid_BT[:, 4])[1]

    paid_BT = jnp.array([[0, 1, 1, 2, 9], [3, 4, 0, 0, 1], [0, 0, 0, 0, 0]])
    expected = whole(paid_BT)
    np.testing.assert_array_equal(expected, whole(jnp.minimum(paid_BT, LIMIT)))  # more than the limit is the limit
    assert jnp.abs(expected - whole(0 * paid_BT))[:2].max() > 0.1
    np.testing.assert_allclose(in_parts(paid_BT), expected[:, 4], atol=2e-5)


@pytest.mark.parametrize(("rewards", "ends", "paid"), [(1, False, [6, 3]), (0, False, [5, 2]), (1, True, [0, 0])])
def test_dreams_count(rewards, ends, paid):
    model = small_model(paid=LIMIT)
    model.reward_head.bias[...] = jnp.array([0.0, 1e4]) if rewards else jnp.array([1e4, 0.0])
    model.termination_head.bias[...] = jnp.array([0.0, 1e4]) if ends else jnp.array([1e4, 0.0])
    observation = ObservationSpec((6,), 7, "symbols")
    tokenizer = SymbolTokenizer(observation)
    spec = EnvironmentSpec("x", observation, 3, (0.0, 1.0))
    start_BO = jnp.zeros((2, 6), jnp.uint8)
    dream = Dream(
        model, tokenizer, tokenizer.init(jax.random.key(0)), spec, SPEC, 2, start_BO, start_paid_B=jnp.array([5, 2])
    )
    state, _ = dream.reset(jax.random.key(0))
    state, shown = dream.step(jax.random.key(1), state, jnp.array([0, 1]))
    assert shown.reward.tolist() == [rewards] * 2
    assert state.paid_B.tolist() == paid


def test_learning_what_pays_once():
    """Action 1 pays, but once an episode. Frames do not tell whether it has."""
    config = small_config(layers=1, paid=LIMIT, learning_rate=1e-2, initial_std=0.1)
    graph, params = nnx.split(WorldModel(config, SPEC, GRID, nnx.Rngs(0)))
    optimizer = training.make_optimizer(config)

    def update(learner, key):
        action_BT, paid_BT = jax.random.randint(key, (2, 32, 1), 0, 2)
        reward_BT = (action_BT * (1 - paid_BT)).astype(jnp.float32)
        tokens_BTL = jnp.zeros((32, 2, 6), jnp.int32)
        batch = training.Sequences(tokens_BTL, action_BT, reward_BT, jnp.zeros((32, 1), bool), paid_BT=paid_BT)
        return training.update(config, optimizer, graph, SPEC, learner, batch, key)

    learner = training.WorldModelLearner(params, optimizer.init(params))
    _, metrics = jax.jit(lambda *x: jax.lax.scan(update, *x))(learner, jax.random.split(jax.random.key(0), 60))
    assert metrics["reward_loss"][-10:].mean() < 0.05  # a model that is not told: half of ln 2


def test_rewards_and_ends_are_weighed():
    model, config, sequences = small_model(std=0.3, layers=1), small_config(layers=1), random_sequences()
    losses = jax.jit(lambda some: training.losses(model, some, config, SPEC)[1])
    alone = jax.vmap(lambda one: losses(jax.tree.map(lambda x: x[None], one)))(sequences)
    weight_B = jnp.array([0.5, 2.0, 0.0])
    weighed = losses(dataclasses.replace(sequences, weight_B=weight_B))
    for name in ("reward_loss", "termination_loss", "reward_accuracy"):
        np.testing.assert_allclose(weighed[name], (alone[name] * weight_B).mean(), rtol=1e-5)
    for name in ("observation_loss", "token_accuracy"):
        np.testing.assert_allclose(weighed[name], alone[name].mean(), rtol=1e-5)


@pytest.mark.parametrize("other", ["world_model.block_teacher_forcing=false", "tokenizer.kind=continuous"])
def test_what_it_needs(other):
    with pytest.raises(UserError, match=r"world_model.paid=2 needs world_model.block_teacher_forcing=true"):
        registry.resolve("craftax_classic", "m5", "paper", [other, "world_model.paid=2"])
