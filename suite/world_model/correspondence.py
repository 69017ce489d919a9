"""The correspondence head: the next frame's tokens are copied from where they stand in this one, or made new.

For place j of the next frame the sources are the tokens of this frame in the square of side 2r + 1 around j. With g the
softmax of 1 + S gates, of which sources outside the frame have none,

    p(next token at j = k) = g_0 softmax(logits)_k + sum over sources s of g_s [token at s = k].

A mixture as in pointer-generator networks (See et al. 2017). Not the paper's.
Shapes: L tokens of a frame, S sources of each, K codes.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

OUTSIDE = -1  # a code that no token has


def neighbourhood(x: jax.Array, grid: tuple[int, int], radius: int, axis: int, fill: float = 0) -> jax.Array:
    """What stands around each place: [..., L, ...] to [..., L, S, ...], row by row; `fill` outside the frame.

    Args:
      x: something of each of the L = rows * columns places, along `axis`, which is not negative.
      grid: (rows, columns).
      radius: r; S = (2r + 1) ** 2.
      axis: that of the places.
      fill: what stands outside.
    """
    rows, columns = grid
    if not radius:
        return jnp.expand_dims(x, axis + 1)
    x = x.reshape(*x.shape[:axis], rows, columns, *x.shape[axis + 1 :])
    width = [(0, 0)] * axis + [(radius, radius)] * 2 + [(0, 0)] * (x.ndim - axis - 2)
    padded = jnp.pad(x, width, constant_values=fill)
    shifted = [
        jax.lax.slice_in_dim(jax.lax.slice_in_dim(padded, i, i + rows, axis=axis), j, j + columns, axis=axis + 1)
        for i in range(2 * radius + 1)
        for j in range(2 * radius + 1)
    ]
    x = jnp.stack(shifted, axis=axis + 2)
    return x.reshape(*x.shape[:axis], rows * columns, *x.shape[axis + 2 :])


def inside(grid: tuple[int, int], radius: int) -> np.ndarray:
    """Bool [L, S]: whether a source stands within the frame."""
    row_L, column_L = np.divmod(np.arange(grid[0] * grid[1]), grid[1])
    offset = np.arange(-radius, radius + 1)
    row_LR, column_LR = row_L[:, None] + offset, column_L[:, None] + offset
    rows, columns = ((x >= 0) & (x < size) for x, size in ((row_LR, grid[0]), (column_LR, grid[1])))
    return (rows[:, :, None] & columns[:, None, :]).reshape(len(row_L), -1)


def mixture_loss(
    logits: jax.Array, log_gate: jax.Array, source: jax.Array, target: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """-log p of each target, in nats; whether no code is likelier (0 or 1); and the share of p's weight that is copied.

    Args:
      logits: float32 [..., L, K], of codes made new.
      log_gate: float32 [..., L, 1 + S], normalised, -inf outside the frame.
      source: int32 [..., L, S], this frame's tokens, `OUTSIDE` outside.
      target: int32 [..., L].
    """
    # Masked sums instead of gathers: their gradient needs no scatter.
    index = jax.lax.broadcasted_iota(target.dtype, logits.shape, logits.ndim - 1)
    log_total = jax.nn.logsumexp(logits, axis=-1)
    new = jnp.where(index == target[..., None], logits, 0).sum(-1) - log_total + log_gate[..., 0]
    copied = jnp.where(source == target[..., None], log_gate[..., 1:], -jnp.inf)
    log_probability = jax.nn.logsumexp(jnp.concatenate([new[..., None], copied], axis=-1), axis=-1)
    # The likeliest code is either a source's or the one that is likeliest to be made new.
    logits, log_gate = jax.lax.stop_gradient((logits, log_gate))
    gate, log_total = jnp.exp(log_gate), jax.lax.stop_gradient(log_total)
    made = jnp.exp(jnp.take_along_axis(logits, jnp.maximum(source, 0), axis=-1) - log_total[..., None])
    same = source[..., :, None] == source[..., None, :]
    of_source = gate[..., :1] * made + jnp.where(same, gate[..., None, 1:], 0).sum(-1)
    best_source = jnp.where(source == OUTSIDE, 0, of_source).max(-1)
    best = jnp.maximum(best_source, gate[..., 0] * jnp.exp(logits.max(-1) - log_total))
    correct = jnp.exp(jax.lax.stop_gradient(log_probability)) >= best * (1 - 1e-5)
    return -log_probability, correct.astype(jnp.float32), 1 - gate[..., 0]


def mixture_odds(made: jax.Array, log_gate: jax.Array, source: jax.Array) -> jax.Array:
    """p, float32 [..., L, K]: `made` are the probabilities of codes made new; the rest as for `mixture_loss`."""
    gate, codes = jnp.exp(log_gate), made.shape[-1]
    copied = jnp.zeros_like(made)
    for s in range(source.shape[-1]):
        copied += gate[..., 1 + s, None] * jax.nn.one_hot(source[..., s], codes, dtype=made.dtype)
    return gate[..., :1] * made + copied
