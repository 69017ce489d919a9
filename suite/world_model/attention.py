"""Attention between the blocks of a token stream, and where its tokens stand.

A block is one time step: L tokens and an action. Shapes: S = T * block tokens, N heads of width H.
"""

from __future__ import annotations

import functools
import math
from typing import Literal

import jax
import jax.numpy as jnp

from suite.nn.dropout import dropout
from suite.runtime import layout

GROUPS = 10


def causal_attention(
    query_BSNH: jax.Array,
    key_BSNH: jax.Array,
    value_BSNH: jax.Array,
    *,
    block: int,
    unit: int | None = None,
    groups: int = GROUPS,
    dropout_rate: float = 0.0,
    dropout_key: jax.Array | None = None,
) -> jax.Array:
    """Attention of every token to its whole own unit and all earlier ones.

    The block as the unit gives the block-causal mask (Section 3.6, fidelity note 18), a single token the usual one.

    Another kernel for training replaces this one function, as `suite.nn.fused_attention` does; dreams use
    `cached_attention`. Here the queries are cut into `groups` runs of whole blocks, each of
    which sees a static prefix of the keys: with a run for each block nothing that the first mask forbids is computed.
    The backward pass recomputes the weights: S * S of them are not kept.

    Args:
      query_BSNH, key_BSNH, value_BSNH: [B, S, N, H], S a multiple of `block`.
      block: tokens per block.
      unit: tokens that see one another: 1, or `block` (None).
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
        key = None if dropout_key is None else jax.random.fold_in(dropout_key, index)
        queries, seen = slice(start * block, stop * block), slice(0, stop * block)
        run = query_BSNH[:, queries], key_BSNH[:, seen], value_BSNH[:, seen], key
        outputs.append(_attend_run(*run, start * block, unit or block, dropout_rate))
    return jnp.concatenate(outputs, axis=1)


def held_tokens(seen: jax.Array, slots: int) -> jax.Array:
    """Which token each slot of a cache holds, int32 [S], after `seen` tokens; negative where it holds none yet.

    Token n stands in slot n modulo `slots`, so that a full cache holds the latest ones.
    """
    last = seen - 1
    return last - (last - jnp.arange(slots)) % slots


def cached_attention(
    query_BQNH: jax.Array, key_BNSH: jax.Array, value_BNSH: jax.Array, held_S: jax.Array, last_Q: jax.Array
) -> jax.Array:
    """Attention of new queries to the cached keys and values, each up to token `last_Q` (int32) and with it.

    Keys and values lead with the heads, as the products read them: nothing of the cache's size is moved. `held_S` says
    which token each slot holds (`held_tokens`).
    """
    visible_QS = (held_S >= 0)[None] & (held_S[None] <= last_Q[:, None])
    if query_BQNH.shape[1] == 1:
        return attend_cached(query_BQNH, key_BNSH, value_BNSH, visible_QS)
    # A CPU's caches hold the scores of one stream, not those of all: one after the other is twice as fast and more.
    in_turn = layout.per_device(_attend_cached_in_turn, (0, 0, 0, None), 0)
    return jax.lax.platform_dependent(query_BQNH, key_BNSH, value_BNSH, visible_QS, cpu=in_turn, default=attend_cached)


def attend_cached(query_BQNH, key_BNSH, value_BNSH, visible_QS) -> jax.Array:
    """`cached_attention` of all streams at once, as on devices other than a CPU."""
    mixed_BNQH, _ = _attend(query_BQNH.swapaxes(1, 2), key_BNSH, value_BNSH, visible_QS)
    return mixed_BNQH.swapaxes(1, 2)


def _attend_cached_in_turn(query_BQNH, key_BNSH, value_BNSH, visible_QS) -> jax.Array:
    def attend(stream: tuple[jax.Array, ...]) -> jax.Array:
        query, key, value = (x[None] for x in stream)
        return attend_cached(query, key, value, visible_QS)[0]

    return jax.lax.map(attend, (query_BQNH, key_BNSH, value_BNSH))


# Differentiated by hand, for the gradient needs neither the softmax's reductions nor anything of S * S once more:
# with p the weights, o the output and dp the gradient of p, that of the scores is p * (dp - <do, o>).
@functools.partial(jax.custom_vjp, nondiff_argnums=(4, 5, 6))
def _attend_run(query, key, value, dropout_key, first: int, unit: int, rate: float) -> jax.Array:
    """Attention of a run of whole blocks, whose first query is token `first`, to everything up to its end."""
    return _run_forward(query, key, value, dropout_key, first, unit, rate)[0]


def _run_forward(query, key, value, dropout_key, first: int, unit: int, rate: float):
    # Heads before tokens: on a CPU the products are several times faster so.
    query_BNQH, key_BNSH, value_BNSH = (x.swapaxes(1, 2) for x in (query, key, value))
    visible_QS = _visible(query.shape[1], key.shape[1], first, unit)
    mixed_BNQH, log_total_BNQ1 = _attend(query_BNQH, key_BNSH, value_BNSH, visible_QS, rate, dropout_key)
    saved = query_BNQH, key_BNSH, value_BNSH, dropout_key, mixed_BNQH, log_total_BNQ1
    return mixed_BNQH.swapaxes(1, 2), saved


def _run_backward(first: int, unit: int, rate: float, saved, grad):
    query_BNQH, key_BNSH, value_BNSH, dropout_key, mixed_BNQH, log_total_BNQ1 = saved
    grad_BNQH, dtype = grad.swapaxes(1, 2), grad.dtype
    scale = 1 / math.sqrt(query_BNQH.shape[-1])
    score_BNQS = _scores(query_BNQH * scale, key_BNSH, _visible(query_BNQH.shape[2], key_BNSH.shape[2], first, unit))
    weight_BNQS = jnp.exp(score_BNQS - log_total_BNQ1)
    dropped_BNQS = dropout(weight_BNQS, rate, dropout_key).astype(dtype)
    grad_value_BNHS = _product("bnqh,bnqs->bnhs", grad_BNQH, dropped_BNQS)  # of this shape: a CPU's fast path
    grad_weight_BNQS = dropout(_product("bnqh,bnsh->bnqs", grad_BNQH, value_BNSH), rate, dropout_key)
    along_BNQ1 = (grad_BNQH.astype(jnp.float32) * mixed_BNQH.astype(jnp.float32)).sum(-1, keepdims=True)
    grad_score_BNQS = (weight_BNQS * (grad_weight_BNQS - along_BNQ1)).astype(dtype)
    grad_query_BNQH = _product("bnqs,bnsh->bnqh", grad_score_BNQS, key_BNSH) * scale
    grad_key_BNHS = _product("bnqh,bnqs->bnhs", query_BNQH * scale, grad_score_BNQS)
    grads = (grad_query_BNQH, grad_key_BNHS.swapaxes(2, 3), grad_value_BNHS.swapaxes(2, 3))
    return *(x.astype(dtype).swapaxes(1, 2) for x in grads), None


_attend_run.defvjp(_run_forward, _run_backward)


def _attend(
    query_BNQH, key_BNSH, value_BNSH, visible_QS, rate: float = 0.0, dropout_key=None
) -> tuple[jax.Array, jax.Array]:
    """The mixed values [B, N, Q, H], and the logarithm of the softmax's denominator [B, N, Q, 1]."""
    # The weights are divided by their sum after the product with the values, one pass fewer over the largest array.
    dtype = value_BNSH.dtype
    score_BNQS = _scores(query_BNQH / math.sqrt(query_BNQH.shape[-1]), key_BNSH, visible_QS)
    largest_BNQ1 = score_BNQS.max(-1, keepdims=True)
    weight_BNQS = jnp.exp(score_BNQS - largest_BNQ1)
    # A product: on a CPU, row sums are several times slower.
    total_BNQ1 = jnp.dot(weight_BNQS, jnp.ones((weight_BNQS.shape[-1], 1)))
    mixed_BNQH = _product("bnqs,bnsh->bnqh", dropout(weight_BNQS, rate, dropout_key).astype(dtype), value_BNSH)
    return (mixed_BNQH / total_BNQ1).astype(dtype), largest_BNQ1 + jnp.log(total_BNQ1)


