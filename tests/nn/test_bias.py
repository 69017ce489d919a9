from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from suite.nn.bias import add_bias


@pytest.mark.parametrize("rows", [1, 1000])
def test_value_and_gradients_are_those_of_adding_it(rows):
    x_key, bias_key, slope_key = jax.random.split(jax.random.key(0), 3)
    x_NC, slope_NC = jax.random.normal(x_key, (rows, 5)), jax.random.normal(slope_key, (rows, 5))
    bias_C = jax.random.normal(bias_key, (5,))

    def slopes(add):
        return jax.jit(jax.value_and_grad(lambda *x: (jnp.sin(add(*x)) * slope_NC).sum(), argnums=(0, 1)))(x_NC, bias_C)

    found, expected = slopes(add_bias), slopes(lambda x_NC, bias_C: x_NC + bias_C[None])
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-5, atol=1e-5), found, expected)
