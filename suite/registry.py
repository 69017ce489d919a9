"""Ids to tasks, agents and presets, all imported lazily, and the configuration that they make together.

Other distributions add theirs by entry points: groups `suite.tasks` and `suite.agents`, each naming a `TaskEntry` or
an `AgentEntry`. This module imports neither JAX nor any game.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import importlib.metadata
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, TypeVar

from suite.config import Config
from suite.errors import UserError, did_you_mean
from suite.overrides import apply_changes, parse_overrides

Source = Literal["default", "preset", "agent", "user"]
Transform = Callable[[Config], Config]


@dataclasses.dataclass(frozen=True)
class Lazy:
    """Something at "module:name", imported when it is asked for; `arguments` are a function's first ones."""

    reference: str
    arguments: tuple[Any, ...] = ()

    def __call__(self) -> Any:
        """Imports it."""
        module, name = self.reference.split(":")
        found = getattr(importlib.import_module(module), name)
        return functools.partial(found, *self.arguments) if self.arguments else found


class Made(Lazy):
    """What the function at "module:name" makes of the arguments, when it is asked for."""

    def __call__(self) -> Any:
        """Imports and calls it."""
        return super().__call__()()


@dataclasses.dataclass(frozen=True)
class TaskEntry:
    """A task: where its parts are, without importing them.

    Attributes:
      id: `family` or `family/name`.
      family: what its tasks share: rules, scoring, presets.
      summary: one line.
      spec: an `EnvironmentSpec`.
      make: a function that builds the environment; its `progress: Callable[[str, float], None] | None` is told of
        preparations that take long.
      scores: a function of (episodes, configuration or None, specification) to numbers by name; None: all episodes
        count alike, as in an evaluation.
      presets: by name, functions `Config -> Config`; they see the agent's id in `config.agent`.
      own_auto_reset: the batched environment, made from a number of environments, that resets as the package itself
        does; for `suite bench` only. None: it has no auto-reset.
      symbols: a function from an environment's state to what its frame shows, int32 [R], for `suite inspect`; None:
        what it shows is not known.
      symbol_values: how many values a symbol has.
      cost: what a run takes, in words.
    """

    id: str
    family: str
    summary: str
    spec: Lazy
    make: Lazy
    scores: Lazy
    presets: Mapping[str, Lazy]
    own_auto_reset: Lazy | None = None
    symbols: Lazy | None = None
    symbol_values: int = 0
    cost: str = ""


@dataclasses.dataclass(frozen=True)
class AgentEntry:
    """An agent: a function `Config -> Config` that states what defines it.

    Attributes:
      row: where the paper reports it, "" if nowhere.
      published: reward and score in percent as published for Craftax-classic at 1M steps, "" if there are none.
      millions: of parameters, as published; None if they are not.
    """

    id: str
    configure: Lazy
    summary: str
    row: str = ""
    published: str = ""
    millions: float | None = None


@dataclasses.dataclass(frozen=True)
class PresetEntry:
    """A preset's name and purpose; what it changes belongs to each task (`TaskEntry.presets`)."""

    id: str
    summary: str


Entry = TypeVar("Entry", TaskEntry, AgentEntry)


def _game(name: str, summary: str = "", cost: str = "") -> TaskEntry:
    return TaskEntry(
        id=f"openspiel/{name}",
        family="openspiel",
        summary=summary or f"{name} of OpenSpiel against a uniform opponent, both seats",
        spec=Made("adapters.openspiel:spec", (name,)),
        make=Lazy("adapters.openspiel:make", (name,)),
        scores=Lazy("leaderboards.scoring:games"),
        presets={
            "paper": Lazy("baselines.presets:openspiel_paper"),
            "small": Lazy("baselines.presets:openspiel_small"),
            "smoke": Lazy("baselines.presets:openspiel_smoke"),
        },
        cost=cost,
    )


def _foreign(family: str, name: str, scores: str) -> TaskEntry:
    return TaskEntry(
        id=f"{family}/{name}",
        family=family,
        summary=f"{name} of {family}",
        spec=Made(f"adapters.{family}_bridge:spec", (name,)),
        make=Lazy(f"adapters.{family}_bridge:make", (name,)),
        scores=Lazy(f"leaderboards.scoring:{scores}"),
        presets={
            "small": Lazy("baselines.presets:foreign_small"),
            "smoke": Lazy("baselines.presets:foreign_smoke"),
        },
        cost="",
    )


# Families with more tasks than are listed: any game of the library by its id.
FAMILIES: dict[str, Callable[[str], TaskEntry]] = {
    "openspiel": _game,
    "gymnasium": lambda name: _foreign("gymnasium", name, "returns"),
    "pettingzoo": lambda name: _foreign("pettingzoo", name, "games"),
}

