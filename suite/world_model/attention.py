"""Attention between the blocks of a token stream, and where its tokens stand.

A block is one time step: L tokens and an action. Shapes: S = T * block tokens, N heads of width H.
"""

from __future__ import annotations

import functools
import math
from typing import Literal

import jax
import jax.numpy as jnp

from suite.world_model.dropout import dropout

GROUPS = 5


def block_causal_attention(
    query_BSNH: jax.Array,
    key_BSNH: jax.Array,
    value_BSNH: jax.Array,
    *,
    block: int,
    groups: int = GROUPS,
    dropout_rate: float = 0.0,
    dropout_key: jax.Array | None = None,
) -> jax.Array:
    """Attention of every token to its whole own block and all earlier ones (Section 3.6, fidelity note 18).

    Another kernel replaces this one function. Here the queries are cut into `groups` runs of whole blocks, each of
    which sees a static prefix of the keys, so that about half of what the mask forbids and more is never computed.
    The backward pass recomputes the weights: S * S of them are not kept.

    Args:
      query_BSNH, key_BSNH, value_BSNH: [B, S, N, H], S a multiple of `block`.
      block: tokens per block.
      groups: runs of queries; 1 computes the whole square.
      dropout_rate: of the attention weights, where `dropout_key` is not None.

    Returns:
      [B, S, N, H] in the dtype of the values; the softmax is float32.
    """
    blocks = query_BSNH.shape[1] // block
    size = math.ceil(blocks / groups)
    outputs = []
    for index, start in enumerate(range(0, blocks, size)):
        stop = min(start + size, blocks)
        attend = functools.partial(_attend_run, first=start * block, block=block, dropout_rate=dropout_rate)
        key = None if dropout_key is None else jax.random.fold_in(dropout_key, index)
        seen = slice(0, stop * block)
        outputs.append(
            jax.checkpoint(attend)(
                query_BSNH[:, start * block : stop * block], key_BSNH[:, seen], value_BSNH[:, seen], key
            )
        )
    return jnp.concatenate(outputs, axis=1)


def cached_attention(
    query_BQNH: jax.Array, key_BSNH: jax.Array, value_BSNH: jax.Array, filled: jax.Array
) -> jax.Array:
    """Attention of one block's queries to the first `filled` (int32 scalar) of the cached keys and values."""
    visible_QS = jnp.broadcast_to(jnp.arange(key_BSNH.shape[1]) < filled, (query_BQNH.shape[1], key_BSNH.shape[1]))
    return _attend(query_BQNH, key_BSNH, value_BSNH, visible_QS)


def _attend_run(query, key, value, dropout_key, *, first: int, block: int, dropout_rate: float) -> jax.Array:
    """Attention of a run of whole blocks, whose first query is token `first`, to everything up to its end."""
    visible_QS = None
    if query.shape[1] > block:
        query_block = (first + jnp.arange(query.shape[1])) // block
        key_block = jnp.arange(key.shape[1]) // block
        visible_QS = query_block[:, None] >= key_block[None, :]
    return _attend(query, key, value, visible_QS, dropout_rate, dropout_key)


def _attend(query, key, value, visible_QS, dropout_rate: float = 0.0, dropout_key=None) -> jax.Array:
    # Heads before tokens: on a CPU the products are several times faster so. The weights are divided by their sum
    # after the product with the values, which is one pass fewer over the largest array.
    query_BNQH, key_BNSH, value_BNSH = (x.swapaxes(1, 2) for x in (query / math.sqrt(query.shape[-1]), key, value))
    score_BNQS = jnp.einsum("bnqh,bnsh->bnqs", query_BNQH, key_BNSH, preferred_element_type=jnp.float32)
    if visible_QS is not None:
        score_BNQS = jnp.where(visible_QS[None, None], score_BNQS, -jnp.inf)
    largest_BNQ1 = jax.lax.stop_gradient(score_BNQS.max(-1, keepdims=True))
    weight_BNQS = jnp.exp(score_BNQS - largest_BNQ1)
    total_BNQ1 = weight_BNQS.sum(-1, keepdims=True)
    weight_BNQS = dropout(weight_BNQS, dropout_rate, dropout_key).astype(value.dtype)
    mixed_BNQH = jnp.einsum("bnqs,bnsh->bnqh", weight_BNQS, value_BNSH, preferred_element_type=jnp.float32)
    return (mixed_BNQH / total_BNQ1).astype(value.dtype).swapaxes(1, 2)


def block_positions(
    kind: Literal["flat", "grid"], time_T: jax.Array, block: int, grid: tuple[int, int] | None
) -> jax.Array:
    """Where the tokens of the blocks at times `time_T` stand: int32 [T * block, axes] (fidelity note 20).

    "flat": one axis, the token's index in the stream. "grid": (time, row, column), the action one step off the
    lower right corner; needs `grid` = (rows, columns) with rows * columns = block - 1, else ValueError.
    """
    token_S = jnp.tile(jnp.arange(block), time_T.shape[0])
    time_S = jnp.repeat(time_T, block)
    if kind == "flat":
        return (time_S * block + token_S)[:, None]
    if grid is None or math.prod(grid) != block - 1:
        raise ValueError(f"grid positions need the rows and columns of {block - 1} tokens, not {grid}")
    rows, columns = grid
    action_S = token_S == block - 1
    row_S = jnp.where(action_S, rows, token_S // columns)
    column_S = jnp.where(action_S, columns, token_S % columns)
    return jnp.stack([time_S, row_S, column_S], axis=-1)


def rope(x_BSNH: jax.Array, position_SA: jax.Array) -> jax.Array:
    """Rotary position embedding of queries or keys (Su et al. 2021), over any number of axes A.

    The H/2 pairs of features are dealt to the axes, the later ones H/2 // A each, the first the rest; every axis has
    its own geometric ladder of frequencies, from 1 down to 1/10000. Rotations are float32, the dtype stays.
    """
    pairs, axes = x_BSNH.shape[-1] // 2, position_SA.shape[-1]
    counts = [pairs - (axes - 1) * (pairs // axes)] + [pairs // axes] * (axes - 1)
    angles = []
    for axis, count in enumerate(counts):
        frequency = 10_000.0 ** (-jnp.arange(count, dtype=jnp.float32) / count)
        angles.append(position_SA[:, axis, None].astype(jnp.float32) * frequency[None])
    angle = jnp.concatenate(angles, axis=-1)[None, :, None]
    left, right = jnp.split(x_BSNH.astype(jnp.float32), 2, axis=-1)
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    return jnp.concatenate([left * cos - right * sin, left * sin + right * cos], axis=-1).astype(x_BSNH.dtype)
