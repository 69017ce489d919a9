"""The policy network of the previous best model-free agent (Moon et al. 2023; fidelity note 36): 3,951,122 parameters.

An Impala CNN whose layers are [norm, linear or convolution, ReLU], the norms over a frame's height, width and channels;
two dense layers; actor and critic differ by their last layer only. Without memory.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx

from suite.configuration.schema import PolicyConfig
from suite.policy.networks import RELU_GAIN, Conv3x3, Norm, Projection, dense, max_pool

FRAME = (1, 2, 3)  # height, width, channels: a group norm with one group


class NormConvReLU(nnx.Module):
    """Norm (unless `normalize` is False), 3x3 convolution, ReLU."""

    def __init__(self, inputs: int, outputs: int, dtype: Any, rngs: nnx.Rngs, normalize: bool = True):
        self.norm = Norm(inputs, FRAME, dtype) if normalize else None
        self.conv = Conv3x3(inputs, outputs, dtype, rngs)

    def __call__(self, x_NHWC: jax.Array) -> jax.Array:
        """[N, H, W, outputs]."""
        return jax.nn.relu(self.conv(x_NHWC if self.norm is None else self.norm(x_NHWC)))


class MoonStack(nnx.Module):
    """A layer, max-pooling, a norm, and residual blocks x + layers(x)."""

    def __init__(self, inputs: int, outputs: int, first: bool, config: PolicyConfig, dtype: Any, rngs: nnx.Rngs):
        self.conv = NormConvReLU(inputs, outputs, dtype, rngs, normalize=not first)
        self.norm = Norm(outputs, FRAME, dtype)
        self.blocks = nnx.List(
            nnx.List(NormConvReLU(outputs, outputs, dtype, rngs) for _ in range(config.convs_per_block))
            for _ in range(config.blocks_per_stack)
        )

    def __call__(self, x_NHWC: jax.Array) -> jax.Array:
        """[N, ceil(H/2), ceil(W/2), outputs]."""
        x_NHWC = self.norm(max_pool(self.conv(x_NHWC)))
        for block in self.blocks:
            y_NHWC = x_NHWC
            for layer in block:
                y_NHWC = layer(y_NHWC)
            x_NHWC = x_NHWC + y_NHWC
        return x_NHWC


class MoonCNN(nnx.Module):
    """The stacks, then [norm, dense, ReLU] to `config.embedding_size` numbers (`features`)."""

    def __init__(self, shape: tuple[int, ...], config: PolicyConfig, dtype: Any, rngs: nnx.Rngs):
        height, width, channels = shape
        self.stacks: Any = nnx.List()
        for index, outputs in enumerate(config.cnn_channels):
            self.stacks.append(MoonStack(channels, outputs, index == 0, config, dtype, rngs))
            height, width, channels = (height + 1) // 2, (width + 1) // 2, outputs
        self.projection = Projection(height * width * channels, config, dtype, rngs)
        self.features = config.embedding_size

    def __call__(self, x_NHWC: jax.Array) -> jax.Array:
        """Images with values in [0, 1] to embeddings z [N, features]."""
        for stack in self.stacks:
            x_NHWC = stack(x_NHWC)
        return self.projection(x_NHWC.reshape(x_NHWC.shape[0], -1))


class MoonTrunk(nnx.Module):
    """Norm, dense, ReLU: what actor and critic share."""

    def __init__(self, inputs: int, features: int, dtype: Any, rngs: nnx.Rngs):
        self.norm = Norm(inputs, (-1,), dtype)
        self.dense = dense(inputs, features, RELU_GAIN, dtype, rngs)

    def __call__(self, x: jax.Array) -> jax.Array:
        """float32 [..., features]."""
        return jax.nn.relu(self.dense(self.norm(x))).astype(jnp.float32)