TASKS = (
    _game("tic_tac_toe", "tic-tac-toe against a uniform opponent, both seats: 27 symbols, 9 actions"),
    _game("leduc", "Leduc poker against a uniform opponent, both seats: 16 symbols, 3 actions, 6 chance outcomes"),
    _game("bargaining", "bargaining, uniform opponent, both seats: 93 symbols, 121 actions, 1002 chance outcomes"),
    TaskEntry(
        id="craftax_classic",
        family="craftax_classic",
        summary="Craftax-classic from 63x63 pixels: 17 actions, 22 achievements",
        spec=Lazy("adapters.craftax:CLASSIC_SPEC"),
        make=Lazy("adapters.craftax:make_classic"),
        scores=Lazy("leaderboards.scoring:craftax"),
        presets={
            "paper": Lazy("baselines.presets:paper"),
            "small": Lazy("baselines.presets:craftax_classic_small"),
            "smoke": Lazy("baselines.presets:craftax_classic_smoke"),
        },
        own_auto_reset=Lazy("adapters.craftax:BuiltInAutoReset"),
        symbols=Lazy("adapters.craftax_symbols:classic_symbols"),
        symbol_values=17,
        cost="small on two CPU cores: m5 6 min, mfrl 2 min, random 15 s, 2.3 GiB; paper: an accelerator",
    ),
)

AGENTS = (
    AgentEntry("random", Lazy("baselines.random_policy:random"), "uniform over actions, learns nothing"),
    AgentEntry(
        "mfrl",
        Lazy("baselines.model_free:mfrl"),
        "PPO with a GRU on real play only",
        "Table 1, Our best MFRL",
        "reward 55.49 +- 1.33 %, score 16.77 +- 1.11 %",
        55.6,
    ),
    AgentEntry(
        "mfrl_no_rnn",
        Lazy("baselines.model_free:mfrl_no_rnn"),
        "mfrl without the GRU",
        "Table 2, Remove RNN",
        "reward 41.82 +- 0.97 %, score 8.33 +- 0.44 %",
    ),
    AgentEntry(
        "mfrl_small",
        Lazy("baselines.model_free:mfrl_small"),
        "mfrl with a smaller network",
        "Table 2, Smaller model",
        "reward 51.35 +- 0.80 %, score 12.93 +- 0.56 %",
    ),
    AgentEntry(
        "mfrl_prior",
        Lazy("baselines.model_free:mfrl_prior"),
        "the PPO of Moon et al. (2023), no memory",
        "Table 1, Previous best MFRL",
        "reward 47.40 +- 0.58 %, score 10.71 +- 0.29 %",
        4.0,
    ),
    AgentEntry(
        "m1",
        Lazy("baselines.ladder:m1"),
        "VQ-VAE, token by token, imagination only",
        "Table 1, M1: Baseline",
        "reward 31.93 +- 2.22 %, score 4.98 +- 0.50 %",
        60.0,
    ),
    AgentEntry(
        "m2",
        Lazy("baselines.ladder:m2"),
        "m1 that learns from real play too (Dyna)",
        "Table 1, M2: M1 + Dyna",
        "reward 43.36 +- 1.84 %, score 8.85 +- 0.63 %",
        60.0,
    ),
    AgentEntry(
        "m3",
        Lazy("baselines.ladder:m3"),
        "m2 with a VQ-VAE of patches",
        "Table 1, M3: M2 + patches",
        "reward 58.92 +- 1.03 %, score 19.36 +- 1.42 %",
        56.6,
    ),
    AgentEntry(
        "m4",
        Lazy("baselines.ladder:m4"),
        "m3 with nearest-neighbor tokens",
        "Table 1, M4: M3 + NNT",
        "reward 64.96 +- 1.13 %, score 25.55 +- 0.86 %",
        58.5,
    ),
    AgentEntry(
        "m5",
        Lazy("baselines.ladder:m5"),
        "m4 with block teacher forcing",
        "Table 1, M5: M4 + BTF (fast)",
        "reward 67.42 +- 0.55 %, score 27.91 +- 0.63 %",
        58.5,
    ),
    AgentEntry(
        "m5_slow",
        Lazy("baselines.ladder:m5_slow"),
        "m5 with eight times the world-model updates",
        "Table 1, M5: M4 + BTF (slow)",
        "reward 69.66 +- 1.20 %, score 31.77 +- 1.43 %",
        58.5,
    ),
    AgentEntry(
        "m5_patch5",
        Lazy("baselines.ablations:m5_patch5"),
        "m5 on patches of 5x5",
        "Table 2, 5x5 quantized",
        "reward 57.28 +- 1.14 %, score 18.26 +- 1.18 %",
    ),
    AgentEntry(
        "m5_patch9",
        Lazy("baselines.ablations:m5_patch9"),
        "m5 on patches of 9x9",
        "Table 2, 9x9 quantized",
        "reward 45.55 +- 0.88 %, score 10.12 +- 0.40 %",
    ),
    AgentEntry(
        "m5_continuous",
        Lazy("baselines.ablations:m5_continuous"),
        "m5 that regresses patches",
        "Table 2, 7x7 continuous",
        "reward 21.20 +- 0.55 %, score 2.43 +- 0.09 %",
    ),
    AgentEntry(
        "m5_no_dyna",
        Lazy("baselines.ablations:m5_no_dyna"),
        "m5 that learns from imagination only",
        "Table 2, Remove Dyna",
        "reward 55.02 +- 5.34 %, score 18.79 +- 2.14 %",
    ),
    AgentEntry(
        "m5_no_nnt",
        Lazy("baselines.ablations:m5_no_nnt"),
        "m5 with a VQ-VAE of patches",
        "Table 2, Remove NNT",
        "reward 60.66 +- 1.38 %, score 21.79 +- 1.33 %",
    ),
    AgentEntry(
        "m5_no_nnt_no_patches",
        Lazy("baselines.ablations:m5_no_nnt_no_patches"),
        "m5 with a VQ-VAE of frames",
        "Table 2, Remove NNT & patches",
        "reward 45.86 +- 1.42 %, score 10.36 +- 0.69 %",
    ),
    AgentEntry(
        "m5_no_btf",
        Lazy("baselines.ablations:m5_no_btf"),
        "the same as m4",
        "Table 2, Remove BTF",
        "reward 64.96 +- 1.13 %, score 25.55 +- 0.86 %",
    ),
    AgentEntry(
        "m5_tbp0",
        Lazy("baselines.ablations:m5_tbp0"),
        "m5 that imagines from the start",
        "Table 2, Use T_BP = 0",
        "reward 33.54 +- 10.09 %, score 12.86 +- 4.05 %",
    ),
    AgentEntry(
        "m5_annealed",
        Lazy("baselines.ablations:m5_annealed"),
        "m5 whose imagined updates grow linearly",
        "Appendix C, annealing",
        "reward 65.71 +- 1.11 %",
    ),
)

