"""Which run records may stand on a leaderboard: whole, consistent with themselves, and run as their preset says."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from suite import registry
from suite.configuration.overrides import dotted
from suite.configuration.schema import Config
from suite.interface.environment import EnvironmentSpec
from suite.records.record import RunRecord, episode_columns, protocol
from suite.runtime.errors import UserError

# What a result may differ in without being another agent's: when it is saved and evaluated, what numbers the device
# computes in, which "auto" decides (`suite.registry`), and by which kernel.
FREE = (
    "checkpoint.",
    "evaluation.",
    "seed",
    "policy.compute_type",
    "world_model.compute_type",
    "world_model.attention",
)
# What a leaderboard keeps of a run's folder.
EVIDENCE = ("config.json", "record.json", "episodes.csv", "evaluations.csv", "metrics.csv", "timing.csv")
ROUNDING = 1e-3  # of sums of float32
NOT_RANKED = "smoke"  # a preset for tests


@dataclasses.dataclass(frozen=True)
class Refusal:
    """A run that does not qualify, and everything that speaks against it."""

    folder: Path
    reasons: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.folder}: {'; '.join(self.reasons)}"


def examine(folder: Path) -> RunRecord | Refusal:
    """The record in a run's folder if it qualifies, else every reason why not."""
    reasons = list[str]()
    try:
        record = RunRecord.open(folder, lock=False)
        for reason in _reasons(record):
            reasons.append(reason)
    except UserError as error:
        reasons.append(_short(str(error), folder))
    return Refusal(folder, tuple(reasons)) if reasons else record


def settings(config: Config) -> dict[str, Any]:
    """What makes a run this agent's, by dotted name: without what is `FREE`, and without what belongs to a part of the
    program that the agent does not have. So an agent without a world model keeps its results when a preset's changes.
    """
    unused: tuple[str, ...] = ()
    if not config.world_model.enabled:
        unused += ("world_model.", "tokenizer.")
    if not config.dreams:
        unused += ("imagination.", "replay.")
    needed = ("world_model.enabled", "imagination.world")  # which say that
    return {
        name: value
        for name, value in dotted(config).items()
        if not name.startswith(FREE) and (name in needed or not name.startswith(unused))
    }


def overrides(config: Config) -> tuple[str, ...]:
    """Fields, as "dotted.name=value", in which a run differs from its preset as it is today."""
    preset = dotted(registry.resolve(config.task, config.agent, config.preset))
    return tuple(
        f"{name}={json.dumps(value, separators=(',', ':'))}"
        for name, value in settings(config).items()
        if value != preset[name]
    )


def _short(message: str, folder: Path) -> str:
    """Without the folder's name, which stands before it anyway."""
    return message.replace(f"{folder}/", "").removeprefix(f"{folder} ")


def _reasons(record: RunRecord) -> Iterator[str]:
    config, fields = record.config, record.fields
    if config.preset == NOT_RANKED:
        yield f"preset {config.preset} is for tests"
    if not record.finished:
        yield f"unfinished ({fields.status}): {record.steps:,} of {config.protocol.steps:,} steps"
        return
    if str(fields.git_commit).endswith("-dirty"):
        yield f"made by changed code ({fields.git_commit}): commit it first, then run"
    yield from _protocol_reasons(record)
    yield from _episode_reasons(record)


def _protocol_reasons(record: RunRecord) -> Iterator[str]:
    """The rules in the record must be those of its configuration, and those of its preset."""
    config, rules = record.config, record.fields.protocol
    if record.fields.protocol_hash != rules.hash:
        yield "protocol_hash is not that of the protocol"
    ours = protocol(config, record.spec)
    preset = protocol(registry.resolve(config.task, config.agent, config.preset), record.spec)
    for name, value in rules:
        if name == "package_version":  # other versions are ranked apart, not refused
            continue
        if value != getattr(ours, name):
            yield f"another protocol: record.json has {name}={value}, config.json {getattr(ours, name)}"
        elif value != getattr(preset, name):
            yield f"another protocol: {name}={value}, preset {config.preset} has {getattr(preset, name)}"
    # Iterations are whole, and of a game's events not all count: the budget is used up when no iteration fits any more.
    steps, budget = record.steps, config.protocol.steps
    if not budget - config.steps_per_iteration < steps <= budget:
        yield f"took {steps:,} steps, not the {budget:,} of its budget"


