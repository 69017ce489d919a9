"""Draws the frames of Craftax-classic: the pixels of craftax's own renderer, for much less work."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from adapters.craftax.tiles import BLOCKS, GRAY, OUT_OF_BOUNDS, draw, heading, image, pixels, turned, uniform

TILE, ICON, DIGIT, DIGIT_OFFSET = 7, 5, 4, 2  # pixels; an inventory slot is an icon with a digit over its corner
ROWS, COLUMNS = VIEW = (7, 9)  # tiles of the map that are seen, the player in the middle
CENTER = np.array(VIEW, np.int32) // 2
MARGIN = max(VIEW)

# The player's are in the order of the moves left, right, up, down. Four directions of the arrow follow.
CREATURES = ["player-left", "player-right", "player-up", "player-down", "player-sleep", "zombie", "cow", "skeleton"]
ASLEEP, ZOMBIE, COW, SKELETON, ARROW = 4, 5, 6, 7, 8
# The slots of the inventory, row by row; where transparent, the last few are black.
NEEDS = ["health", "food", "drink", "energy"]
ITEMS = [
    "sapling",
    "wood",
    "stone",
    "coal",
    "iron",
    "diamond",
    "wood_pickaxe",
    "stone_pickaxe",
    "iron_pickaxe",
    "wood_sword",
    "stone_sword",
    "iron_sword",
]
CUT_OUT = {"stone_pickaxe", "iron_pickaxe", "wood_sword", "stone_sword", "iron_sword"}

_image = functools.partial(image, "craftax_classic")

NIGHT, SLEEP = np.array([[[0, 16, 64]]], np.float32), np.array([[[0, 0, 16]]], np.float32)


def make_renderer() -> Callable[[Any], jax.Array]:
    """A function from craftax's `EnvState` to its frame: float32 [63, 63, 3] in [0, 255]."""
    blocks = jnp.asarray(_blocks())
    color, alpha = (jnp.asarray(part) for part in _creatures())
    slots = jnp.asarray(_slots())
    darkness = jnp.asarray(view_darkness())

    def render(state: Any) -> jax.Array:
        padded = jnp.pad(state.map, MARGIN, constant_values=OUT_OF_BOUNDS)
        seen = jax.lax.dynamic_slice(padded, state.player_position - CENTER + MARGIN, VIEW)
        tiles = _draw_creatures(blocks[seen], state, color, alpha)
        scene = pixels(tiles)
        scene = _light(scene, state, darkness)

        counts = [getattr(state, f"player_{need}") for need in NEEDS]
        counts += [getattr(state.inventory, item) for item in ITEMS] + [jnp.int32(0)] * 2
        inventory = pixels(slots[np.arange(len(counts)), jnp.stack(counts)].reshape(2, COLUMNS, TILE, TILE, 3))
        return jnp.concatenate([scene, inventory])

    return render


def _draw_creatures(tiles: jax.Array, state: Any, color: jax.Array, alpha: jax.Array) -> jax.Array:
    """Blends the player and the creatures over their tiles, in craftax's order (two may share a tile)."""
    arrows = ARROW + heading(state.arrow_directions)
    player = jnp.where(state.is_sleeping, ASLEEP, state.player_direction - 1)
    groups: list[tuple[Any, Any]] = [
        (state.zombies, ZOMBIE),
        (state.cows, COW),
        (state.skeletons, SKELETON),
        (state.arrows, arrows),
    ]
    which = [player[None]] + [jnp.broadcast_to(sprite, mobs.mask.shape) for mobs, sprite in groups]
    position = [state.player_position[None]] + [mobs.position for mobs, _ in groups]
    alive = [jnp.ones(1, bool)] + [mobs.mask for mobs, _ in groups]

    at = jnp.concatenate(position) - (state.player_position - CENTER)[None]
    return draw(tiles, at, jnp.concatenate(alive), jnp.concatenate(which), color, alpha)


def _light(scene: jax.Array, state: Any, darkness: jax.Array) -> jax.Array:
    """Night: noise toward the edges, less color, a blue tint. Sleep: dark and gray."""
    daylight = state.light_level
    noise = uniform(state.state_rng, scene.shape[:2]) * 95 + 32
    noisy = jnp.maximum(2 * (0.5 - daylight), 0.0) * darkness
    night = (1 - noisy) * scene + noisy * noise[..., None]
    night = 0.4 * night + 0.6 * _luminance(night)
    night = 0.5 * night + 0.5 * NIGHT
    scene = daylight * scene + (1 - daylight) * night
    return jnp.where(state.is_sleeping, 0.5 * _luminance(scene) + 0.5 * SLEEP, scene)


def _luminance(scene: jax.Array) -> jax.Array:
    red, green, blue = jnp.split(scene, 3, axis=-1)
    return 0.299 * red + 0.587 * green + 0.114 * blue


def _blocks() -> np.ndarray:
    """float32 [17, 7, 7, 3]."""
    blocks = np.stack([_image(name, TILE)[..., :3] for name in BLOCKS])
    blocks[OUT_OF_BOUNDS] = GRAY
    return blocks


def _creatures() -> tuple[np.ndarray, np.ndarray]:
    """Colors times opacity [12, 7, 7, 3], and opacity [12, 7, 7, 1]; float32."""
    arrows = turned(_image("arrow-up", TILE))
    images = np.stack([_image(name, TILE) for name in CREATURES] + arrows)
    alpha = images[..., 3:] / np.float32(255)
    return images[..., :3] * alpha, alpha


def _slots() -> np.ndarray:
    """Every inventory slot with every count, float32 [18, 10, 7, 7, 3]; nothing is shown for a count of zero."""
    slots = np.zeros((2 * COLUMNS, 10, TILE, TILE, 3), np.float32)
    digit = slice(DIGIT_OFFSET, DIGIT_OFFSET + DIGIT)
    for slot, name in enumerate(NEEDS + ITEMS):
        icon = _image(name, ICON)
        slots[slot, 1:, :ICON, :ICON] = icon[..., :3] * (icon[..., 3:] == 255 if name in CUT_OUT else 1)
    for count in range(1, 10):
        number = _image(str(count), DIGIT)
        opaque = number[..., 3:] == 255
        slots[: len(NEEDS + ITEMS), count, digit, digit] *= ~opaque
        slots[: len(NEEDS + ITEMS), count, digit, digit] += number[..., :3] * opaque
    return slots


def view_darkness() -> np.ndarray:
    """How much of the night's noise lies over each pixel, float32 [49, 63, 1]: none in the middle."""
    y, x = (np.linspace(-1, 1, tiles * TILE) for tiles in VIEW)
    return (1 - np.exp(-0.5 * (y[:, None] ** 2 + x**2) / 0.5**2))[..., None].astype(np.float32)
