"""Encoders and decoders of the VQ-VAEs: convolutional for whole frames, a small network for patches (Appendix A.2.1).

Shapes: N frames of (H, W, C) with values in [0, 1], L latents of D numbers each. The convolutional structure is the one
whose parameter count is the paper's (fidelity notes, M1): group norm and ReLU before each convolution, 2x2 convolutions
of stride 2 down, 2x2 transposed convolutions up. Neither of those overlaps, so both are matrix products.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
from flax import nnx

from suite.nn.convolution import convolve
from suite.tokenizers.patches import join_patches, split_patches

DOWNSAMPLED = (0, 2, 3)  # the first, third and fourth of five residual blocks
SMALLEST_SIDE = 5  # of the grid of latents: MinAtar's 10x10 are halved once, the paper's 63x63 thrice
MAX_GROUPS = 32


def downsampled(shape: tuple[int, ...]) -> tuple[int, ...]:
    """After which residual blocks a frame (H, W, C) is halved: the first of `DOWNSAMPLED`, as many as it bears."""
    sides = [math.ceil(min(shape[:2]) / 2**n) for n in range(1, len(DOWNSAMPLED) + 1)]
    return DOWNSAMPLED[: sum(side >= SMALLEST_SIDE for side in sides)]


def latent_grid(shape: tuple[int, ...]) -> tuple[int, int]:
    """(rows, columns) of latents of a frame (H, W, C): halved, rounding up, once for each of `downsampled`."""
    scale = 2 ** len(downsampled(shape))
    return math.ceil(shape[0] / scale), math.ceil(shape[1] / scale)


class Conv(nnx.Module):
    """3x3 convolution, stride 1, SAME padding, with bias."""

    def __init__(self, inputs: int, outputs: int, rngs: nnx.Rngs):
        init = nnx.initializers.lecun_normal()
        self.kernel = nnx.Param(init(rngs.params(), (3, 3, inputs, outputs), jnp.float32))
        self.bias = nnx.Param(jnp.zeros((outputs,), jnp.float32))

    def __call__(self, x_NHWC: jax.Array) -> jax.Array:
        return convolve(x_NHWC, self.kernel[...]) + self.bias[...][None, None, None]


class Down(nnx.Module):
    """2x2 convolution of stride 2, SAME padding; channels unchanged."""

    def __init__(self, channels: int, rngs: nnx.Rngs):
        self.dense = nnx.Linear(4 * channels, channels, rngs=rngs)

    def __call__(self, x_NHWC: jax.Array) -> jax.Array:
        _, height, width, _ = x_NHWC.shape
        even = jnp.pad(x_NHWC, ((0, 0), (0, height % 2), (0, width % 2), (0, 0)))
        rows, columns = even.shape[1] // 2, even.shape[2] // 2
        return self.dense(split_patches(even, (2, 2)).reshape(-1, rows, columns, 4 * x_NHWC.shape[-1]))


class Up(nnx.Module):
    """2x2 transposed convolution of stride 2; channels unchanged."""

    def __init__(self, channels: int, rngs: nnx.Rngs):
        self.dense = nnx.Linear(channels, 4 * channels, use_bias=False, rngs=rngs)
        self.bias = nnx.Param(jnp.zeros((channels,), jnp.float32))

    def __call__(self, x_NHWC: jax.Array) -> jax.Array:
        frames, rows, columns, channels = x_NHWC.shape
        cells = self.dense(x_NHWC).reshape(frames, rows * columns, 4 * channels)
        return join_patches(cells, (2 * rows, 2 * columns, channels), (2, 2)) + self.bias[...][None, None, None]


class AutoencoderBlock(nnx.Module):
    """x, through a 1x1 convolution where channels change, plus two times [norm, ReLU, convolution]."""

    def __init__(self, inputs: int, outputs: int, rngs: nnx.Rngs):
        self.first = NormReLUConv(inputs, outputs, rngs)
        self.second = NormReLUConv(outputs, outputs, rngs)
        self.shortcut = None if inputs == outputs else nnx.Linear(inputs, outputs, rngs=rngs)

    def __call__(self, x_NHWC: jax.Array) -> jax.Array:
        kept = x_NHWC if self.shortcut is None else self.shortcut(x_NHWC)
        return kept + self.second(self.first(x_NHWC))


class NormReLUConv(nnx.Module):
    """Group norm, ReLU, 3x3 convolution."""

    def __init__(self, inputs: int, outputs: int, rngs: nnx.Rngs):
        self.norm = nnx.GroupNorm(inputs, num_groups=math.gcd(MAX_GROUPS, inputs), rngs=rngs)
        self.conv = Conv(inputs, outputs, rngs)

    def __call__(self, x_NHWC: jax.Array) -> jax.Array:
        return self.conv(nnx.relu(self.norm(x_NHWC)))


class FrameEncoder(nnx.Module):
    """Frames [N, H, W, C] to latents [N, L, D]: a convolution, five residual blocks, a convolution."""

    def __init__(self, shape: tuple[int, ...], channels: Sequence[int], size: int, rngs: nnx.Rngs):
        self.first = Conv(shape[-1], channels[0], rngs)
        inputs = (channels[0], *channels[:-1])
        self.blocks = nnx.List(AutoencoderBlock(i, o, rngs) for i, o in zip(inputs, channels, strict=True))
        self.halved = downsampled(shape)
        self.downs = nnx.List(Down(channels[index], rngs) for index in self.halved)
        self.last = NormReLUConv(channels[-1], size, rngs)

    def __call__(self, x_NHWC: jax.Array) -> jax.Array:
        x_NHWC = self.first(x_NHWC)
        for index, block in enumerate(self.blocks):
            x_NHWC = block(x_NHWC)
            if index in self.halved:
                x_NHWC = self.downs[self.halved.index(index)](x_NHWC)
        z_NHWD = self.last(x_NHWC)
        return z_NHWD.reshape(z_NHWD.shape[0], -1, z_NHWD.shape[-1])


class FrameDecoder(nnx.Module):
    """The reverse of `FrameEncoder`; what it makes too large is cropped at the bottom and on the right."""

    def __init__(self, shape: tuple[int, ...], channels: Sequence[int], size: int, rngs: nnx.Rngs):
        self.shape = shape
        self.first = Conv(size, channels[-1], rngs)
        outputs = (channels[0], *channels[:-1])
        self.blocks = nnx.List(AutoencoderBlock(i, o, rngs) for i, o in zip(channels, outputs, strict=True))
        self.doubled = downsampled(shape)
        self.ups = nnx.List(Up(channels[index], rngs) for index in self.doubled)
        self.last = NormReLUConv(channels[0], shape[-1], rngs)

    def __call__(self, z_NLD: jax.Array) -> jax.Array:
        x_NHWC = self.first(z_NLD.reshape(-1, *latent_grid(self.shape), z_NLD.shape[-1]))
        for index in reversed(range(len(self.blocks))):
            if index in self.doubled:
                x_NHWC = self.ups[self.doubled.index(index)](x_NHWC)
            x_NHWC = self.blocks[index](x_NHWC)
        height, width, _ = self.shape
        return self.last(x_NHWC)[:, :height, :width]


class PatchEncoder(nnx.Module):
    """Frames to latents [N, L, D], each of one patch alone: dense, ReLU, dense."""

    def __init__(self, shape: tuple[int, ...], patch: tuple[int, int], size: int, rngs: nnx.Rngs):
        self.patch = patch
        self.first = nnx.Linear(math.prod(patch) * shape[-1], size, rngs=rngs)
        self.second = nnx.Linear(size, size, rngs=rngs)

    def __call__(self, x_NHWC: jax.Array) -> jax.Array:
        return self.second(nnx.relu(self.first(split_patches(x_NHWC, self.patch))))


class PatchDecoder(nnx.Module):
    """A linear map of each latent to its patch."""

    def __init__(self, shape: tuple[int, ...], patch: tuple[int, int], size: int, rngs: nnx.Rngs):
        self.shape, self.patch = shape, patch
        self.dense = nnx.Linear(size, math.prod(patch) * shape[-1], rngs=rngs)

    def __call__(self, z_NLD: jax.Array) -> jax.Array:
        return join_patches(self.dense(z_NLD), self.shape, self.patch)