def _episode_reasons(record: RunRecord) -> Iterator[str]:
    """Every episode must be possible, and all of them must agree with what each iteration reported."""
    episodes = record.episodes()
    columns = episode_columns(record.spec)
    if list(episodes) != columns:  # record.json has them as they were
        yield f"episodes.csv has columns {', '.join(map(str, episodes))}, not {', '.join(columns)}"
        return
    if episodes.empty:
        yield "episodes.csv holds no episode"
        return
    steps = episodes["step"].to_numpy()
    if (np.diff(steps) < 0).any() or steps[0] < 1 or steps[-1] > record.steps:
        yield f"episodes.csv has steps out of order, or outside 1 to {record.steps:,}"
    if (episodes["length"] < 1).any():
        yield "episodes.csv has episodes of no length"
    spec = record.spec
    yield from _time_reasons(episodes, record.config, spec)
    yield from impossible(episodes, spec)
    if spec.achievements:
        unlocked = episodes[list(spec.achievements)]
        if not unlocked.isin([0, 1]).all(axis=None):
            yield "episodes.csv has achievements that are neither 0 nor 1"
        elif not np.allclose(unlocked @ np.array(spec.achievement_rewards), episodes["achievement_return"], rtol=1e-5):
            yield "episodes.csv has an achievement_return that is not the sum of its achievements"
    yield from _iteration_reasons(record, episodes)
    scores = registry.task(record.config.task).scores()(episodes, record.config, spec)
    if missing := [name for name, value in scores.items() if not math.isfinite(value)]:
        yield f"no episode counts for {', '.join(missing)}"


def _time_reasons(episodes: pd.DataFrame, config: Config, spec: EnvironmentSpec) -> Iterator[str]:
    """Environments play side by side, a step of each at a time: there must have been time for every episode."""
    if spec.chance_outcomes:  # its events belong to an episode's length, and are no steps
        return
    step, length = episodes["step"].to_numpy(), episodes["length"].to_numpy()
    if (early := length * config.environment.num_envs > step).any():
        row = int(np.flatnonzero(early)[0])
        yield f"episodes.csv line {row + 2}: {length[row]:,} steps long, and ends before it can have begun"
    elif (crowded := np.cumsum(length) > step).any():
        row = int(np.flatnonzero(crowded)[0])
        yield f"episodes.csv line {row + 2}: the episodes so far have more steps than were taken, {step[row]:,}"


def impossible(episodes: pd.DataFrame, spec: EnvironmentSpec) -> Iterator[str]:
    """What the rules of the game do not allow."""
    limits: dict[str, tuple[Any, Any]] = {name: (low, high) for name, low, high in spec.ranges}
    if spec.step_rewards is not None:
        least, most = spec.step_rewards
        limits["return"] = (least * episodes["length"], most * episodes["length"])
    for name, (least, most) in limits.items():
        column = episodes[name]
        if (wrong := (column < least - ROUNDING) | (column > most + ROUNDING)).any():
            row = int(np.flatnonzero(wrong)[0])
            low, high = (np.broadcast_to(limit, len(column))[row] for limit in (least, most))
            yield f"episodes.csv line {row + 2}: {name} is {column.iloc[row]:g}, {spec.id} allows {low:g} to {high:g}"
    parts = [episodes[name] for name in spec.return_parts]
    if parts and (wrong := ~np.isclose(sum(parts), episodes["return"], atol=ROUNDING)).any():
        row = int(np.flatnonzero(wrong)[0])
        yield f"episodes.csv line {row + 2}: return is not the sum of {' and '.join(spec.return_parts)}"


def _iteration_reasons(record: RunRecord, episodes: pd.DataFrame) -> Iterator[str]:
    """metrics.csv says of each iteration how many episodes ended, and their mean return: recomputed."""
    metrics = record.table("metrics")
    if "return" not in metrics:
        yield "metrics.csv lacks return"
        return
    if metrics["step"].iloc[-1] != record.steps:
        yield f"metrics.csv ends at step {metrics['step'].iloc[-1]:,}, the record at {record.steps:,}"
        return
    ends = metrics["episodes"].cumsum().to_numpy().astype(int)
    pieces = np.split(episodes["return"].to_numpy(float), ends[:-1])
    for step, piece, reported in zip(metrics["step"], pieces, metrics["return"], strict=True):
        if len(piece) and not math.isclose(piece.mean(), reported, rel_tol=1e-4, abs_tol=1e-4):  # float32 means
            yield f"episodes to step {step:,} return {piece.mean():.6g} in episodes.csv, {reported:.6g} in metrics.csv"
            return


def evidence_files(folder: Path) -> dict[str, bytes]:
    """Those of `EVIDENCE` that are in a run's folder, by name."""
    return {name: path.read_bytes() for name in EVIDENCE if (path := folder / name).is_file()}
