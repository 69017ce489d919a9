"""Operation counts against counting by hand."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from suite.benchmarks.flops import count_flops


def test_products_loops_and_branches():
    a, b = jnp.ones((3, 4)), jnp.ones((4, 5))
    once = 2 * 3 * 4 * 5
    assert count_flops(jnp.dot, a, b) == once
    assert count_flops(jax.jit(lambda a, b: jax.lax.scan(lambda c, _: (c, a @ b), 0, length=7)), a, b) == 7 * once
    assert (
        count_flops(lambda a, b: jax.lax.fori_loop(0, a.sum().astype(int), lambda i, c: c + a @ b, a @ b), a, b)
        == 2 * once
    )
    branches = lambda a, b: jax.lax.cond(a.sum() > 0, lambda: a @ b, lambda: (a @ b) @ (b.T @ b))  # noqa: E731
    assert count_flops(branches, a, b) == once + 2 * 5 * 4 * 5 + 2 * 3 * 5 * 5


def test_a_convolution_and_its_gradients():
    x, w = jnp.ones((2, 8, 8, 3)), jnp.ones((3, 3, 3, 5))

    def convolve(x, w):
        return jax.lax.conv_general_dilated(x, w, (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC"))

    once = 2 * (2 * 8 * 8 * 5) * (3 * 3 * 3)
    assert count_flops(convolve, x, w) == once
    gradients = count_flops(jax.grad(lambda x, w: convolve(x, w).sum(), argnums=(0, 1)), x, w)
    assert gradients == 3 * once  # forward, and one of the same size for each argument
