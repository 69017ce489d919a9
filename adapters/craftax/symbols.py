"""What a frame of Craftax-classic shows, as symbols: the ground truth for imagined frames (Section 4.4).

R = 145 symbols with values in 0..16 (fidelity note 33), chosen so that each can be read off the frame's pixels:

- 63 blocks, one per tile of the 7 x 9 view, row by row: the number of craftax's `BlockType`. Beyond the edge of the
  world it is 1, what the gray tile there stands for. 0, which no world has, where the night hides the tile.
- 63 creatures on the same tiles: 0 none, 1 the player, 2 zombie, 3 cow, 4 skeleton, 5 arrow; where several share a
  tile, the one drawn last. 0 where the night hides the tile.
- 16 counts, 0..9: health, food, drink and energy, then the items, in the order of the inventory's slots.
- where the player faces: 1 left, 2 right, 3 up, 4 down; 0 while asleep, when he lies.
- 1 while asleep.
- 0 at night, 1 at dusk and dawn, 2 by day.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from adapters.craftax.classic_renderer import (
    CENTER,
    COLUMNS,
    ITEMS,
    MARGIN,
    NEEDS,
    ROWS,
    TILE,
    VIEW,
    view_darkness,
)
from adapters.craftax.tiles import OUT_OF_BOUNDS

VALUES = 17
BLANK = 0  # a tile that the night hides, and a tile without a creature
PLAYER, ZOMBIE, COW, SKELETON, ARROW = range(1, 6)  # ascending in the order of drawing
DAYLIGHTS = 2
# The share of noise in a tile's pixels from which its content cannot be told any more.
HIDING_NOISE = 0.6


def classic_symbols(state: Any, hiding_noise: float = HIDING_NOISE) -> jax.Array:
    """The symbols of the frame that craftax's `EnvState` is drawn as: int32 [145] in [0, 17).

    Args:
      state: of one environment.
      hiding_noise: tiles of which the night's noise makes up more than this share are blank; 1: none is.
    """
    padded = jnp.pad(state.map, MARGIN, constant_values=OUT_OF_BOUNDS)
    corner = state.player_position - CENTER
    blocks = jax.lax.dynamic_slice(padded, corner + MARGIN, VIEW)
    noise = jnp.maximum(1 - 2 * state.light_level, 0.0) * _tile_darkness()
    hidden = noise > hiding_noise

    counts = [getattr(state, f"player_{need}") for need in NEEDS] + [getattr(state.inventory, item) for item in ITEMS]
    asleep = jnp.asarray(state.is_sleeping)
    facing = jnp.where(asleep, 0, state.player_direction)
    others = [*counts, facing, asleep, jnp.round(DAYLIGHTS * state.light_level)]
    return jnp.concatenate(
        [
            jnp.where(hidden, BLANK, blocks).astype(jnp.int32).reshape(-1),
            jnp.where(hidden, BLANK, _creatures(state, corner)).reshape(-1),
            jnp.stack([jnp.asarray(value).astype(jnp.int32) for value in others]),
        ]
    )


def _creatures(state: Any, corner: jax.Array) -> jax.Array:
    """int32 [7, 9]: who is seen on each tile of the view whose upper left one is `corner`."""
    groups = [(state.zombies, ZOMBIE), (state.cows, COW), (state.skeletons, SKELETON), (state.arrows, ARROW)]
    tiles = jnp.zeros(VIEW, jnp.int32).at[CENTER[0], CENTER[1]].set(PLAYER)
    for mobs, symbol in groups:
        at = mobs.position - corner[None]
        seen = mobs.mask & ((at >= 0) & (at < np.array([VIEW]))).all(axis=-1)
        tiles = tiles.at[jnp.where(seen, at[:, 0], ROWS), at[:, 1]].max(symbol, mode="drop")
    return tiles


def _tile_darkness() -> np.ndarray:
    """How far each tile of the view lies in the night's noise, float32 [7, 9]: 0 for the player's, nearly 1 outside."""
    return view_darkness().reshape(ROWS, TILE, COLUMNS, TILE).mean(axis=(1, 3))
