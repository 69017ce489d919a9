"""What is read off the transformer's outputs: one small network per prediction (Appendix A.2.2)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import nnx
from jax.typing import DTypeLike

INITIAL_STD = 0.02  # of every kernel and embedding, as in GPT-2


def initializer() -> nnx.Initializer:
    """Of every kernel and embedding."""
    return nnx.initializers.normal(INITIAL_STD)


class Head(nnx.Module):
    """Dense(D), ReLU, Dense(classes): float32 logits [..., classes] of hidden states [..., D].

    Products are in `dtype`; logits are accumulated and kept in float32, since their differences decide what is sampled.
    """

    def __init__(self, width: int, classes: int, dtype: DTypeLike, rngs: nnx.Rngs):
        self.hidden = nnx.Linear(width, width, dtype=dtype, kernel_init=initializer(), rngs=rngs)
        self.kernel = nnx.Param(initializer()(rngs.params(), (width, classes), jnp.float32))
        self.bias = nnx.Param(jnp.zeros((classes,), jnp.float32))
        self.dtype = dtype

    def __call__(self, hidden: jax.Array) -> jax.Array:
        features = nnx.relu(self.hidden(hidden))
        logits = jnp.dot(features, self.kernel[...].astype(self.dtype), preferred_element_type=jnp.float32)
        return logits + self.bias[...].reshape((1,) * (logits.ndim - 1) + (-1,))
