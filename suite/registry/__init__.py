"""Ids to tasks, agents and presets, all imported lazily, and the configuration that they make together.

Other distributions add theirs by entry points: groups `suite.tasks` and `suite.agents`, each naming a `TaskEntry` or
an `AgentEntry`. This module imports neither JAX nor any game.
"""

from __future__ import annotations

import functools
import importlib.metadata
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, TypeVar

from suite.configuration.overrides import apply_changes, parse_overrides
from suite.configuration.schema import Config
from suite.registry.catalog import AGENTS, FAMILIES, OPEN_FAMILIES, PRESETS, TASKS
from suite.registry.entries import DEFAULT_AGENT, AgentEntry, FamilyEntry, Lazy, Made, PresetEntry, TaskEntry
from suite.runtime.compilation import device_kind
from suite.runtime.errors import UserError, did_you_mean

__all__ = [
    "AgentEntry",
    "FamilyEntry",
    "Lazy",
    "Made",
    "PresetEntry",
    "TaskEntry",
]  # for other distributions, in one place

Source = Literal["default", "preset", "agent", "user"]
Transform = Callable[[Config], Config]
Entry = TypeVar("Entry", TaskEntry, AgentEntry)


def tasks() -> dict[str, TaskEntry]:
    """Every task by id, those of other distributions included."""
    return _with_plugins(TASKS, "suite.tasks", TaskEntry)


def family(id: str) -> FamilyEntry:
    """The family of this id; one of another distribution's tasks has no title and no mean over games."""
    return next((entry for entry in FAMILIES if entry.id == id), FamilyEntry(id, id))


def agents() -> dict[str, AgentEntry]:
    """Every agent by id, those of other distributions included."""
    return _with_plugins(AGENTS, "suite.agents", AgentEntry)


def presets() -> dict[str, PresetEntry]:
    """Every preset by name."""
    return {entry.id: entry for entry in PRESETS}


def task(id: str) -> TaskEntry:
    """The task of this id.

    Raises:
      UserError: there is none.
    """
    return _find_task(id)


def agent(id: str) -> AgentEntry:
    """The agent of this id.

    Raises:
      UserError: there is none.
    """
    return _find("agent", id, agents())


def resolve(
    task: str,
    agent: str | None = None,
    preset: str | None = None,
    overrides: Sequence[str] | Mapping[str, Any] = (),
    seed: int = 0,
    steps: int | None = None,
) -> Config:
    """The complete configuration of a run.

    Args:
      task: a task's id.
      agent: an agent's id; None: "m5", and under "paper" the one that the paper's table of this task reports.
      preset: a preset's name; None: "paper" where there is an accelerator, else "small"; the task's first if it lacks
        that one.
      overrides: the user's "dotted.name=value", or values by dotted name: the last word on every field.
      seed: of all randomness.
      steps: real environment steps; None: the preset's.

    Raises:
      UserError: an unknown id, field or value, or values that do not fit each other.
    """
    return layers(task, agent, preset, overrides, seed, steps)[-1][1]


def layers(
    task: str,
    agent: str | None = None,
    preset: str | None = None,
    overrides: Sequence[str] | Mapping[str, Any] = (),
    seed: int = 0,
    steps: int | None = None,
) -> list[tuple[Source, Config]]:
    """As `resolve`, with the configuration after each source's changes; the last is the run's."""
    task_entry = _find_task(task)
    agent_entry = None if agent is None else _find("agent", agent, agents())
    changes = parse_overrides(overrides)
    if steps is not None:
        changes["protocol.steps"] = steps
    if preset is not None and preset not in task_entry.presets:
        _find("preset", preset, dict.fromkeys(task_entry.presets))
    if preset is None:
        preset = "paper" if _on_accelerator() else "small"
        preset = preset if preset in task_entry.presets else next(iter(task_entry.presets))
    if agent_entry is None:
        agent_entry = _find("agent", task_entry.paper_agent if preset == "paper" else DEFAULT_AGENT, agents())
    start = apply_changes(Config(task=task, agent=agent_entry.id, preset=preset), {"seed": seed})
    configs: list[tuple[Source, Config]] = [("default", _with_compute_type(start))]
    transforms: tuple[tuple[Source, Transform], ...] = (
        ("preset", task_entry.presets[preset]()),
        ("agent", agent_entry.configure()),  # after the preset: what defines an agent holds at any size
        ("user", lambda config: _with_compute_type(apply_changes(config, changes))),
    )
    for source, transform in transforms:
        configs.append((source, transform(configs[-1][1])))
    return configs


def _on_accelerator() -> bool:
    return device_kind() != "cpu"


def _with_compute_type(config: Config) -> Config:
    """Makes "auto" concrete, so that records show what was computed in."""
    changes = {
        f"{part}.compute_type": "bfloat16" if _on_accelerator() else "float32"
        for part in ("policy", "world_model")
        if getattr(config, part).compute_type == "auto"
    }
    return apply_changes(config, changes)


def _find(kind: str, id: str, entries: Mapping[str, Any]) -> Any:
    if id not in entries:
        raise UserError(f"unknown {kind} {id!r}; {did_you_mean(id, entries)}")
    return entries[id]


def _find_task(id: str) -> TaskEntry:
    family, _, name = id.partition("/")
    known = tasks()
    if id not in known and name and family in OPEN_FAMILIES:
        entry = OPEN_FAMILIES[family](name)
        entry.spec()  # which says what is wrong with a name that it does not know
        return entry
    return _find("task", id, known)


def _with_plugins(own: tuple[Entry, ...], group: str, kind: type[Entry]) -> dict[str, Entry]:
    """Entries by id; ours cannot be replaced by another distribution's."""
    plugins = {}
    for point in _entry_points(group):
        try:
            entry = point.load()
        except Exception as error:  # whatever another distribution's module raises
            raise UserError(f"entry point {point.name!r} of {group} cannot be loaded: {error}") from error
        if not isinstance(entry, kind):
            raise UserError(f"entry point {point.name!r} of {group} is no {kind.__name__}")
        plugins[entry.id] = entry
    return {entry.id: entry for entry in own} | {id: e for id, e in plugins.items() if id not in {o.id for o in own}}


@functools.cache  # reads the metadata of every installed distribution
def _entry_points(group: str) -> tuple[importlib.metadata.EntryPoint, ...]:
    return tuple(importlib.metadata.entry_points(group=group))
