"""Attention between units of a stream as one fused kernel for GPUs, in the way of FlashAttention (Dao et al. 2022).

The plain way (`suite.world_model.attention`) writes the scores of all pairs of tokens to memory; this keeps a tile of
them at a time in a multiprocessor, and computes no tile that the mask forbids. It is written in Pallas, which compiles
to Triton. Where there is no GPU its steps are interpreted, which is slow, and by which tests compare it with the plain
way.

Shapes: G streams times heads, S tokens padded to whole tiles, H numbers of a head.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton

from suite.runtime import layout

TILE = 64  # queries, and keys, at a time
TRITON = triton.CompilerParams(num_warps=4, num_stages=2)


def fused_attention(
    query_BSNH: jax.Array,
    key_BSNH: jax.Array,
    value_BSNH: jax.Array,
    *,
    unit: int,
    dropout_rate: float = 0.0,
    dropout_key: jax.Array | None = None,
    interpret: bool | None = None,
) -> jax.Array:
    """Attention of every token to its whole own unit and all earlier ones; differentiable.

    Args:
      query_BSNH, key_BSNH, value_BSNH: [B, S, N, H], S whole units; H a power of two, 16 at least.
      unit: tokens that see one another.
      dropout_rate: of the attention weights, where `dropout_key` is not None.
      interpret: run the kernels' steps as plain JAX; None: on a CPU.

    Returns:
      [B, S, N, H] in the dtype of the values; the softmax is float32.

    Raises:
      ValueError: a width of heads that the kernel cannot multiply.
    """
    _, length, heads, width = query_BSNH.shape
    if width < 16 or width & (width - 1):
        raise ValueError(f"the fused kernel needs heads of width 16, 32, 64 ..., not {width}")
    rate = 0.0 if dropout_key is None else dropout_rate
    bits = jnp.zeros(2, jnp.uint32) if dropout_key is None else jax.random.bits(dropout_key, (2,), jnp.uint32)
    padding, interpret = -length % TILE, jax.default_backend() == "cpu" if interpret is None else interpret

    def tiled(x_BSNH: jax.Array) -> jax.Array:
        x_GSH = x_BSNH.swapaxes(1, 2).reshape(-1, length, width)
        return jnp.pad(x_GSH, ((0, 0), (0, padding), (0, 0)))

    def attend(query_BSNH: jax.Array, key_BSNH: jax.Array, value_BSNH: jax.Array, seed_1: jax.Array) -> jax.Array:
        mixed_GSH = _attention(*map(tiled, (query_BSNH, key_BSNH, value_BSNH)), seed_1, unit, rate, interpret)
        return mixed_GSH[:, :length].reshape(-1, heads, length, width).swapaxes(1, 2)

    if layout.devices() == 1:
        return attend(query_BSNH, key_BSNH, value_BSNH, bits[:1])

    def own(query_BSNH: jax.Array, key_BSNH: jax.Array, value_BSNH: jax.Array, seed_1: jax.Array) -> jax.Array:
        # So that a stream drops what it drops on one device.
        first = layout.row_of_all(jnp.zeros((), jnp.int32), len(query_BSNH) * heads)
        return attend(query_BSNH, key_BSNH, value_BSNH, seed_1 + first.astype(jnp.uint32))

    return layout.per_device(own, (0, 0, 0, None), 0)(query_BSNH, key_BSNH, value_BSNH, bits[:1])


@functools.partial(jax.custom_vjp, nondiff_argnums=(4, 5, 6))
def _attention(query_GSH, key_GSH, value_GSH, seed_1, unit: int, rate: float, interpret: bool) -> jax.Array:
    return _forward(query_GSH, key_GSH, value_GSH, seed_1, unit, rate, interpret)[0]


def _forward(query_GSH, key_GSH, value_GSH, seed_1, unit: int, rate: float, interpret: bool):
    streams, length, width = query_GSH.shape
    kernel = functools.partial(_forward_kernel, unit=unit, rate=rate)
    mixed_GSH, log_total_GS = pl.pallas_call(
        kernel,
        grid=(streams, length // TILE),
        in_specs=[_tile(width), _whole(length, width), _whole(length, width), _SEED],
        out_specs=[_tile(width), _tile()],
        out_shape=[
            jax.ShapeDtypeStruct(query_GSH.shape, value_GSH.dtype),
            jax.ShapeDtypeStruct((streams, length), jnp.float32),
        ],
        interpret=interpret,
        compiler_params=TRITON,
    )(query_GSH, key_GSH, value_GSH, seed_1)
    return mixed_GSH, (query_GSH, key_GSH, value_GSH, seed_1, mixed_GSH, log_total_GS)


def _backward(unit: int, rate: float, interpret: bool, saved: Any, grad_GSH: jax.Array):
    query_GSH, key_GSH, value_GSH, seed_1, mixed_GSH, log_total_GS = saved
    streams, length, width = query_GSH.shape
    along_GS = (grad_GSH.astype(jnp.float32) * mixed_GSH.astype(jnp.float32)).sum(-1)
    operands = (query_GSH, key_GSH, value_GSH, seed_1, grad_GSH, log_total_GS, along_GS)
    whole, one = _whole(length, width), _whole(length)
    grad_query_GSH = pl.pallas_call(
        functools.partial(_query_kernel, unit=unit, rate=rate),
        grid=(streams, length // TILE),
        in_specs=[_tile(width), whole, whole, _SEED, _tile(width), _tile(), _tile()],
        out_specs=_tile(width),
        out_shape=jax.ShapeDtypeStruct(query_GSH.shape, query_GSH.dtype),
        interpret=interpret,
        compiler_params=TRITON,
    )(*operands)
    grad_key_GSH, grad_value_GSH = pl.pallas_call(
        functools.partial(_key_value_kernel, unit=unit, rate=rate, tiles=length // TILE),
        grid=(streams, length // TILE),
        in_specs=[whole, _tile(width), _tile(width), _SEED, whole, one, one],
        out_specs=[_tile(width), _tile(width)],
        out_shape=[
            jax.ShapeDtypeStruct(key_GSH.shape, key_GSH.dtype),
            jax.ShapeDtypeStruct(value_GSH.shape, value_GSH.dtype),
        ],
        interpret=interpret,
        compiler_params=TRITON,
    )(*operands)
    return grad_query_GSH, grad_key_GSH, grad_value_GSH, None


_attention.defvjp(_forward, _backward)

_SEED = pl.BlockSpec((1,), lambda stream, tile: (0,))


def _tile(*width: int) -> pl.BlockSpec:
    """The program's own tile of an array [G, S, H] or [G, S]."""
    return pl.BlockSpec((None, TILE, *width), lambda stream, tile: (stream, tile, *(0 for _ in width)))


