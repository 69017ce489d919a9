"""The blocks of the policy network: Impala CNN, GRU memory, dense residual trunk (Appendix A.1.1).

Shapes: N frames, T steps, B environments, (H, W, C) images, F features. Parameters are float32; `dtype` is the
type that layers compute in. Whatever it is, statistics of norms and the memory's state are float32.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx

from suite.configuration.schema import PolicyConfig
from suite.nn.convolution import convolve

Initializer = Callable[..., jax.Array]

# Fidelity note 3. `sqrt(2)` keeps the scale of activations through a ReLU.
RELU_GAIN = math.sqrt(2.0)
RESIDUAL_GAIN = 0.01

_NORM_AXES = {"instance": (1, 2), "batch": (0, 1, 2), "layer": (1, 2, 3)}
_ACTIVATIONS: dict[str, Callable[[jax.Array], jax.Array]] = {"relu": jax.nn.relu, "swish": jax.nn.swish}


def dense(inputs: int, outputs: int, gain: float, dtype: Any, rngs: nnx.Rngs) -> nnx.Linear:
    """Linear layer with bias and an orthogonal kernel of the given gain."""
    return nnx.Linear(inputs, outputs, kernel_init=nnx.initializers.orthogonal(gain), dtype=dtype, rngs=rngs)


class Conv3x3(nnx.Module):
    """3x3 convolution with bias, stride 1, SAME padding, orthogonal kernel; computes in `dtype`."""

    def __init__(self, inputs: int, outputs: int, dtype: Any, rngs: nnx.Rngs):
        init = nnx.initializers.orthogonal(RELU_GAIN)
        self.kernel = nnx.Param(init(rngs.params(), (3, 3, inputs, outputs), jnp.float32))
        self.bias = nnx.Param(jnp.zeros((outputs,), jnp.float32))
        self.dtype = dtype

    def __call__(self, x_NHWC: jax.Array) -> jax.Array:
        """[N, H, W, outputs] in `dtype`."""
        y_NHWC = convolve(x_NHWC.astype(self.dtype), self.kernel[...].astype(self.dtype))
        # Along one axis: on a CPU, the bias's gradient, a sum over three axes, takes several times as long.
        y_MO = y_NHWC.reshape(-1, y_NHWC.shape[-1]) + self.bias[...].astype(self.dtype)[None]
        return y_MO.reshape(y_NHWC.shape)

    def of_images(self, images_NHWC: jax.Array, norm: Norm) -> jax.Array:
        """The convolution of `norm(images)`, without a gradient by the images: nothing learns from that.

        A norm's scale acts like a factor of the kernel's rows, and its shift is the same for all images, so both get
        their gradients from the kernel's. On a CPU the gradient by images of few channels was a twelfth of the time
        that learning took.
        """
        kernel = self.kernel[...]
        scaled = (kernel * norm.scale[...][None, None, :, None]).astype(self.dtype)
        y_NHWC = convolve(jax.lax.stop_gradient(norm.standardise(images_NHWC)), scaled)
        shift_1HWC = jnp.broadcast_to(norm.bias[...], (1, *images_NHWC.shape[1:])).astype(self.dtype)
        return y_NHWC + self(shift_1HWC)


class Norm(nnx.Module):
    """Subtracts the mean and divides by the standard deviation over `axes`, then scales and shifts each feature.

    Features are the last axis. No running averages: acting and learning see the same function.
    """

    def __init__(self, features: int, axes: tuple[int, ...], dtype: Any, epsilon: float = 1e-5):
        self.scale = nnx.Param(jnp.ones((features,), jnp.float32))
        self.bias = nnx.Param(jnp.zeros((features,), jnp.float32))
        self.axes, self.dtype, self.epsilon = axes, dtype, epsilon

    def __call__(self, x: jax.Array) -> jax.Array:
        """`x` of any shape [..., features], normalised, in `dtype`."""
        features = (1,) * (x.ndim - 1) + (-1,)
        return self._normalise(x, self.scale[...].reshape(features), self.bias[...].reshape(features))

    def standardise(self, x: jax.Array) -> jax.Array:
        """The same before scale and shift."""
        return self._normalise(x, jnp.ones(()), jnp.zeros(()))

    def _normalise(self, x: jax.Array, scale: jax.Array, bias: jax.Array) -> jax.Array:
        x = x.astype(jnp.float32)
        # Both moments in one pass over x, and the rest folded into one multiply-add per element.
        mean = x.mean(self.axes, keepdims=True)
        variance = jnp.maximum(jnp.square(x).mean(self.axes, keepdims=True) - jnp.square(mean), 0.0)
        gain = jax.lax.rsqrt(variance + self.epsilon) * scale
        return (x * gain + (bias - mean * gain)).astype(self.dtype)


def max_pool(x_NHWC: jax.Array) -> jax.Array:
    """Max-pooling with a 3x3 window, stride 2, SAME padding; among equal values the first one takes the gradient.

    One axis at a time, and pairs of rows or columns made an axis of their own, because the gradients of a windowed
    reduction (select-and-scatter) and of strided slices (padding between elements) are slow on a CPU.
    """
    for axis in (1, 2):
        x_NHWC = _pool_axis(axis, x_NHWC.shape[axis], x_NHWC)
    return x_NHWC


@functools.partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def _pool_axis(axis: int, size: int, x: jax.Array) -> jax.Array:
    """The largest of every second three along an axis of `size` elements."""
    return _pool_axis_forward(axis, size, x)[0]


def _pool_axis_forward(axis: int, size: int, x: jax.Array) -> tuple[jax.Array, jax.Array]:
    pooled = (size + 1) // 2
    padding = [(0, 0, 0)] * x.ndim
    before = size % 2  # what SAME means for window 3 and stride 2
    padding[axis] = (before, 2 * (pooled + 1) - before - size, 0)
    padded = jax.lax.pad(x, jnp.array(-jnp.inf, x.dtype), padding)
    pairs = padded.reshape(*x.shape[:axis], pooled + 1, 2, *x.shape[axis + 1 :])
    even, odd = (jax.lax.index_in_dim(pairs, i, axis + 1, keepdims=False) for i in range(2))
    first, second = (jax.lax.slice_in_dim(side, 0, pooled, axis=axis) for side in (even, odd))
    third = jax.lax.slice_in_dim(even, 1, pooled + 1, axis=axis)
    largest = jnp.maximum(jnp.maximum(first, second), third)
    which = jnp.where(largest == first, 0, jnp.where(largest == second, 1, 2))
    return largest, which.astype(jnp.int8)


def _pool_axis_backward(axis: int, size: int, which: jax.Array, slope: jax.Array) -> tuple[jax.Array]:
    none = jnp.zeros((), slope.dtype)
    first, second, third = (jnp.where(which == i, slope, none) for i in range(3))

    def pad(x: jax.Array, before: int) -> jax.Array:
        padding = [(0, 0, 0)] * x.ndim
        padding[axis] = (before, 1 - before, 0)
        return jax.lax.pad(x, none, padding)

    pairs = jnp.stack([pad(first, 0) + pad(third, 1), pad(second, 0)], axis=axis + 1)
    padded = pairs.reshape(*slope.shape[:axis], -1, *slope.shape[axis + 1 :])
    return (jax.lax.slice_in_dim(padded, size % 2, size % 2 + size, axis=axis),)


_pool_axis.defvjp(_pool_axis_forward, _pool_axis_backward)


class PolicyBlock(nnx.Module):
    """x + `convs` times [activation, norm, 3x3 convolution]; channels unchanged."""

    def __init__(self, channels: int, config: PolicyConfig, dtype: Any, rngs: nnx.Rngs):
        axes = _NORM_AXES[config.cnn_norm]
        self.norms = nnx.List(Norm(channels, axes, dtype) for _ in range(config.convs_per_block))
        self.convs = nnx.List(Conv3x3(channels, channels, dtype, rngs) for _ in range(config.convs_per_block))
        self.activation = _ACTIVATIONS[config.activation]

    def __call__(self, x_NHWC: jax.Array) -> jax.Array:
        """Same shape as the input."""
        y_NHWC = x_NHWC
        for norm, conv in zip(self.norms, self.convs, strict=True):
            y_NHWC = conv(norm(self.activation(y_NHWC)))
        return x_NHWC + y_NHWC


class ImpalaStack(nnx.Module):
    """Norm, 3x3 convolution, max-pooling that halves height and width, residual blocks; the `first` sees images."""

    def __init__(self, inputs: int, outputs: int, first: bool, config: PolicyConfig, dtype: Any, rngs: nnx.Rngs):
        self.first = first
        self.norm = Norm(inputs, _NORM_AXES[config.cnn_norm], dtype)
        self.conv = Conv3x3(inputs, outputs, dtype, rngs)
        self.blocks = nnx.List(PolicyBlock(outputs, config, dtype, rngs) for _ in range(config.blocks_per_stack))

    def __call__(self, x_NHWC: jax.Array) -> jax.Array:
        """[N, ceil(H/2), ceil(W/2), outputs]."""
        y_NHWC = self.conv.of_images(x_NHWC, self.norm) if self.first else self.conv(self.norm(x_NHWC))
        y_NHWC = max_pool(y_NHWC)
        for block in self.blocks:
            y_NHWC = block(y_NHWC)
        return y_NHWC


class ImpalaCNN(nnx.Module):
    """Impala CNN (Appendix A.1.1): one stack per entry of `config.cnn_channels`, activation, flatten.

    With `config.embedding_size` layer norm, dense and ReLU follow.

    Norms follow `config.cnn_norm` (fidelity note 1): "instance" per frame and channel; "batch" per channel over
    the current batch; "layer" per frame over height, width and channels. `features` is the size of its output:
    8192 for 63x63 pixels and the paper's channels.
    """

    def __init__(self, shape: tuple[int, ...], config: PolicyConfig, dtype: Any, rngs: nnx.Rngs):
        height, width, channels = shape
        self.stacks: Any = nnx.List()
        for index, outputs in enumerate(config.cnn_channels):
            self.stacks.append(ImpalaStack(channels, outputs, index == 0, config, dtype, rngs))
            height, width, channels = (height + 1) // 2, (width + 1) // 2, outputs
        self.features = height * width * channels
        self.activation = _ACTIVATIONS[config.activation]
        self.projection = None if not config.embedding_size else Projection(self.features, config, dtype, rngs)
        self.features = config.embedding_size or self.features

    def __call__(self, x_NHWC: jax.Array) -> jax.Array:
        """Images with values in [0, 1] to embeddings z [N, features]."""
        for stack in self.stacks:
            x_NHWC = stack(x_NHWC)
        z_NF = self.activation(x_NHWC).reshape(x_NHWC.shape[0], -1)
        return z_NF if self.projection is None else self.projection(z_NF)


class Projection(nnx.Module):
    """Layer norm, dense, ReLU: embeddings [N, inputs] to [N, config.embedding_size]."""

    def __init__(self, inputs: int, config: PolicyConfig, dtype: Any, rngs: nnx.Rngs):
        self.norm = Norm(inputs, (-1,), dtype)
        self.dense = dense(inputs, config.embedding_size, RELU_GAIN, dtype, rngs)

    def __call__(self, z_NF: jax.Array) -> jax.Array:
        return jax.nn.relu(self.dense(self.norm(z_NF)))


class SymbolMLP(nnx.Module):
    """Two dense layers with ReLU on one-hot symbols (fidelity note 6); `features` is the size of its output."""

    def __init__(self, symbols: int, categories: int, features: int, dtype: Any, rngs: nnx.Rngs):
        self.categories, self.features, self.dtype = categories, features, dtype
        self.first = dense(symbols * categories, features, RELU_GAIN, dtype, rngs)
        self.second = dense(features, features, RELU_GAIN, dtype, rngs)

    def __call__(self, symbols_NS: jax.Array) -> jax.Array:
        """Integer symbols in [0, categories) to embeddings z [N, features]."""
        x_NF = jax.nn.one_hot(symbols_NS, self.categories, dtype=self.dtype).reshape(symbols_NS.shape[0], -1)
        return jax.nn.relu(self.second(jax.nn.relu(self.first(x_NF))))


class GRU(nnx.Module):
    """Gated recurrent unit over a sequence (Cho et al. 2014, with a bias of its own on the hidden candidate).

    Everything that depends on inputs alone is one product over all steps; only the recurrence is a scan.
    """

    def __init__(self, features: int, dtype: Any, rngs: nnx.Rngs):
        init = _per_gate(nnx.initializers.orthogonal())
        self.input_gates = nnx.Linear(features, 3 * features, kernel_init=init, dtype=dtype, rngs=rngs)
        self.hidden_gates = nnx.Linear(features, 3 * features, use_bias=False, kernel_init=init, dtype=dtype, rngs=rngs)
        self.candidate_bias = nnx.Param(jnp.zeros((features,), jnp.float32))

    def __call__(
        self, x_TBF: jax.Array, first_TB: jax.Array, hidden_BF: jax.Array, acting_TB: jax.Array | None = None
    ) -> tuple[jax.Array, jax.Array]:
        """float32 outputs [T, B, F] and the hidden state after the last step.

        The state is zeroed before a step where `first_TB`, and stays as it was at a step where not `acting_TB`;
        the output there is what acting would have given.
        """
        inputs_TBG = self.input_gates(x_TBF).astype(jnp.float32)
        candidate_bias = self.candidate_bias[...][None]

        def step(hidden_BF, inputs):
            inputs_BG, first_B, acting_B = inputs
            hidden_BF = jnp.where(first_B[:, None], 0.0, hidden_BF)
            reset_x, update_x, candidate_x = jnp.split(inputs_BG, 3, axis=-1)
            reset_h, update_h, candidate_h = jnp.split(self.hidden_gates(hidden_BF).astype(jnp.float32), 3, axis=-1)
            reset = jax.nn.sigmoid(reset_x + reset_h)
            update = jax.nn.sigmoid(update_x + update_h)
            candidate = jnp.tanh(candidate_x + reset * (candidate_h + candidate_bias))
            output_BF = (1.0 - update) * candidate + update * hidden_BF
            advanced_BF = output_BF if acting_B is None else jnp.where(acting_B[:, None], output_BF, hidden_BF)
            return advanced_BF, output_BF

        hidden_BF, output_TBF = jax.lax.scan(step, hidden_BF, (inputs_TBG, first_TB, acting_TB))
        return output_TBF, hidden_BF


class DenseTrunk(nnx.Module):
    """The dense part of actor or critic: layer norm, dense, ReLU, residual blocks, layer norm (Appendix A.1.1).

    A residual block is ReLU(x + dense(x)).
    """

    def __init__(self, inputs: int, features: int, blocks: int, dtype: Any, rngs: nnx.Rngs):
        self.input_norm = Norm(inputs, (-1,), dtype)
        self.first = dense(inputs, features, RELU_GAIN, dtype, rngs)
        self.residuals = nnx.List(dense(features, features, RESIDUAL_GAIN, dtype, rngs) for _ in range(blocks))
        self.output_norm = Norm(features, (-1,), jnp.float32)

    def __call__(self, x: jax.Array) -> jax.Array:
        """float32 [..., features]."""
        x = jax.nn.relu(self.first(self.input_norm(x)))
        for residual in self.residuals:
            x = jax.nn.relu(x + residual(x))
        return self.output_norm(x)


def _per_gate(init: Initializer) -> Initializer:
    """`init` applied to each of the three gates that share one kernel [F, 3F]."""

    def init_gates(key, shape, dtype=jnp.float32, **options):
        gate = (shape[0], shape[1] // 3)
        return jnp.concatenate([init(k, gate, dtype, **options) for k in jax.random.split(key, 3)], axis=1)

    return init_gates
