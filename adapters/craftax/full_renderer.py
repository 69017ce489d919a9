"""Draws the frames of Craftax (full): the pixels of craftax's own renderer, for much less work."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from adapters.craftax.tiles import BLOCKS, GRAY, OUT_OF_BOUNDS, draw, heading, image, pixels, turned, uniform

TILE, BORDER, DIGIT = 10, 1, 4  # pixels; an inventory slot is an icon within a border, digits over its lower edge
ROWS, COLUMNS = VIEW = (9, 11)  # tiles of the map that are seen, the player in the middle
CENTER = np.array(VIEW, np.int32) // 2

# The blocks that this game adds to the other's; darkness is black.
ALL_BLOCKS = [
    *BLOCKS,
    "wall2",
    "debug_tile",
    "wall_moss",
    "stalagmite",
    "sapphire",
    "ruby",
    "chest",
    "fountain",
    "fire_grass",
    "ice_grass",
    "gravel",
    "fire_tree",
    "ice_shrub",
    "enchantment_table_fire",
    "enchantment_table_ice",
    "necromancer",
    "grave",
    "grave2",
    "grave3",
    "necromancer_vulnerable",
]
DARKNESS, NECROMANCER, VULNERABLE = 18, 32, 36

# By number of craftax's ItemType, from 1 on. A way down is blocked until enough of its level's monsters are dead.
ITEMS = ["torch_in_inventory", "ladder_down", "ladder_up", "ladder_down_blocked"]
NOTHING, DOWN, BLOCKED, MONSTERS = 0, 2, 4, 8

# Each kind in the order of its `type_id`. The player's are in the order of the moves left, right, up, down.
PLAYER = ["player-left", "player-right", "player-up", "player-down", "player-sleep"]
MELEE = ["zombie", "gnome_warrior", "orc_soldier", "lizard", "knight", "troll", "pigman", "frost_troll"]
PASSIVE = ["cow", "bat", "snail"]
RANGED = [
    "skeleton",
    "gnome_archer",
    "orc_mage",
    "kobold",
    "knight_archer",
    "deep_thing",
    "fire_elemental",
    "ice_elemental",
]
PROJECTILES = ["arrow-up", "dagger", "fireball", "iceball", "arrow-up", "slimeball", "fireball", "iceball"]
ASLEEP = 4

# The slots of the inventory, by what they show.
POTIONS = ["red", "green", "blue", "pink", "cyan", "yellow"]
ARMOUR = ["helmet", "chestplate", "pants", "boots"]
INVENTORY = [
    ["health", "food", "drink", "energy", "mana", "", "floor", "helmet", "", "xp", ""],
    ["coal", "iron", "diamond", "sapphire", "ruby", "sapling", "bow", "chestplate", "sword", "dexterity", ""],
    ["wood", "stone", "torches", "books", "fireball", "iceball", "arrows", "pants", "pickaxe", "strength", ""],
    [*(f"potion_{color}" for color in POTIONS), "", "boots", "", "intelligence", ""],
]
COUNTS = 100  # an item is counted up to 99
ENCHANTMENTS = ["fire", "ice"]

NIGHT = np.array([[[0, 16, 64]]], np.float32)

_image = functools.partial(image, "craftax")


def make_renderer() -> Callable[[Any], jax.Array]:
    """A function from craftax's `EnvState` to its frame: float32 [130, 110, 3] in [0, 255]."""
    blocks = jnp.asarray(_blocks())
    items, sprites = (tuple(map(jnp.asarray, part)) for part in (_items(), _sprites()))
    pictures, start, last = _slots()
    slots = jnp.asarray(pictures)
    darkness = jnp.asarray(_darkness())

    def render(state: Any) -> jax.Array:
        corner = state.player_position - CENTER
        level = state.player_level

        block = _view(state.map, level, corner, OUT_OF_BOUNDS)
        block = jnp.where((block == NECROMANCER) & _boss_is_vulnerable(state), VULNERABLE, block)
        item = _view(state.item_map, level, corner, NOTHING)
        item = jnp.where((item == DOWN) & (state.monsters_killed[level] < MONSTERS), BLOCKED, item)
        tiles = blocks[block] * (1 - items[1][item]) + items[0][item]
        tiles = _draw_creatures(tiles, state, corner, *sprites)
        light = _view(state.light_map, level, corner, 0.0)
        scene = pixels(tiles * light[..., None, None, None])

        numbers = _inventory(state)
        index = [
            start[name] + jnp.clip(jnp.asarray(numbers[name]).astype(jnp.int32), 0, last[name])
            for row in INVENTORY
            for name in row
        ]
        inventory = slots[jnp.stack(index)].reshape(len(INVENTORY), COLUMNS, TILE, TILE, 3)
        return jnp.concatenate([_night(scene, state, darkness), pixels(inventory).astype(jnp.float32)])

    return render


