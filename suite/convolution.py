"""Convolution of images whose gradient is fast inside a compiled loop, on every device."""

from __future__ import annotations

import jax
import jax.numpy as jnp


@jax.custom_vjp
def convolve(x_NHWC: jax.Array, kernel: jax.Array) -> jax.Array:
    """Convolution of images with a kernel [3, 3, inputs, outputs], stride 1, SAME padding."""
    return jax.lax.conv_general_dilated(x_NHWC, kernel, (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC"))


def _convolve_forward(x_NHWC: jax.Array, kernel: jax.Array) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
    return convolve(x_NHWC, kernel), (x_NHWC, kernel)


def _convolve_backward(saved: tuple[jax.Array, jax.Array], slope_NHWC: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Gradients by images and kernel.

    Inside a loop, XLA on a CPU compiles the kernel's gradient, written as a convolution, to plain loops: 14 to 70
    times slower than outside (jaxlib 0.10.1, measured). Nine matrix products are fast everywhere on a CPU; an
    accelerator's convolution library does better with the convolution.
    """
    x_NHWC, kernel = saved
    rotated = kernel[::-1, ::-1].swapaxes(2, 3)
    by_kernel = jax.lax.platform_dependent(
        x_NHWC, slope_NHWC, cpu=_kernel_gradient_by_products, default=_kernel_gradient_by_convolution
    )
    return convolve(slope_NHWC, rotated), by_kernel


def _kernel_gradient_by_products(x_NHWC: jax.Array, slope_NHWC: jax.Array) -> jax.Array:
    inputs = x_NHWC.shape[-1]
    padded = jnp.pad(x_NHWC, ((0, 0), (1, 1), (1, 1), (0, 0)))
    slope_MO = slope_NHWC.reshape(-1, slope_NHWC.shape[-1])

    def product(offset: jax.Array) -> jax.Array:
        corner = (0, offset // 3, offset % 3, 0)
        return jax.lax.dynamic_slice(padded, corner, x_NHWC.shape).reshape(-1, inputs).T @ slope_MO

    # A loop, because nine products side by side would hold nine copies of the images, of every layer, at once.
    return jax.lax.map(product, jnp.arange(9)).reshape(3, 3, inputs, -1)


def _kernel_gradient_by_convolution(x_NHWC: jax.Array, slope_NHWC: jax.Array) -> jax.Array:
    return jax.lax.conv_general_dilated(
        x_NHWC, slope_NHWC, (1, 1), ((1, 1), (1, 1)), dimension_numbers=("CHWN", "IHWO", "HWNC")
    )


convolve.defvjp(_convolve_forward, _convolve_backward)