PRESETS = (
    PresetEntry("paper", "the paper's Appendix A; only these results are ranked (default on an accelerator)"),
    PresetEntry("small", "scaled down so that two CPU cores learn something in minutes (default on a CPU)"),
    PresetEntry("smoke", "two iterations within seconds, for tests; learns nothing"),
)


def tasks() -> dict[str, TaskEntry]:
    """Every task by id, those of other distributions included."""
    return _with_plugins(TASKS, "suite.tasks", TaskEntry)


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
    agent: str = "m5",
    preset: str | None = None,
    overrides: Sequence[str] = (),
    seed: int = 0,
    steps: int | None = None,
) -> Config:
    """The complete configuration of a run.

    Args:
      task: a task's id.
      agent: an agent's id.
      preset: a preset's name; None: "paper" where there is an accelerator, else "small"; the task's first if it lacks
        that one.
      overrides: the user's "dotted.name=value", the last word on every field.
      seed: of all randomness.
      steps: real environment steps; None: the preset's.

    Raises:
      UserError: an unknown id, field or value, or values that do not fit each other.
    """
    return layers(task, agent, preset, overrides, seed, steps)[-1][1]


def layers(
    task: str,
    agent: str = "m5",
    preset: str | None = None,
    overrides: Sequence[str] = (),
    seed: int = 0,
    steps: int | None = None,
) -> list[tuple[Source, Config]]:
    """As `resolve`, with the configuration after each source's changes; the last is the run's."""
    task_entry, agent_entry = _find_task(task), _find("agent", agent, agents())
    changes = parse_overrides(overrides)
    if steps is not None:
        changes["protocol.steps"] = steps
    if preset is not None and preset not in task_entry.presets:
        _find("preset", preset, dict.fromkeys(task_entry.presets))
    if preset is None:
        preset = "paper" if _on_accelerator() else "small"
        preset = preset if preset in task_entry.presets else next(iter(task_entry.presets))
    start = apply_changes(Config(task=task, agent=agent, preset=preset), {"seed": seed})
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
    import jax

    return jax.default_backend() != "cpu"


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
    if id not in known and name and family in FAMILIES:
        entry = FAMILIES[family](name)
        entry.spec()  # which says what is wrong with a name that it does not know
        return entry
    return _find("task", id, known)


def _with_plugins(own: tuple[Entry, ...], group: str, kind: type[Entry]) -> dict[str, Entry]:
    """Entries by id; ours cannot be replaced by another distribution's."""
    found = {}
    for point in importlib.metadata.entry_points(group=group):
        try:
            entry = point.load()
        except Exception as error:  # whatever another distribution's module raises
            raise UserError(f"entry point {point.name!r} of {group} cannot be loaded: {error}") from error
        if not isinstance(entry, kind):
            raise UserError(f"entry point {point.name!r} of {group} is no {kind.__name__}")
        found[entry.id] = entry
    return {entry.id: entry for entry in own} | {id: e for id, e in found.items() if id not in {o.id for o in own}}