def _view(layer: jax.Array, level: jax.Array, corner: jax.Array, outside: Any) -> jax.Array:
    """[9, 11]: what of a level's layer, [levels, H, W], the player sees; `outside` beyond the map's edge."""
    row, column = corner[0] + np.arange(ROWS), corner[1] + np.arange(COLUMNS)
    on_map = [(at >= 0) & (at < size) for at, size in zip((row, column), layer.shape[1:], strict=True)]
    seen = layer.at[level, row[:, None], column[None]].get(mode="clip")
    return jnp.where(on_map[0][:, None] & on_map[1][None], seen, jnp.asarray(outside, layer.dtype))


def _boss_is_vulnerable(state: Any) -> jax.Array:
    """When no wave of monsters is left or due."""
    level = state.player_level
    alive = state.melee_mobs.mask[level].any() | state.ranged_mobs.mask[level].any()
    return ~alive & (state.boss_timesteps_to_spawn_this_round <= 0)


def _draw_creatures(tiles: jax.Array, state: Any, corner: jax.Array, color: jax.Array, alpha: jax.Array) -> jax.Array:
    """Blends the player and the creatures over their tiles, in craftax's order (two may share a tile)."""
    level = state.player_level
    melee = len(PLAYER)
    passive = melee + len(MELEE)
    ranged = passive + len(PASSIVE)
    flying = ranged + len(RANGED)
    groups = [(state.melee_mobs, melee), (state.passive_mobs, passive), (state.ranged_mobs, ranged)]
    which = [jnp.where(state.is_sleeping, ASLEEP, state.player_direction - 1)[None]]
    which += [first + mobs.type_id[level] for mobs, first in groups]
    for mobs, direction in (
        (state.mob_projectiles, state.mob_projectile_directions),
        (state.player_projectiles, state.player_projectile_directions),
    ):
        groups.append((mobs, flying))
        which.append(flying + 4 * mobs.type_id[level] + heading(direction[level]))
    at = jnp.concatenate([state.player_position[None]] + [mobs.position[level] for mobs, _ in groups]) - corner[None]
    alive = jnp.concatenate([jnp.ones(1, bool)] + [mobs.mask[level] for mobs, _ in groups])
    return draw(tiles, at, alive, jnp.concatenate(which), color, alpha)


def _night(scene: jax.Array, state: Any, darkness: jax.Array) -> jax.Array:
    """Under the open sky: noise toward the edges and a blue tint. Sleep halves the light."""
    daylight = jnp.where(state.player_level == 0, state.light_level, 1.0)
    noise = uniform(state.state_rng, scene.shape[:2]) * 95 + 32
    noisy = jnp.maximum(2 * (0.5 - daylight), 0.0) * darkness
    night = (1 - noisy) * scene + noisy * noise[..., None]
    night = 0.5 * night + 0.5 * NIGHT
    scene = daylight * scene + (1 - daylight) * night
    return jnp.where(state.is_sleeping, 0.5, 1.0) * scene


def _inventory(state: Any) -> dict[str, Any]:
    """What each slot shows: an index into its images (`_slots`)."""
    has = state.inventory
    counts = ["wood", "stone", "coal", "iron", "diamond", "sapphire", "ruby", "sapling", "torches", "books"]
    numbers = {"": 0, "floor": state.player_level, "bow": has.bow, "pickaxe": has.pickaxe}
    numbers |= {name: getattr(has, name) for name in counts}
    numbers |= {name: getattr(state, f"player_{name}") for name in ("food", "drink", "energy", "mana", "xp")}
    numbers |= {name: getattr(state, f"player_{name}") for name in ("dexterity", "strength", "intelligence")}
    numbers["health"] = jnp.maximum(jnp.floor(state.player_health), 1)
    numbers |= {f"potion_{color}": has.potions[i] for i, color in enumerate(POTIONS)}
    numbers |= {name: state.learned_spells[i] for i, name in enumerate(("fireball", "iceball"))}
    numbers |= {name: has.armour[i] + 3 * state.armour_enchantments[i] for i, name in enumerate(ARMOUR)}
    numbers["sword"] = has.sword + 5 * state.sword_enchantment
    numbers["arrows"] = has.arrows + jnp.where(has.arrows > 0, COUNTS * state.bow_enchantment, 0)
    return numbers


def _blocks() -> np.ndarray:
    """float32 [37, 10, 10, 3]."""
    blocks = np.stack([_image(name, TILE)[..., :3] for name in ALL_BLOCKS])
    blocks[OUT_OF_BOUNDS], blocks[DARKNESS] = GRAY, 0
    return blocks


