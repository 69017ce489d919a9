"""The blocks: what each computes, against Flax, plain NumPy or a property that must hold."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from suite.configuration.schema import PolicyConfig
from suite.interface.environment import ObservationSpec
from suite.policy import moon, networks
from suite.policy.actor_critic import ActorCritic

TINY = PolicyConfig(cnn_channels=(4, 6), hidden_size=8, rnn_size=5)


def random(*shape: int, seed: int = 0) -> jax.Array:
    return jax.random.normal(jax.random.key(seed), shape, jnp.float32)


def cnn(shape=(9, 10, 3), **changes) -> networks.ImpalaCNN:
    config = dataclasses.replace(TINY, **changes)
    return nnx.jit(lambda: networks.ImpalaCNN(shape, config, jnp.float32, nnx.Rngs(0)))()


@nnx.jit
def call(module, *inputs):
    return module(*inputs)


@pytest.mark.parametrize("size", [(1, 1), (2, 3), (5, 8), (63, 32)])
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.bfloat16])
def test_max_pool_is_flax_max_pool(size, dtype):
    x_NHWC = random(2, *size, 3).astype(dtype)
    expected = nnx.max_pool(x_NHWC, (3, 3), (2, 2), "SAME")
    pooled = networks.max_pool(x_NHWC)
    assert pooled.dtype == dtype and pooled.shape == expected.shape
    np.testing.assert_array_equal(pooled, expected)


def test_max_pool_has_the_gradient_of_flax_max_pool():
    x_NHWC, weight = random(2, 7, 6, 3), random(2, 4, 3, 3, seed=1)
    ours = jax.grad(lambda x: (weight * networks.max_pool(x)).sum())(x_NHWC)
    theirs = jax.grad(lambda x: (weight * nnx.max_pool(x, (3, 3), (2, 2), "SAME")).sum())(x_NHWC)
    np.testing.assert_allclose(ours, theirs, rtol=1e-6)


def test_of_equal_values_one_alone_takes_the_gradient_of_max_pool():
    weight = random(2, 4, 3, 3, seed=1)
    slope = jax.grad(lambda x: (weight * networks.max_pool(x)).sum())(jnp.zeros((2, 7, 6, 3)))
    np.testing.assert_allclose(slope.sum((1, 2)), weight.sum((1, 2)), rtol=1e-5)
    assert int((slope != 0).sum()) == weight.size


@pytest.mark.parametrize("axes", [(1, 2), (0, 1, 2), (1, 2, 3)])
def test_a_convolution_of_images_is_that_of_the_normalised_images_with_its_gradients(axes):
    images, weight = random(3, 5, 4, 3), random(3, 5, 4, 6, seed=1)
    conv, norm = networks.Conv3x3(3, 6, jnp.float32, nnx.Rngs(0)), networks.Norm(3, axes, jnp.float32)
    conv.bias[...] = random(6, seed=2)
    norm.scale[...], norm.bias[...] = random(3, seed=3), random(3, seed=4)
    layers = nnx.Dict(conv=conv, norm=norm)
    graphdef, params = nnx.split(layers)

    def value_and_grads(function):
        return jax.value_and_grad(lambda p: (weight * function(nnx.merge(graphdef, p))).sum())(params)

    ours, our_grads = value_and_grads(lambda both: both.conv.of_images(images, both.norm))
    plain, plain_grads = value_and_grads(lambda both: both.conv(both.norm(images)))
    np.testing.assert_allclose(ours, plain, rtol=1e-5)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4), our_grads, plain_grads)


def test_convolution_is_flax_convolution_with_its_gradients():
    x_NHWC = random(2, 5, 4, 3)
    weight = random(2, 5, 4, 6, seed=1)
    theirs = nnx.Conv(3, 6, (3, 3), padding="SAME", rngs=nnx.Rngs(0))
    ours = networks.Conv3x3(3, 6, jnp.float32, nnx.Rngs(0))
    kernel, bias = random(3, 3, 3, 6, seed=2), random(6, seed=3)

    def loss(module, x, kernel, bias):
        module = nnx.merge(nnx.graphdef(module), nnx.State({"kernel": nnx.Param(kernel), "bias": nnx.Param(bias)}))
        return (weight * module(x)).sum()

    slopes = jax.grad(lambda *arguments: loss(ours, *arguments), (0, 1, 2))(x_NHWC, kernel, bias)
    expected = jax.grad(lambda *arguments: loss(theirs, *arguments), (0, 1, 2))(x_NHWC, kernel, bias)
    for slope, other in zip(slopes, expected, strict=True):
        np.testing.assert_allclose(slope, other, rtol=1e-4, atol=1e-4)
    ours.kernel[...], ours.bias[...] = kernel, bias
    theirs.kernel[...], theirs.bias[...] = kernel, bias
    np.testing.assert_allclose(ours(x_NHWC), theirs(x_NHWC), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(("axes", "shape"), [((-1,), (3, 4, 7)), ((1, 2), (3, 4, 5, 7)), ((0, 1, 2), (3, 4, 5, 7))])
def test_norm_against_numpy(axes, shape):
    norm = networks.Norm(7, axes, jnp.float32)
    norm.scale[...], norm.bias[...] = random(7, seed=1), random(7, seed=2)
    x = np.asarray(3.0 * random(*shape) + 2.0)
    standardized = (x - x.mean(axes, keepdims=True)) / np.sqrt(x.var(axes, keepdims=True) + 1e-5)
    expected = standardized * np.asarray(norm.scale[...]) + np.asarray(norm.bias[...])
    np.testing.assert_allclose(norm(jnp.asarray(x)), expected, rtol=1e-4, atol=1e-5)


def test_norm_of_a_constant_image_is_finite_with_finite_gradient():
    norm = networks.Norm(3, (1, 2), jnp.float32)
    value, gradient = jax.value_and_grad(lambda x: norm(x).sum())(jnp.full((1, 4, 4, 3), 0.7))
    assert jnp.isfinite(value) and jnp.isfinite(gradient).all()


@pytest.mark.parametrize(("kind", "independent"), [("instance", True), ("layer", True), ("batch", False)])
def test_only_batch_norm_lets_frames_see_each_other(kind, independent):
    """Fidelity note 1: with batch norm the policy acts differently when it collects than when it learns."""
    module = cnn(cnn_norm=kind)
    x_NHWC = random(4, 9, 10, 3)
    alone, together = call(module, x_NHWC[:1]), call(module, x_NHWC)[:1]
    assert np.allclose(alone, together, atol=1e-5) == independent


def test_cnn_halves_each_stack_and_ends_in_an_activation():
    module = cnn((63, 62, 3))
    assert module.features == 16 * 16 * 6
    z_NF = call(module, random(2, 63, 62, 3))
    assert z_NF.shape == (2, 16 * 16 * 6) and z_NF.min() == 0.0


def test_cnn_activation_is_configurable():
    assert call(cnn(activation="swish"), random(2, 9, 10, 3)).min() < 0.0


def test_residual_block_is_the_identity_when_its_last_convolution_is_zero():
    block = networks.PolicyBlock(4, TINY, jnp.float32, nnx.Rngs(0))
    x_NHWC = random(2, 5, 5, 4)
    assert not np.allclose(block(x_NHWC), x_NHWC)
    block.convs[-1].kernel[...] = jnp.zeros_like(block.convs[-1].kernel[...])
    np.testing.assert_array_equal(block(x_NHWC), x_NHWC)


def test_gru_against_numpy():
    gru = networks.GRU(5, jnp.float32, nnx.Rngs(0))
    gru.candidate_bias[...] = random(5, seed=1)
    gru.input_gates.bias[...] = random(15, seed=2)
    x_TBF, hidden_BF = random(4, 2, 5, seed=3), random(2, 5, seed=4)
    output_TBF, last_BF = gru(x_TBF, jnp.zeros((4, 2), bool), hidden_BF)

    def sigmoid(x):
        return 1.0 / (1.0 + np.exp(-x))

    h = np.asarray(hidden_BF)
    for t in range(4):
        r_x, u_x, n_x = np.split(np.asarray(gru.input_gates(x_TBF[t])), 3, 1)
        r_h, u_h, n_h = np.split(h @ np.asarray(gru.hidden_gates.kernel[...]), 3, 1)
        update = sigmoid(u_x + u_h)
        candidate = np.tanh(n_x + sigmoid(r_x + r_h) * (n_h + np.asarray(gru.candidate_bias[...])))
        h = (1 - update) * candidate + update * h
        np.testing.assert_allclose(output_TBF[t], h, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(last_BF, output_TBF[-1])


def test_gru_forgets_at_first_and_waits_where_not_acting():
    gru = networks.GRU(5, jnp.float32, nnx.Rngs(0))
    x_TBF, hidden_BF = random(3, 2, 5), random(2, 5, seed=1)
    first_TB = jnp.zeros((3, 2), bool).at[1, 0].set(True)
    acting_TB = jnp.ones((3, 2), bool).at[1, 1].set(False)
    output_TBF, last_BF = gru(x_TBF, first_TB, hidden_BF, acting_TB)
    fresh_TBF, _ = gru(x_TBF[1:], jnp.zeros((2, 2), bool), jnp.zeros((2, 5)))
    np.testing.assert_allclose(output_TBF[1:, 0], fresh_TBF[:, 0], rtol=1e-6)
    skipped_TBF, skipped_BF = gru(x_TBF[jnp.array([0, 2])], jnp.zeros((2, 2), bool), hidden_BF)
    np.testing.assert_allclose(output_TBF[2, 1], skipped_TBF[1, 1], rtol=1e-6)
    np.testing.assert_allclose(last_BF[1], skipped_BF[1], rtol=1e-6)


def test_symbol_mlp_sees_categories_not_numbers():
    mlp = networks.SymbolMLP(2, 3, 8, jnp.float32, nnx.Rngs(0))
    assert mlp.first.kernel.shape == (6, 8)
    symbols_NS = jnp.array([[0, 2], [1, 0]], jnp.uint8)
    one_hot = np.array([[1, 0, 0, 0, 0, 1], [0, 1, 0, 1, 0, 0]], np.float32)
    hidden = np.maximum(one_hot @ np.asarray(mlp.first.kernel[...]), 0)
    expected = np.maximum(hidden @ np.asarray(mlp.second.kernel[...]), 0)
    np.testing.assert_allclose(mlp(symbols_NS), expected, rtol=1e-5, atol=1e-6)


def orthogonal_gain(kernel: jax.Array) -> float:
    """The gain of an orthogonal kernel; fails if it is not one."""
    matrix = np.asarray(kernel).reshape(-1, kernel.shape[-1])
    singular = np.linalg.svd(matrix, compute_uv=False)
    np.testing.assert_allclose(singular, singular[0], rtol=1e-3)
    return float(singular[0])


def test_initial_gains_of_blocks():
    """Fidelity note 3."""
    rngs = nnx.Rngs(0)
    trunk = networks.DenseTrunk(6, 8, 2, jnp.float32, rngs)
    assert orthogonal_gain(trunk.first.kernel[...]) == pytest.approx(2**0.5, rel=1e-3)
    for residual in trunk.residuals:
        assert orthogonal_gain(residual.kernel[...]) == pytest.approx(0.01, rel=1e-3)
    gru = networks.GRU(5, jnp.float32, rngs)
    for gates in (gru.input_gates, gru.hidden_gates):
        for gate in jnp.split(gates.kernel[...], 3, axis=1):
            assert orthogonal_gain(gate) == pytest.approx(1.0, rel=1e-3)
    assert orthogonal_gain(networks.Conv3x3(3, 6, jnp.float32, rngs).kernel[...]) == pytest.approx(2**0.5, rel=1e-3)


def test_bfloat16_computes_in_bfloat16_and_keeps_float32_parameters_and_memory():
    module = networks.ImpalaCNN((9, 10, 3), TINY, jnp.bfloat16, nnx.Rngs(0))
    assert module(random(1, 9, 10, 3)).dtype == jnp.bfloat16
    assert {leaf.dtype for leaf in jax.tree.leaves(nnx.state(module))} == {jnp.dtype("float32")}
    gru = networks.GRU(5, jnp.bfloat16, nnx.Rngs(0))
    output_TBF, hidden_BF = gru(random(2, 3, 5).astype(jnp.bfloat16), jnp.zeros((2, 3), bool), jnp.zeros((3, 5)))
    assert output_TBF.dtype == hidden_BF.dtype == jnp.float32


def count(module) -> int:
    return sum(x.size for x in jax.tree.leaves(nnx.state(module, nnx.Param)))


def test_an_embedding_is_layer_norm_dense_and_relu_of_the_cnns_output():
    plain, mapped = cnn(), cnn(embedding_size=7)
    mapped.stacks = plain.stacks
    x_NHWC = jax.random.uniform(jax.random.key(1), (2, 9, 10, 3))
    z_NF = np.asarray(call(plain, x_NHWC), np.float64)
    normed = (z_NF - z_NF.mean(-1, keepdims=True)) / np.sqrt(z_NF.var(-1, keepdims=True) + 1e-5)
    kernel = np.asarray(mapped.projection.dense.kernel[...])
    assert mapped.features == 7 and kernel.shape == (plain.features, 7)
    np.testing.assert_allclose(call(mapped, x_NHWC), np.maximum(normed @ kernel, 0), atol=1e-4)


def test_moons_network_by_flax_layers():
    """Fidelity note 36: layers of [norm, convolution, ReLU], the first without norm; max-pooling, norm, blocks."""
    config = PolicyConfig(
        kind="moon",
        cnn_channels=(4,),
        blocks_per_stack=1,
        convs_per_block=2,
        hidden_size=8,
        rnn_size=0,
        embedding_size=6,
    )
    network = moon.MoonCNN((6, 6, 3), config, jnp.float32, nnx.Rngs(0))
    stack = network.stacks[0]

    def norm(x):
        mean, variance = x.mean((1, 2, 3), keepdims=True), x.var((1, 2, 3), keepdims=True)
        return (x - mean) / jnp.sqrt(variance + 1e-5)

    def conv(layer, x):
        kernel = layer.conv.kernel[...]
        return jax.nn.relu(
            jax.lax.conv_general_dilated(x, kernel, (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC"))
        )

    x = jax.random.uniform(jax.random.key(0), (2, 6, 6, 3))
    y = norm(nnx.max_pool(conv(stack.conv, x), (3, 3), (2, 2), "SAME"))
    block = stack.blocks[0]
    y = y + conv(block[1], norm(conv(block[0], norm(y))))
    flat = np.asarray(y.reshape(2, -1))
    flat = (flat - flat.mean(-1, keepdims=True)) / np.sqrt(flat.var(-1, keepdims=True) + 1e-5)
    expected = np.maximum(flat @ np.asarray(network.projection.dense.kernel[...]), 0)
    np.testing.assert_allclose(network(x), expected, atol=1e-4)


def test_moons_actor_and_critic_share_all_but_their_last_layer():
    config = PolicyConfig(
        kind="moon", cnn_channels=(4,), blocks_per_stack=1, hidden_size=8, rnn_size=0, embedding_size=6
    )
    policy = ActorCritic(config, ObservationSpec((6, 6, 3), 255, "pixels", (3, 3)), 5, nnx.Rngs(0))
    assert len(policy.trunks) == 1 and policy.memory is None
    assert count(policy.trunks[0]) == 2 * 6 + 6 * 8 + 8
    output, hidden_BH = policy(jnp.zeros((3, 2, 6, 6, 3), jnp.uint8), jnp.zeros((3, 2), bool), policy.initial_hidden(2))
    assert output.logits_TBA.shape == (3, 2, 5) and hidden_BH.shape == (2, 0)
    gain = np.linalg.norm(policy.value_head.kernel[...])
    np.testing.assert_allclose(gain, 0.1, rtol=1e-5)
