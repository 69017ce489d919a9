"""What the frames of both Craftax games are drawn with: images of the package, tiles, sprites, the night's noise.

craftax adds up one full-screen layer for every kind of block, and first prepares textures, for half a minute or for
three; here tiles are looked up, and the few small images that agents see are read from the package in milliseconds.
"""

from __future__ import annotations

import math
from importlib import resources

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image

# By number of craftax's BlockType, the same in both games. The second, beyond the map's edge, is plain gray.
BLOCKS = [
    "debug_tile",
    "debug_tile",
    "grass",
    "water",
    "stone",
    "tree",
    "wood",
    "path",
    "coal",
    "iron",
    "diamond",
    "table",
    "furnace",
    "sand",
    "lava",
    "plant_on_grass",
    "ripe_plant_on_grass",
]
OUT_OF_BOUNDS, GRAY = 1, 128


def image(game: str, name: str, side: int) -> np.ndarray:
    """An image of the package `craftax.<game>` as float32 [side, side, 4]: red, green, blue, opacity; 0 to 255."""
    file = resources.files(f"craftax.{game}") / "assets" / f"{name}.png"
    with file.open("rb") as stream, Image.open(stream) as picture:
        return np.asarray(picture.convert("RGBA").resize((side, side), Image.Resampling.NEAREST), np.float32)


def turned(up: np.ndarray) -> list[np.ndarray]:
    """The image of something that flies up, as it flies up, down, left and right; see `heading`."""
    down = up[::-1]
    return [up, down, up.swapaxes(0, 1), down.swapaxes(0, 1)]


def heading(direction: jax.Array) -> jax.Array:
    """int32 [...] index into `turned` of directions [..., 2] (down, right)."""
    down, right = direction[..., 0], direction[..., 1]
    return jnp.where((down > 0) | (right > 0), 1, 0) + jnp.where(right != 0, 2, 0)


def draw(
    tiles: jax.Array, at: jax.Array, visible: jax.Array, sprite: jax.Array, color: jax.Array, alpha: jax.Array
) -> jax.Array:
    """Blends sprites over their tiles, one after another (two may share a tile).

    Args:
      tiles: float32 [rows, columns, side, side, 3].
      at: int32 [S, 2], the row and column of each sprite; what lies beyond the view is not drawn.
      visible: bool [S].
      sprite: int32 [S], an index into the next two.
      color: float32 [sprites, side, side, 3], colors times opacity.
      alpha: float32 [sprites, side, side, 1], opacity.
    """
    rows, columns = tiles.shape[:2]
    seen = visible & ((at >= 0) & (at < np.array([[rows, columns]]))).all(axis=-1)
    row = jnp.where(seen, at[:, 0], rows)  # beyond the view, where writes are dropped

    def draw_one(tiles, one):
        row, column, sprite = one
        old = tiles.at[row, column].get(mode="clip")
        return tiles.at[row, column].set(old * (1 - alpha[sprite]) + color[sprite], mode="drop"), None

    return jax.lax.scan(draw_one, tiles, (row, at[:, 1], sprite), unroll=True)[0]


def pixels(tiles: jax.Array) -> jax.Array:
    """[rows, columns, side, side, 3] -> [rows * side, columns * side, 3]."""
    rows, columns, side = tiles.shape[:3]
    return tiles.swapaxes(1, 2).reshape(rows * side, columns * side, 3)


def uniform(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """The float32 numbers in [0, 1) of `jax.random.uniform(key, shape)`, for a threefry key.

    On a CPU, JAX keeps the rounds of the cipher in a loop, and the numbers go through memory between rounds. Written
    out, they are one pass: drawing the night is the largest part of a frame, and this saves half of it.
    """
    first, second = jax.random.key_data(key)
    schedule = first, second, first ^ second ^ np.uint32(0x1BD11BDA)
    low = jnp.arange(math.prod(shape), dtype=jnp.uint32) + second[None]
    high = jnp.broadcast_to(first, low.shape)
    for block in range(5):
        for turn in ((13, 15, 26, 6), (17, 29, 16, 24))[block % 2]:
            high = high + low
            low = high ^ ((low << np.uint32(turn)) | (low >> np.uint32(32 - turn)))
        high = high + schedule[(block + 1) % 3][None]
        low = low + (schedule[(block + 2) % 3] + np.uint32(block + 1))[None]
    bits = (high ^ low) >> np.uint32(9)  # 23 random bits become the fraction of a number in [1, 2)
    return (jax.lax.bitcast_convert_type(bits | np.uint32(0x3F800000), jnp.float32) - 1).reshape(shape)