def _whole(length: int, *width: int) -> pl.BlockSpec:
    """All tokens of the program's own stream and head."""
    return pl.BlockSpec((None, length, *width), lambda stream, tile: (stream, 0, *(0 for _ in width)))


def _forward_kernel(query_ref, key_ref, value_ref, seed_ref, mixed_ref, log_total_ref, *, unit: int, rate: float):
    """One tile of queries against all tiles of keys that one of them sees, the softmax as it goes along."""
    query_QH = query_ref[...]
    index_Q = pl.program_id(1) * TILE + jnp.arange(TILE)
    width, seed = query_QH.shape[-1], _own_seed(seed_ref)

    def attend(j, carry):
        largest_Q, total_Q, mixed_QH = carry
        key_KH, value_KH = key_ref[pl.ds(j * TILE, TILE), :], value_ref[pl.ds(j * TILE, TILE), :]
        index_K = j * TILE + jnp.arange(TILE)
        score_QK = _scores(query_QH, key_KH, index_Q, index_K, unit)
        larger_Q = jnp.maximum(largest_Q, score_QK.max(1))
        weight_QK = jnp.exp(score_QK - larger_Q[:, None])
        shrink_Q = jnp.exp(largest_Q - larger_Q)
        total_Q = total_Q * shrink_Q + weight_QK.sum(1)
        weight_QK *= _kept(seed, index_Q, index_K, rate)
        mixed_QH = mixed_QH * shrink_Q[:, None] + _product(weight_QK.astype(value_KH.dtype), value_KH)
        return larger_Q, total_Q, mixed_QH

    start = (
        jnp.full(TILE, -jnp.inf, jnp.float32),
        jnp.zeros(TILE, jnp.float32),
        jnp.zeros((TILE, width), jnp.float32),
    )
    stop = _seen_tiles(pl.program_id(1), key_ref.shape[0] // TILE, unit)
    largest_Q, total_Q, mixed_QH = jax.lax.fori_loop(0, stop, attend, start)
    mixed_ref[...] = (mixed_QH / total_Q[:, None]).astype(mixed_ref.dtype)
    log_total_ref[...] = largest_Q + jnp.log(total_Q)


def _query_kernel(
    query_ref, key_ref, value_ref, seed_ref, grad_ref, log_total_ref, along_ref, grad_query_ref, *, unit, rate
):
    """The gradient of one tile of queries."""
    query_QH, grad_QH = query_ref[...], grad_ref[...]
    log_total_Q, along_Q = log_total_ref[...], along_ref[...]
    index_Q, seed = pl.program_id(1) * TILE + jnp.arange(TILE), _own_seed(seed_ref)

    def add(j, total_QH):
        key_KH, value_KH = key_ref[pl.ds(j * TILE, TILE), :], value_ref[pl.ds(j * TILE, TILE), :]
        index_K = j * TILE + jnp.arange(TILE)
        weight_QK = jnp.exp(_scores(query_QH, key_KH, index_Q, index_K, unit) - log_total_Q[:, None])
        grad_weight_QK = _product(grad_QH, value_KH, transposed=True) * _kept(seed, index_Q, index_K, rate)
        grad_score_QK = weight_QK * (grad_weight_QK - along_Q[:, None])
        return total_QH + _product(grad_score_QK.astype(key_KH.dtype), key_KH)

    stop = _seen_tiles(pl.program_id(1), key_ref.shape[0] // TILE, unit)
    total_QH = jax.lax.fori_loop(0, stop, add, jnp.zeros(query_QH.shape, jnp.float32))
    grad_query_ref[...] = (total_QH / math.sqrt(query_QH.shape[-1])).astype(grad_query_ref.dtype)


def _key_value_kernel(
    query_ref,
    key_ref,
    value_ref,
    seed_ref,
    grad_ref,
    log_total_ref,
    along_ref,
    grad_key_ref,
    grad_value_ref,
    *,
    unit: int,
    rate: float,
    tiles: int,
):
    """The gradients of one tile of keys and values, from all tiles of queries that see one of them."""
    key_KH, value_KH = key_ref[...], value_ref[...]
    first = pl.program_id(1) * TILE
    index_K, seed = first + jnp.arange(TILE), _own_seed(seed_ref)

    def add(i, carry):
        grad_key_KH, grad_value_KH = carry
        here = pl.ds(i * TILE, TILE)
        query_QH, grad_QH = query_ref[here, :], grad_ref[here, :]
        index_Q = i * TILE + jnp.arange(TILE)
        weight_QK = jnp.exp(_scores(query_QH, key_KH, index_Q, index_K, unit) - log_total_ref[here][:, None])
        kept_QK = _kept(seed, index_Q, index_K, rate)
        grad_value_KH += _product((weight_QK * kept_QK).T.astype(grad_QH.dtype), grad_QH)
        grad_weight_QK = _product(grad_QH, value_KH, transposed=True) * kept_QK
        grad_score_QK = weight_QK * (grad_weight_QK - along_ref[here][:, None])
        grad_key_KH += _product(grad_score_QK.T.astype(query_QH.dtype), query_QH)
        return grad_key_KH, grad_value_KH

    zeros_KH = jnp.zeros(key_KH.shape, jnp.float32)
    # The first query that sees one of these keys opens the unit that the first of them is in.
    grad_key_KH, grad_value_KH = jax.lax.fori_loop(first // unit * unit // TILE, tiles, add, (zeros_KH, zeros_KH))
    grad_key_ref[...] = (grad_key_KH / math.sqrt(key_KH.shape[-1])).astype(grad_key_ref.dtype)
    grad_value_ref[...] = grad_value_KH.astype(grad_value_ref.dtype)


def _seen_tiles(tile: jax.Array, tiles: int, unit: int) -> jax.Array:
    """How many tiles of keys the queries of a tile see: up to the end of the last one's unit."""
    last = (tile * TILE + TILE - 1) // unit * unit + unit - 1
    return jnp.minimum(last // TILE + 1, tiles)


def _scores(query_QH, key_KH, index_Q, index_K, unit: int) -> jax.Array:
    score_QK = _product(query_QH, key_KH, transposed=True) / math.sqrt(query_QH.shape[-1])
    return jnp.where((index_Q // unit)[:, None] >= (index_K // unit)[None, :], score_QK, -jnp.inf)


def _product(left: jax.Array, right: jax.Array, transposed: bool = False) -> jax.Array:
    """float32, of `right` transposed if so; float32 products in full precision, as on a CPU."""
    contracted = 1 if transposed else 0
    return jax.lax.dot_general(
        left,
        right,
        (((1,), (contracted,)), ((), ())),
        precision=jax.lax.Precision.HIGHEST if left.dtype == jnp.float32 else None,
        preferred_element_type=jnp.float32,
    )


def _own_seed(seed_ref) -> jax.Array:
    """Of the program's own stream and head. Asked for outside of loops, where interpreted kernels can tell."""
    return _hash(seed_ref[0] + pl.program_id(0).astype(jnp.uint32))


def _kept(seed: jax.Array, index_Q: jax.Array, index_K: jax.Array, rate: float) -> jax.Array | float:
    """float32 [Q, K]: 0 where a weight is dropped, else what makes up for those that are.

    A hash of the stream's seed and the pair of tokens, which the backward pass computes again.
    """
    if not rate:
        return 1.0
    query_Q = _hash(seed + index_Q.astype(jnp.uint32))
    bits_QK = _hash(query_Q[:, None] + index_K.astype(jnp.uint32)[None, :])
    return (bits_QK >= jnp.uint32(int(rate * 2**32))).astype(jnp.float32) / (1 - rate)


def _hash(x: jax.Array) -> jax.Array:
    """Well mixed bits of a uint32 (multiplications and shifts, as in MurmurHash3's finaliser)."""
    x = (x ^ (x >> jnp.uint32(16))) * jnp.uint32(0x85EBCA6B)
    x = (x ^ (x >> jnp.uint32(13))) * jnp.uint32(0xC2B2AE35)
    return x ^ (x >> jnp.uint32(16))
