"""The fused kernel, interpreted: on a CPU it can be compared with the plain way, and lowered for a GPU, but not run."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from suite.nn.fused_attention import fused_attention
from suite.world_model.attention import causal_attention

BLOCK = 26  # tokens of a frame of MinAtar and an action


def inputs(steps: int = 5) -> tuple[jax.Array, ...]:
    keys = jax.random.split(jax.random.key(0), 4)
    return tuple(jax.random.normal(key, (2, steps * BLOCK, 2, 16)) for key in keys)


@pytest.mark.parametrize("unit", [BLOCK, 1])
def test_it_equals_the_plain_way_and_its_gradient(unit):
    """130 tokens: three tiles, the last one mostly padding, and units that begin within tiles."""
    *qkv, weight = inputs()
    fused = functools.partial(fused_attention, unit=unit, interpret=True)
    plain = functools.partial(causal_attention, block=BLOCK, unit=unit)

    def value_and_grads(attention):
        return jax.jit(jax.value_and_grad(lambda *qkv: (attention(*qkv) * weight).sum(), (0, 1, 2)))(*qkv)

    np.testing.assert_allclose(fused(*qkv), plain(*qkv), atol=2e-6)
    for ours, theirs in zip(*(jax.tree.leaves(value_and_grads(each)) for each in (fused, plain)), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=2e-5, rtol=1e-5)


def test_dropout_drops_as_many_as_it_says_and_the_gradient_is_of_what_is_left():
    query, key, value, weight = inputs(steps=3)
    direction = inputs(steps=3)[0][..., ::-1]

    def attend(seed, *qkv):
        return fused_attention(*qkv, unit=BLOCK, dropout_rate=0.4, dropout_key=jax.random.key(seed), interpret=True)

    # Equal scores and values of one: an output is the kept share of the weights, scaled to 1 on average.
    shares = jax.jit(lambda seed: attend(seed, 0 * query, key, jnp.ones_like(value)))
    kept_BSNH = np.stack([shares(seed) for seed in range(8)])
    np.testing.assert_allclose(kept_BSNH.mean(), 1, atol=0.01)
    assert kept_BSNH[..., 0].std() > 0.05 and len(np.unique(kept_BSNH[0, 0, :, 0, 0])) > 20

    def loss(scale):
        return (attend(3, query + scale * direction, key - scale * direction, value + scale * direction) * weight).sum()

    slope = (loss(1e-2) - loss(-1e-2)) / 2e-2
    np.testing.assert_allclose(jax.grad(loss)(0.0), slope, rtol=5e-3)


def test_it_can_be_lowered_for_a_gpu():
    """That it compiles and runs there too is for scripts/gpu.py to show."""
    query, key, value, _ = inputs()

    def loss(*qkv):
        attended = fused_attention(*qkv, unit=BLOCK, dropout_rate=0.1, dropout_key=jax.random.key(0), interpret=False)
        return attended.astype(jnp.float32).sum()

    arrays = [x.astype(jnp.bfloat16) for x in (query, key, value)]
    lowered = jax.jit(jax.grad(loss, (0, 1, 2))).trace(*arrays).lower(lowering_platforms=("cuda",))
    assert lowered.as_text().count("triton") >= 3


@pytest.mark.skipif("jax.default_backend() != 'gpu'")
def test_it_runs_on_a_gpu():
    *qkv, _ = inputs()
    fused = jax.jit(functools.partial(fused_attention, unit=BLOCK))(*qkv)
    np.testing.assert_allclose(fused, causal_attention(*qkv, block=BLOCK), atol=2e-2)  # products may be TF32 there


def test_widths_that_it_cannot_multiply():
    narrow = jnp.zeros((1, BLOCK, 1, 8))
    with pytest.raises(ValueError, match="16, 32, 64"):
        fused_attention(narrow, narrow, narrow, unit=BLOCK, interpret=True)
