"""Several runs of one agent that differ by their seed and go on together: a leading axis S of all that they carry.

One run alone has no such axis. Each function here serves both.
"""

from __future__ import annotations

import operator
from collections.abc import Sequence
from typing import TypeVar

import jax
import jax.numpy as jnp

Tree = TypeVar("Tree")


def stacked(parts: Sequence[Tree]) -> Tree:
    """What each run has, as one; that of one alone is itself."""
    return parts[0] if len(parts) == 1 else jax.tree.map(lambda *each: jnp.stack(each), *parts)


def unstacked(tree: Tree, seeds: int) -> list[Tree]:
    """What each of so many runs has of it."""
    return [part(tree, seeds, i) for i in range(seeds)]


def part(tree: Tree, seeds: int, i: int) -> Tree:
    """What the i-th of so many runs has of it."""
    return tree if seeds == 1 else jax.tree.map(operator.itemgetter(i), tree)


def split(key: jax.Array, number: int) -> tuple[jax.Array, ...]:
    """`jax.random.split` of a key, or of each run's [S], as so many keys, or [S] each."""
    if key.ndim == 0:
        return tuple(jax.random.split(key, number))
    return tuple(jax.vmap(lambda own: jax.random.split(own, number), out_axes=1)(key))
