from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from suite.configuration.schema import WorldModelConfig
from suite.interface.tokens import TokenSpec
from suite.world_model.transformer import WorldModel
from tests.world_model.small import random_sequences, small_model

SEQUENCES = random_sequences()
TOKENS, ACTION = SEQUENCES.tokens_BTL[:, :-1], SEQUENCES.action_BT


def count(tree) -> int:
    return sum(x.size for x in jax.tree.leaves(tree))


@pytest.mark.parametrize(("codes", "total"), [(4096, 1_699_972), (512, 778_884)])
def test_parameter_counts(codes, total):
    spec = TokenSpec(81, codes, 17, (0.0, 1.0))
    model = nnx.eval_shape(lambda: WorldModel(WorldModelConfig(), spec, (9, 9), nnx.Rngs(0)))
    assert count(nnx.state(model)) == total
    assert count(nnx.state(model.layers)) == 3 * 198_272


@pytest.mark.parametrize("positions", ["flat", "grid"])
def test_block_causality_by_gradients(positions):
    """A prediction depends on every token and the action of its own frame and of earlier ones; on nothing later."""
    model = small_model(std=0.2, positions=positions)
    embedding_BTSD = model.embed(TOKENS, ACTION, None)
    time = 2

    def prediction(embedding, readout):
        seen = small_model(std=0.2, positions=positions)
        seen.embed = lambda tokens, action, age: embedding
        return readout(seen, seen(TOKENS, ACTION))

    readouts = [
        lambda model, hidden: model.observation_logits(hidden)[0, time, 4, 1],
        lambda model, hidden: model.reward_logits(hidden)[0, time, 1],
        lambda model, hidden: model.termination_logits(hidden)[0, time, 1],
    ]
    for readout in readouts:
        slope_BTS = jnp.abs(jax.grad(prediction)(embedding_BTSD, readout)).max(-1)
        assert (slope_BTS[0, : time + 1] > 0).all()
        assert (slope_BTS[0, time + 1 :] == 0).all()
        assert (slope_BTS[1:] == 0).all()


def test_causality_without_block_teacher_forcing():
    """The output at a token sees that token and those before it; logits are read where fidelity note 19 says."""
    model = small_model(std=0.2, block_teacher_forcing=False)
    embedding_BTSD = model.embed(TOKENS, ACTION, None)

    def prediction(embedding, readout):
        seen = small_model(std=0.2, block_teacher_forcing=False)
        seen.embed = lambda tokens, action, age: embedding
        return readout(seen, seen(TOKENS, ACTION))

    def seen_by(readout):
        return np.asarray(jnp.abs(jax.grad(prediction)(embedding_BTSD, readout)).max(-1) > 0)

    reads = {  # (time, which of the L predictions): the last token it may see
        (2, 0): 2 * 7,  # q_2^2, from the first token of frame 2
        (2, 4): 2 * 7 + 4,  # q_2^6
        (2, 5): 2 * 7 + 6,  # q_3^1, from the action: the last token of the frame predicts nothing
    }
    for (time, token), last in reads.items():
        slope_BTS = seen_by(lambda model, hidden: model.observation_logits(hidden)[0, time, token, 1])  # noqa: B023
        assert not slope_BTS[1:].any()
        np.testing.assert_array_equal(slope_BTS[0].ravel(), np.arange(5 * 7) <= last)
    np.testing.assert_array_equal(
        seen_by(lambda model, hidden: model.reward_logits(hidden)[0, time, 1])[0].ravel(), np.arange(5 * 7) < 3 * 7
    )
    targets = model.factorization.targets(TOKENS[:, :-1], TOKENS[:, 1:])
    np.testing.assert_array_equal(targets[:, :, :5], TOKENS[:, :-1, 1:])
    np.testing.assert_array_equal(targets[:, :, 5], TOKENS[:, 1:, 0])


