"""A world model of a few thousand parameters, for the tests of this folder."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from suite.configuration.schema import WorldModelConfig
from suite.interface.tokens import TokenSpec
from suite.world_model.sequences import Sequences
from suite.world_model.transformer import WorldModel

SPEC = TokenSpec(tokens_per_frame=6, num_codes=8, num_actions=3, reward_classes=(0.0, 1.0))
GRID = (2, 3)


def small_config(**changes) -> WorldModelConfig:
    fields = {"embed_dim": 32, "layers": 2, "heads": 4, "sequence_length": 5, "compute_type": "float32"}
    return WorldModelConfig(**fields | changes)


def small_model(seed: int = 0, std: float | None = None, **changes) -> WorldModel:
    """With `std`, all parameters are drawn with that deviation, so that attention and heads are far from uniform."""
    model = WorldModel(small_config(**changes), SPEC, GRID, nnx.Rngs(seed))
    if std is None:
        return model
    graph, params = nnx.split(model)
    leaves, tree = jax.tree.flatten(params)
    keys = jax.random.split(jax.random.key(seed), len(leaves))
    leaves = [x + std * jax.random.normal(key, x.shape) for x, key in zip(leaves, keys, strict=True)]
    return nnx.merge(graph, jax.tree.unflatten(tree, leaves))


def random_sequences(seed: int = 0, batch: int = 3, steps: int = 5) -> Sequences:
    rng = np.random.default_rng(seed)
    return Sequences(
        tokens_BTL=jnp.asarray(rng.integers(0, 8, (batch, steps + 1, 6)), jnp.int32),
        action_BT=jnp.asarray(rng.integers(0, 3, (batch, steps)), jnp.int32),
        reward_BT=jnp.asarray(rng.choice([-0.1, 0.0, 0.9, 1.0], (batch, steps)), jnp.float32),
        terminated_BT=jnp.asarray(rng.random((batch, steps)) < 0.2),
    )
