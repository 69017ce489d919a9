"""Agents beyond the paper: `m6`, what each of its parts is worth, and the bound of every agent that dreams."""

from __future__ import annotations

from typing import Any

from suite.config import Config
from suite.overrides import apply_changes

LOCAL_EMBEDDING = 16  # numbers that the tokens around each one are embedded in

# Each part of M6 by name: what it changes of M5, and what takes it away again.
PARTS: dict[str, dict[str, Any]] = {
    "correspondence": {"world_model.correspondence": True},
    "grid": {"world_model.positions": "grid"},
    "local": {"world_model.local_embedding": LOCAL_EMBEDDING},
    "action": {"world_model.action_in_tokens": True},
    "min_p": {"imagination.min_p": 0.2},
}


def m6(config: Config) -> Config:
    """M6: M5 with a world model that knows that most of a frame stands near its place in the frame before.

    Five parts, which docs/agents.md explains: the correspondence head, positions in time, row and column, an embedding
    of the tokens around each one, the action added to every token, and dreams without improbable tokens.
    """
    return _with_parts(config, PARTS)


def m6_without(part: str, config: Config) -> Config:
    """`m6` without one of its `PARTS`."""
    return _with_parts(config, {name: changes for name, changes in PARTS.items() if name != part})


def oracle(config: Config) -> Config:
    """`m5` whose dreams happen in the true game: what a perfect world model would be worth.

    It steps the simulator far more often than its budget of real steps says, so it is no rival of the others.
    """
    return apply_changes(config, {"world_model.enabled": False, "imagination.world": "game"})


def _with_parts(config: Config, parts: dict[str, dict[str, Any]]) -> Config:
    return apply_changes(config, {name: value for changes in parts.values() for name, value in changes.items()})