def _scores(query_BNQH: jax.Array, key_BNSH: jax.Array, visible_QS: jax.Array | None) -> jax.Array:
    score_BNQS = _product("bnqh,bnsh->bnqs", query_BNQH, key_BNSH)
    return score_BNQS if visible_QS is None else jnp.where(visible_QS[None, None], score_BNQS, -jnp.inf)


def _visible(queries: int, keys: int, first: int, unit: int) -> jax.Array | None:
    """Bool [Q, S]: which keys each query of a run sees; None: all of them."""
    if queries == unit:
        return None
    return ((first + jnp.arange(queries)) // unit)[:, None] >= (jnp.arange(keys) // unit)[None, :]


def _product(spec: str, left: jax.Array, right: jax.Array) -> jax.Array:
    return jnp.einsum(spec, left, right, preferred_element_type=jnp.float32)


def token_positions(
    kind: Literal["flat", "grid"], index_S: jax.Array, block: int, grid: tuple[int, int] | None
) -> jax.Array:
    """Where the tokens of index `index_S` in the stream stand: int32 [S, axes] (fidelity note 20).

    "flat": one axis, the token's index in the stream. "grid": (time, row, column), the action one step off the
    lower right corner; needs `grid` = (rows, columns) with rows * columns = block - 1, else ValueError.
    """
    if kind == "flat":
        return index_S[:, None]
    if grid is None or math.prod(grid) != block - 1:
        raise ValueError(f"grid positions need the rows and columns of {block - 1} tokens, not {grid}")
    rows, columns = grid
    time_S, token_S = index_S // block, index_S % block
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
