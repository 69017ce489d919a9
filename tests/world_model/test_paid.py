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
from suite.world_model.history import History, next_paid, paid_before
from suite.world_model.imagination import Dream
from suite.world_model.sequences import Sequences
from suite.world_model.transformer import WorldModel
from tests.world_model.small import GRID, SPEC, random_sequences, small_config, small_model

LIMIT, ACTIONS = 3, SPEC.num_actions


def test_counts_by_action_begin_anew_with_each_episode():
    action_TB = jnp.array([[0], [1], [1], [2], [1]])
    pays_TB = jnp.array([[True], [True], [False], [True], [True]])
    first_TB = jnp.array([[False], [False], [False], [True], [False]])
    paid_TBA, after_BA = paid_before(jnp.array([[4, 0, 255]], jnp.uint8), action_TB, pays_TB, first_TB)
    assert paid_TBA[:, 0].tolist() == [[4, 0, 255], [5, 0, 255], [5, 1, 255], [0, 0, 0], [0, 0, 1]]
    assert after_BA.tolist() == [[0, 1, 1]] and paid_TBA.dtype == jnp.uint8
    assert next_paid(jnp.array([[4, 0, 255]], jnp.uint8), jnp.array([2]), jnp.array([True])).tolist() == [[4, 0, 255]]


def test_step_by_step_as_whole_sequences():
    graph, params = nnx.split(small_model(std=0.3, layers=1, paid=LIMIT))
    sequences = random_sequences()
    tokens_BTL, action_BT = sequences.tokens_BTL[:, :-1], sequences.action_BT

    @jax.jit
    def whole(paid_BTA):
        return nnx.merge(graph, params)(tokens_BTL, action_BT, history_BT=History(paid=paid_BTA))

    @jax.jit
    def in_parts(paid_BTA):
        model = nnx.merge(graph, params)
        cache = model.init_cache(3, 5)
        cache = model.remember(cache, tokens_BTL[:, :4], action_BT[:, :4], History(paid=paid_BTA[:, :4]))
        return model.step(cache, tokens_BTL[:, 4], action_BT[:, 4], History(paid=paid_BTA[:, 4]))[1]

    paid_BTA = jax.random.randint(jax.random.key(1), (3, 5, ACTIONS), 0, 6).astype(jnp.uint8)
    expected = whole(paid_BTA)
    np.testing.assert_array_equal(expected, whole(jnp.minimum(paid_BTA, LIMIT)))  # more than the limit is the limit
    assert jnp.abs(expected - whole(0 * paid_BTA)).max() > 0.1
    np.testing.assert_allclose(in_parts(paid_BTA), expected[:, 4], atol=2e-5)


@pytest.mark.parametrize(
    ("rewards", "ends", "paid"),
    [(1, False, [[6, 0, 0], [0, 3, 0]]), (0, False, [[5, 0, 0], [0, 2, 0]]), (1, True, [[0] * 3] * 2)],
)
def test_dreams_count(rewards, ends, paid):
    model = small_model(paid=LIMIT)
    model.reward_head.bias[...] = jnp.array([0.0, 1e4]) if rewards else jnp.array([1e4, 0.0])
    model.termination_head.bias[...] = jnp.array([0.0, 1e4]) if ends else jnp.array([1e4, 0.0])
    observation = ObservationSpec((6,), 7, "symbols")
    tokenizer = SymbolTokenizer(observation)
    dream = Dream(
        model,
        tokenizer,
        tokenizer.init(jax.random.key(0)),
        EnvironmentSpec("x", observation, 3, (0.0, 1.0)),
        SPEC,
        2,
        jnp.zeros((2, 6), jnp.uint8),
        start_paid_BA=jnp.array([[5, 0, 0], [0, 2, 0]], jnp.uint8),
    )
    state, _ = dream.reset(jax.random.key(0))
    state, shown = dream.step(jax.random.key(1), state, jnp.array([0, 1]))
    assert shown.reward.tolist() == [rewards] * 2
    assert state.history_B.paid.tolist() == paid


def test_learning_what_pays_once():
    """Actions 1 and 2 pay, but once an episode each. Frames do not tell whether they have."""
    config = small_config(layers=1, paid=LIMIT, learning_rate=1e-2, initial_std=0.1)
    graph, params = nnx.split(WorldModel(config, SPEC, GRID, nnx.Rngs(0)))
    optimizer = training.make_optimizer(config)

    def update(state, key):
        action_key, paid_key = jax.random.split(key)
        action_BT = jax.random.randint(action_key, (32, 1), 0, ACTIONS)
        paid_BTA = jax.random.randint(paid_key, (32, 1, ACTIONS), 0, 2).astype(jnp.uint8).at[..., 0].set(0)
        again_BT = jnp.take_along_axis(paid_BTA, action_BT[..., None], axis=-1)[..., 0]
        reward_BT = ((action_BT > 0) & (again_BT == 0)).astype(jnp.float32)
        tokens_BTL, no_BT = jnp.zeros((32, 2, 6), jnp.int32), jnp.zeros((32, 1), bool)
        batch = Sequences(tokens_BTL, action_BT, reward_BT, no_BT, history_BT=History(paid=paid_BTA))
        return training.update(config, optimizer, graph, SPEC, state, batch, key)

    state = training.WorldModelTrainState(params, optimizer.init(params))
    _, metrics = jax.jit(lambda *x: jax.lax.scan(update, *x))(state, jax.random.split(jax.random.key(0), 80))
    assert metrics["reward_loss"][-10:].mean() < 0.05  # a model that is not told: two thirds of ln 2


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


def test_more_rewards_than_there_are_measure_no_trust():
    with pytest.raises(UserError, match=r"event_share=0\.3 replays more rewards than there are"):
        registry.resolve("craftax_classic", "m5", "small", ["world_model.event_share=0.3", "imagination.trust=0.5"])
