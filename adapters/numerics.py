"""Games written for JAX as it is, under the stricter rules that the rest of this program is traced with."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp


@contextlib.contextmanager
def loose_numerics() -> Iterator[None]:
    """Types and ranks are mixed as NumPy mixes them, whatever rules the caller is traced under."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


def strong(value: Any, dtype: Any = None) -> jax.Array:
    """`value` as an array whose type does not give way to others: jax's weak types compile once more."""
    array = jnp.asarray(value)
    if jnp.issubdtype(array.dtype, jax.dtypes.prng_key):
        return array
    return jax.lax.convert_element_type(array, dtype or array.dtype)


def like(new: Any, old: Any) -> Any:
    """A game's new state in the types of the old one, so that a compiled step can be fed its own output."""
    return jax.tree.map(lambda new, old: strong(new, old.dtype), new, old)
