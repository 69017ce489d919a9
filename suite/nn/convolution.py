"""Convolution of images whose gradient is fast inside a compiled loop, on every device."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp

CHUNK_IMAGES = 16  # so many at a time: a processor's caches hold their patches


@jax.custom_vjp
def convolve(x_NHWC: jax.Array, kernel: jax.Array) -> jax.Array:
    """Convolution of images with a kernel [3, 3, inputs, outputs], stride 1, SAME padding."""
    return jax.lax.conv_general_dilated(x_NHWC, kernel, (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC"))


def _convolve_forward(x_NHWC: jax.Array, kernel: jax.Array) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
    return convolve(x_NHWC, kernel), (x_NHWC, kernel)


def _convolve_backward(saved: tuple[jax.Array, jax.Array], slope_NHWC: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Gradients by images and kernel.

    Inside a loop, XLA on a CPU compiles the kernel's gradient, written as a convolution, to plain loops: 14 to 70
    times slower than outside (jaxlib 0.10.1, measured). A matrix product with the 3x3 patches of the images is fast
    everywhere on a CPU; an accelerator's convolution library does better with the convolution.
    """
    x_NHWC, kernel = saved
    rotated = kernel[::-1, ::-1].swapaxes(2, 3)
    by_kernel = jax.lax.platform_dependent(
        x_NHWC, slope_NHWC, cpu=_kernel_gradient_by_products, default=_kernel_gradient_by_convolution
    )
    return convolve(slope_NHWC, rotated), by_kernel


def _kernel_gradient_by_products(x_NHWC: jax.Array, slope_NHWC: jax.Array) -> jax.Array:
    images, height, width, inputs = x_NHWC.shape
    chunk = math.gcd(images, CHUNK_IMAGES)

    def add_chunk(total: jax.Array, part: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
        x, slope = part
        padded = jnp.pad(x, ((0, 0), (1, 1), (1, 1), (0, 0)))
        shifted = [padded[:, i : i + height, j : j + width] for i in range(3) for j in range(3)]
        patches_MP = jnp.concatenate(shifted, axis=-1).reshape(-1, 9 * inputs)
        return total + patches_MP.T @ slope.reshape(len(patches_MP), -1), None

    # A few images at a time: nine copies of all of them, of every layer, would fill the memory and no cache holds them.
    parts = jax.tree.map(lambda a: a.reshape(-1, chunk, *a.shape[1:]), (x_NHWC, slope_NHWC))
    outputs = slope_NHWC.shape[-1]
    total, _ = jax.lax.scan(add_chunk, jnp.zeros((9 * inputs, outputs), slope_NHWC.dtype), parts)
    return total.reshape(3, 3, inputs, outputs)


def _kernel_gradient_by_convolution(x_NHWC: jax.Array, slope_NHWC: jax.Array) -> jax.Array:
    return jax.lax.conv_general_dilated(
        x_NHWC, slope_NHWC, (1, 1), ((1, 1), (1, 1)), dimension_numbers=("CHWN", "IHWO", "HWNC")
    )


convolve.defvjp(_convolve_forward, _convolve_backward)