def _items() -> tuple[np.ndarray, np.ndarray]:
    """Colors and opacity of nothing and of the items, as `draw` takes them."""
    return _cut_out(np.stack([np.zeros((TILE, TILE, 4), np.float32)] + [_image(name, TILE) for name in ITEMS]))


def _sprites() -> tuple[np.ndarray, np.ndarray]:
    """Colors and opacity of the player, the creatures, and each projectile in four directions, as `draw` takes them."""
    images = [_image(name, TILE) for name in PLAYER + MELEE + PASSIVE + RANGED]
    return _cut_out(np.stack(images + [view for name in PROJECTILES for view in turned(_image(name, TILE))]))


def _cut_out(images: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[..., 4] -> colors, 0 where not fully opaque [..., 3], and opacity, 0 or 1 [..., 1]."""
    opaque = (images[..., 3:] == 255).astype(np.float32)
    return images[..., :3] * opaque, opaque


def _slots() -> tuple[np.ndarray, dict[str, int], dict[str, int]]:
    """All that the inventory's slots can show, uint8 [images, 10, 10, 3]; each slot's first, and its number of others.

    A slot's images are numbered as `_inventory` says what it shows.
    """
    empty = np.zeros((TILE, TILE, 3), np.float32)

    def icon(name: str, cut_out: bool = False) -> np.ndarray:
        side = TILE - 2 * BORDER
        picture = _image(name, side)
        return np.pad(
            _cut_out(picture)[0] if cut_out else picture[..., :3], ((BORDER, BORDER), (BORDER, BORDER), (0, 0))
        )

    def over(slot: np.ndarray, name: str, side: int, row: int, column: int) -> np.ndarray:
        color, opaque = _cut_out(_image(name, side))
        slot = slot.copy()
        part = slot[row : row + side, column : column + side]
        part[...] = part * (1 - opaque) + color
        return slot

    def with_number(slot: np.ndarray, number: int) -> np.ndarray:
        if number:
            slot = over(slot, str(number % 10), DIGIT, TILE - DIGIT, TILE - DIGIT)
        if number >= 10:
            slot = over(slot, str(number // 10), DIGIT, TILE - DIGIT, TILE - 2 * DIGIT)
        return slot

    def counted(picture: np.ndarray) -> list[np.ndarray]:
        return [empty] + [with_number(picture, number) for number in range(1, COUNTS)]

    def enchanted(slots: list[np.ndarray], name: str) -> list[np.ndarray]:
        added = [
            over(s, f"{name}_{kind}_enchantment", TILE - 2 * BORDER, BORDER, BORDER)
            for kind in ENCHANTMENTS
            for s in slots
        ]
        return slots + added

    names = {"torches": "torch_in_inventory", "books": "book"}
    alone = ["bow", "fireball", "iceball"]
    images = {"": [empty], "floor": [with_number(empty, number) for number in range(10)]}
    images |= {name: [empty, icon(name)] for name in alone}
    images |= {
        n: [with_number(icon(n), number) for number in range(10)] for n in ("dexterity", "strength", "intelligence")
    }
    images["xp"] = counted(icon("xp"))[:10]
    images["pickaxe"] = [empty] + [icon(f"{kind}_pickaxe", True) for kind in ("wood", "stone", "iron", "diamond")]
    swords = [empty] + [icon(f"{kind}_sword", True) for kind in ("wood", "stone", "iron", "diamond")]
    images["sword"] = enchanted(swords, "sword")
    for name in ARMOUR:
        images[name] = enchanted([empty] + [icon(f"{kind}_{name}", True) for kind in ("iron", "diamond")], name)
    images["arrows"] = enchanted(counted(icon("arrow-up", True)), "arrow")
    slots = {name for row in INVENTORY for name in row}
    images |= {name: counted(icon(names.get(name, name))) for name in sorted(slots - set(images))}

    start = dict(zip(images, np.cumsum([0] + [len(pictures) for pictures in images.values()]).tolist(), strict=False))
    last = {name: len(pictures) - 1 for name, pictures in images.items()}
    return np.concatenate([np.stack(pictures) for pictures in images.values()]).astype(np.uint8), start, last


def _darkness() -> np.ndarray:
    """How much of the night's noise lies over each pixel, float32 [90, 110, 1]: the distance from the middle."""
    y, x = (np.arange(tiles * TILE) - tiles * TILE // 2 for tiles in VIEW)
    distance = np.sqrt((y[:, None] ** 2 + x[None] ** 2).astype(np.float32))
    return (distance / distance.max())[..., None]