@pytest.mark.parametrize("blocks", [True, False])
@pytest.mark.parametrize("positions", ["flat", "grid"])
@pytest.mark.parametrize("compute_type", ["float32", "bfloat16"])
def test_cached_logits_equal_uncached_ones(positions, compute_type, blocks):
    model = small_model(std=0.2, positions=positions, compute_type=compute_type, block_teacher_forcing=blocks)
    tolerance = 1e-5 if compute_type == "float32" else 5e-2
    hidden_BTSD = model(TOKENS, ACTION)
    cache, step = model.init_cache(3, 5), jax.jit(model.step)
    assert cache.keys.dtype == jnp.dtype(compute_type)
    for time in range(5):
        cache, hidden_BSD = step(cache, TOKENS[:, time], ACTION[:, time])
        for logits in (model.observation_logits, model.reward_logits, model.termination_logits):
            expected = logits(hidden_BTSD)[:, time]
            np.testing.assert_allclose(logits(hidden_BSD), expected, atol=tolerance * float(jnp.abs(expected).max()))
    assert int(cache.index) == 5 * 7


@pytest.mark.parametrize("positions", ["flat", "grid"])
def test_a_cache_that_is_full_forgets_the_oldest_block(positions):
    """With one layer, the model then is what it would be of the latest frames alone."""
    model = small_model(std=0.2, positions=positions, layers=1)
    cache, step = model.init_cache(3, 3), jax.jit(model.step)
    for time in range(5):
        cache, hidden_BSD = step(cache, TOKENS[:, time], ACTION[:, time])
        seen = slice(max(time - 2, 0), time + 1)
        np.testing.assert_allclose(hidden_BSD, model(TOKENS[:, seen], ACTION[:, seen])[:, -1], atol=1e-5)


def test_bfloat16_is_close_to_float32():
    exact, coarse = (small_model(std=0.1, compute_type=kind) for kind in ("float32", "bfloat16"))
    expected = exact.observation_logits(exact(TOKENS, ACTION))
    logits = coarse.observation_logits(coarse(TOKENS, ACTION))
    assert logits.dtype == jnp.float32
    error = jnp.abs(logits - expected).max() / jnp.abs(expected).max()
    assert 0 < error < 0.03
    assert all(x.dtype == jnp.float32 for x in jax.tree.leaves(nnx.state(coarse)))


def test_dropout_needs_a_key_and_reaches_embeddings_attention_and_residuals():
    model = small_model(std=0.2, dropout=0.5)
    silent = small_model(std=0.2, dropout=0.0)
    key = jax.random.key(0)
    np.testing.assert_array_equal(model(TOKENS, ACTION), silent(TOKENS, ACTION))
    np.testing.assert_array_equal(silent(TOKENS, ACTION, key), silent(TOKENS, ACTION))
    one, again, two = model(TOKENS, ACTION, key), model(TOKENS, ACTION, key), model(TOKENS, ACTION, jax.random.key(1))
    np.testing.assert_array_equal(one, again)
    assert float(jnp.abs(one - two).mean()) > 0.05


def test_layers_draw_different_dropout_and_start_different():
    params = nnx.state(small_model().layers)
    kernel = params["expand"]["kernel"][...]
    assert kernel.shape[0] == 2 and not jnp.allclose(kernel[0], kernel[1])


def test_seeds_can_be_a_leading_axis():
    graph, _ = nnx.split(small_model())
    params = [nnx.state(small_model(seed, std=0.1)) for seed in range(2)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *params)
    both = jax.jit(jax.vmap(lambda p: nnx.merge(graph, p)(TOKENS, ACTION, jax.random.key(0))))(stacked)
    for index in range(2):
        alone = nnx.merge(graph, params[index])(TOKENS, ACTION, jax.random.key(0))
        np.testing.assert_allclose(both[index], alone, atol=2e-5)


def test_the_fused_kernel_gives_the_same_model():
    plain, fused = (small_model(std=0.2, embed_dim=32, heads=2, attention=kind) for kind in ("plain", "fused"))
    np.testing.assert_allclose(fused(TOKENS, ACTION), plain(TOKENS, ACTION), atol=1e-5)
