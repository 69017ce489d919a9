"""A model that sees what its codes stand for, and so knows of one code what it has learned of others like it."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from suite import registry
from suite.interface.environment import ObservationSpec
from suite.runtime.errors import UserError
from suite.tokenizers.nearest_neighbor import NearestNeighborTokenizer
from suite.world_model import training
from suite.world_model.block_teacher_forcing import sample_one_by_one
from suite.world_model.transformer import WorldModel
from tests.world_model.small import GRID, SPEC, random_sequences, small_config

SEEN = dataclasses.replace(SPEC, content_size=4)
# Codes 6 and 7 look alike, the others do not.
CONTENTS = jnp.asarray(np.random.default_rng(0).random((8, 4)), jnp.float32).at[7].set(0.5).at[6].set(0.5)
SEQUENCES = random_sequences(0)


def model_of(spec=SEEN, **changes):
    return WorldModel(small_config(patch_contents=True, local_embedding=3, **changes), spec, GRID, nnx.Rngs(0))


def seeing(model, std=0.0):
    """The same model whose readings of contents are drawn with that deviation."""
    model.contents[...] = CONTENTS
    for index, reading in enumerate((model.content_embedding, model.content_local, model.content_logits)):
        reading[...] = std * jax.random.normal(jax.random.key(index), reading.shape)
    return model


def logits(model):
    hidden = model(SEQUENCES.tokens_BTL[:, :-1], SEQUENCES.action_BT)
    return model.observation_logits(hidden)


def test_nothing_is_made_of_contents_before_training():
    plain = WorldModel(small_config(local_embedding=3), SPEC, GRID, nnx.Rngs(0))
    np.testing.assert_array_equal(logits(seeing(model_of())), logits(plain))
    assert plain.contents is None


def test_embeddings_and_logits_are_a_codes_own_and_what_is_read_off_its_contents():
    """Equal to a model without contents, whose tables hold the sums; token by token as well."""
    for together in (True, False):
        sums_are_the_same(block_teacher_forcing=together)


def sums_are_the_same(**changes):
    model = seeing(model_of(**changes), std=0.5)
    plain = WorldModel(small_config(local_embedding=3, **changes), SPEC, GRID, nnx.Rngs(0))
    assert not np.allclose(logits(model), logits(plain), atol=1e-2)
    for table, reading in (
        (plain.token_embedding.embedding, model.content_embedding),
        (plain.local_embedding.embedding, model.content_local),
    ):
        table[...] = table[...] + CONTENTS @ reading[...]
    plain.observation_head.kernel[...] = plain.observation_head.kernel[...] + (CONTENTS @ model.content_logits[...]).T
    np.testing.assert_allclose(logits(model), logits(plain), rtol=1e-5, atol=1e-5)
    if not changes["block_teacher_forcing"]:
        found, expected = (
            sample_one_by_one(jax.random.key(0), each, *appended(each), jnp.ones(SPEC.num_codes, bool))
            for each in (model, plain)
        )
        np.testing.assert_array_equal(found[0], expected[0])
        np.testing.assert_allclose(found[1], expected[1], rtol=1e-4, atol=1e-5)


def appended(model):
    """A cache that holds one frame and its action, and the hidden state of the action."""
    cache, hidden_BSD = model.step(model.init_cache(3, 1), SEQUENCES.tokens_BTL[:, 0], SEQUENCES.action_BT[:, 0])
    return cache, hidden_BSD[:, -1]


def test_codes_alike_are_alike_where_nothing_else_was_learned():
    """Codes 6 and 7 have the same contents: with tables of zeros, the model cannot tell them apart."""
    model = seeing(model_of(), std=0.5)
    for own in (model.token_embedding.embedding, model.local_embedding.embedding, model.observation_head.kernel):
        own[...] = jnp.zeros_like(own[...])
    predicted = logits(model)
    np.testing.assert_allclose(predicted[..., 6], predicted[..., 7], rtol=1e-6, atol=1e-6)
    assert np.abs(np.asarray(predicted[..., 5] - predicted[..., 7])).min() > 1e-4
    tokens_BTL = SEQUENCES.tokens_BTL[:, :-1]
    swapped = model(jnp.where(tokens_BTL == 6, 7, tokens_BTL), SEQUENCES.action_BT)
    np.testing.assert_allclose(swapped, model(tokens_BTL, SEQUENCES.action_BT), rtol=1e-6, atol=1e-6)


def test_training_learns_to_read_contents_and_leaves_them_as_they_are():
    config = small_config(patch_contents=True, local_embedding=3, average=0.5, learning_rate=1e-2)
    graph, params = nnx.split(model_of())
    optimizer = training.make_optimizer(config)
    model_state = training.WorldModelTrainState.create(config, optimizer, params).with_contents(CONTENTS)
    update = jax.jit(
        lambda model_state: training.update(config, optimizer, graph, SEEN, model_state, SEQUENCES, jax.random.key(0))
    )
    model_state, metrics = update(model_state)
    assert np.isfinite(metrics["loss"])
    for found in (model_state.params, model_state.dreaming):
        model = nnx.merge(graph, found)
        np.testing.assert_array_equal(model.contents[...], CONTENTS)
        for reading in (model.content_embedding, model.content_local, model.content_logits):
            assert np.abs(np.asarray(reading[...])).max() > 1e-3


def test_contents_of_a_codebook():
    """The patches themselves, from 0 to 1; of codes that are not filled nothing."""
    tokenizer = NearestNeighborTokenizer(4, 0.1, (1, 2), ObservationSpec((1, 4, 1), high=5, kind="grid", patch=(1, 2)))
    state, _ = tokenizer.update(
        tokenizer.init(jax.random.key(0)), jnp.array([0, 5, 3, 0], jnp.uint8).reshape(1, 1, 4, 1)
    )
    np.testing.assert_allclose(tokenizer.contents(state), [[0, 1], [0.6, 0], [0, 0], [0, 0]], rtol=1e-6)


def test_what_has_no_contents():
    symbols = WorldModel(small_config(patch_contents=True), dataclasses.replace(SPEC, spatial=False), GRID, nnx.Rngs(0))
    assert symbols.contents is None
    with pytest.raises(UserError, match="codes that are patches"):
        registry.resolve("minatar/breakout", "m2", "smoke", overrides=["world_model.patch_contents=true"])
