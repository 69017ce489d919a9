"""Frames as rows of flattened patches, and back."""

from __future__ import annotations

import jax


def patch_grid(shape: tuple[int, ...], patch: tuple[int, int]) -> tuple[int, int]:
    """(rows, columns) of patches in a frame of `shape` (H, W, C). ValueError where they do not fill it exactly."""
    (height, width, _), (h, w) = shape, patch
    if height % h or width % w:
        raise ValueError(f"patches of {h}x{w} do not fill a frame of {height}x{width}")
    return height // h, width // w


def split_patches(observation: jax.Array, patch: tuple[int, int]) -> jax.Array:
    """[..., H, W, C] as [..., L, h*w*C]: patches row by row, each flattened row by row."""
    *lead, height, width, channels = observation.shape
    (h, w), (rows, columns) = patch, patch_grid((height, width, channels), patch)
    cells = observation.reshape(*lead, rows, h, columns, w, channels).swapaxes(-4, -3)
    return cells.reshape(*lead, rows * columns, h * w * channels)


def join_patches(patches: jax.Array, shape: tuple[int, ...], patch: tuple[int, int]) -> jax.Array:
    """The inverse of `split_patches`: [..., L, h*w*C] as frames [..., H, W, C] of `shape`."""
    *lead, _, _ = patches.shape
    (h, w), (rows, columns) = patch, patch_grid(shape, patch)
    cells = patches.reshape(*lead, rows, columns, h, w, shape[-1]).swapaxes(-4, -3)
    return cells.reshape(*lead, *shape)
