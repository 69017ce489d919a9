"""Frames as rows of flattened patches, and back.

Patches start at the upper left corner. Where they do not fill the frame it is first made larger at the bottom and on
the right, its edge pixels repeated (fidelity note 37), and what comes back is cropped.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp


def patch_grid(shape: tuple[int, ...], patch: tuple[int, int]) -> tuple[int, int]:
    """(rows, columns) of patches in a frame of `shape` (H, W, C). ValueError where a patch is larger than the frame."""
    (height, width, _), (h, w) = shape, patch
    if h > height or w > width:
        raise ValueError(f"patches of {h}x{w} are larger than a frame of {height}x{width}")
    return math.ceil(height / h), math.ceil(width / w)


def split_patches(observation: jax.Array, patch: tuple[int, int]) -> jax.Array:
    """[..., H, W, C] as [..., L, h*w*C]: patches row by row, each flattened row by row."""
    *lead, height, width, channels = observation.shape
    (h, w), (rows, columns) = patch, patch_grid((height, width, channels), patch)
    if (missing := (rows * h - height, columns * w - width)) != (0, 0):
        widths = [(0, 0)] * len(lead) + [(0, missing[0]), (0, missing[1]), (0, 0)]
        observation = jnp.pad(observation, widths, mode="edge")
    cells = observation.reshape(*lead, rows, h, columns, w, channels).swapaxes(-4, -3)
    return cells.reshape(*lead, rows * columns, h * w * channels)


def join_patches(patches: jax.Array, shape: tuple[int, ...], patch: tuple[int, int]) -> jax.Array:
    """The inverse of `split_patches`: [..., L, h*w*C] as frames [..., H, W, C] of `shape`."""
    *lead, _, _ = patches.shape
    (h, w), (rows, columns) = patch, patch_grid(shape, patch)
    cells = patches.reshape(*lead, rows, columns, h, w, shape[-1]).swapaxes(-4, -3)
    return cells.reshape(*lead, rows * h, columns * w, shape[-1])[..., : shape[0], : shape[1], :]
