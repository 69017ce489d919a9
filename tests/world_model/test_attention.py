from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from suite.world_model.attention import (
    attend_cached,
    cached_attention,
    causal_attention,
    held_tokens,
    rope,
    token_positions,
)


def inputs(steps: int = 5, block: int = 7, heads: int = 2, width: int = 4) -> tuple[jax.Array, ...]:
    keys = jax.random.split(jax.random.key(0), 3)
    return tuple(jax.random.normal(key, (3, steps * block, heads, width)) for key in keys)


def masked_attention(query, key, value, unit: int) -> jax.Array:
    """The whole square, the plain way."""
    score = jnp.einsum("bqnh,bsnh->bnqs", query, key) / np.sqrt(query.shape[-1])
    index = np.arange(query.shape[1]) // unit
    score = jnp.where((index[:, None] >= index[None])[None, None], score, -jnp.inf)
    return jnp.einsum("bnqs,bsnh->bqnh", jax.nn.softmax(score), value)


@pytest.mark.parametrize(("groups", "unit"), [(1, 7), (2, 7), (3, 7), (5, 7), (10, 7), (1, 1), (2, 1), (5, 1)])
def test_groups_equal_the_fully_masked_square_and_its_gradient(groups, unit):
    query, key, value = inputs()
    weight = jax.random.normal(jax.random.key(1), value.shape)

    def ours(*qkv):
        return (causal_attention(*qkv, block=7, unit=unit, groups=groups) * weight).sum()

    def plain(*qkv):
        return (masked_attention(*qkv, unit) * weight).sum()

    grouped = causal_attention(query, key, value, block=7, unit=unit, groups=groups)
    np.testing.assert_allclose(grouped, masked_attention(query, key, value, unit), atol=1e-6)
    for mine, theirs in zip(
        jax.grad(ours, (0, 1, 2))(query, key, value), jax.grad(plain, (0, 1, 2))(query, key, value), strict=True
    ):
        np.testing.assert_allclose(mine, theirs, atol=1e-5)


def test_gradient_with_dropout_is_that_of_the_dropped_forward_pass():
    qkv = inputs(steps=3)
    weight = jax.random.normal(jax.random.key(1), qkv[0].shape)
    direction = tuple(jax.random.normal(key, qkv[0].shape) for key in jax.random.split(jax.random.key(2), 3))

    def loss(scale):
        moved = [x + scale * along for x, along in zip(qkv, direction, strict=True)]
        dropped = causal_attention(*moved, block=7, dropout_rate=0.4, dropout_key=jax.random.key(3))
        return (dropped * weight).sum()

    slope = (loss(1e-2) - loss(-1e-2)) / 2e-2
    np.testing.assert_allclose(jax.grad(loss)(0.0), slope, rtol=2e-3)
    assert not np.allclose(loss(0.0), (masked_attention(*qkv, 7) * weight).sum(), rtol=1e-2)


def test_dropout_keeps_the_expected_output():
    query, key, value = inputs(steps=2)

    def dropped(seed):
        return causal_attention(query, key, value, block=7, dropout_rate=0.3, dropout_key=jax.random.key(seed))

    mean = jax.vmap(dropped)(jnp.arange(4000)).mean(0)
    np.testing.assert_allclose(mean, masked_attention(query, key, value, 7), atol=0.06)


def test_large_scores_do_not_overflow():
    query, key, value = inputs(steps=2)
    grads = jax.grad(lambda *qkv: causal_attention(*qkv, block=7).sum(), (0, 1, 2))(100 * query, 100 * key, value)
    assert all(np.isfinite(x).all() for x in grads)


def test_cached_attention_sees_only_what_is_filled():
    query, key, value = inputs(steps=3)
    for new in (slice(7, 14), slice(13, 14)):  # a block, and a single token
        last_Q = jnp.full(new.stop - new.start, 13)
        cached = query[:, new], key.swapaxes(1, 2), value.swapaxes(1, 2)
        mixed = cached_attention(*cached, held_tokens(jnp.int32(14), 21), last_Q)
        np.testing.assert_allclose(mixed, masked_attention(query, key, value, 7)[:, new], atol=1e-6)
        # On other devices all streams at once.
        together = attend_cached(*cached, jnp.arange(21)[None] <= last_Q[:, None])
        np.testing.assert_allclose(together, mixed, atol=1e-6)


def test_a_full_cache_holds_the_latest_tokens():
    np.testing.assert_array_equal(held_tokens(jnp.int32(2), 4), [0, 1, -2, -1])
    np.testing.assert_array_equal(held_tokens(jnp.int32(4), 4), [0, 1, 2, 3])
    np.testing.assert_array_equal(held_tokens(jnp.int32(9), 4), [8, 5, 6, 7])


@pytest.mark.parametrize("kind", ["flat", "grid"])
def test_rope_scores_depend_on_differences_of_positions_only(kind):
    query, key, _ = inputs(steps=3, width=8)

    def scores(shift):
        position = token_positions(kind, jnp.arange(21) + 7 * shift, 7, (2, 3))
        return jnp.einsum("bqnh,bsnh->bnqs", rope(query, position), rope(key, position))

    np.testing.assert_allclose(scores(0), scores(11), atol=2e-4)
    plain = jnp.einsum("bqnh,bsnh->bnqs", query, key)
    np.testing.assert_allclose(
        jnp.diagonal(scores(5), axis1=2, axis2=3), jnp.diagonal(plain, axis1=2, axis2=3), atol=1e-4
    )
    assert float(jnp.abs(scores(0) - plain).max()) > 0.1


def test_rope_rotates_by_the_position_and_keeps_the_length():
    x = jnp.asarray([[[[1.0, 0.0, 0.0, 0.0]]]])  # the first pair is (0, 2) and turns by 1 radian per token
    turned = rope(x, jnp.asarray([[2]]))
    np.testing.assert_allclose(turned.ravel(), [np.cos(2), 0, np.sin(2), 0], atol=1e-6)


def test_positions():
    flat = token_positions("flat", jnp.asarray([3, 21]), 7, None)
    np.testing.assert_array_equal(flat, [[3], [21]])
    grid = token_positions("grid", 28 + jnp.arange(7), 7, (2, 3))
    np.testing.assert_array_equal(grid, [[4, 0, 0], [4, 0, 1], [4, 0, 2], [4, 1, 0], [4, 1, 1], [4, 1, 2], [4, 2, 3]])
    with pytest.raises(ValueError, match="rows and columns of 6 tokens"):
        token_positions("grid", jnp.arange(14), 7, (2, 2))
