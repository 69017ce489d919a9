"""What the registry holds: tasks, agents and presets by where their parts are, without importing them."""

from __future__ import annotations

import dataclasses
import functools
import importlib
from collections.abc import Mapping
from typing import Any

DEFAULT_AGENT = "m5"


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
class FamilyEntry:
    """What tasks have in common whose results are shown together.

    Attributes:
      id: such as "minatar".
      title: as pages write it.
      games: ids of the tasks that an agent's mean over the family is over, the paper's; none: there is no such mean.
      metric: the score of those tasks that can be averaged; "": none can, and each game's return is divided by what the
        model-free baseline earns in it.
    """

    id: str
    title: str
    games: tuple[str, ...] = ()
    metric: str = ""


@dataclasses.dataclass(frozen=True)
class TaskEntry:
    """A task: where its parts are, without importing them.

    Attributes:
      id: `family` or `family/name`.
      family: the id of its `FamilyEntry`, or, of another distribution's task, any word.
      summary: one line.
      spec: an `EnvironmentSpec`.
      make: a function that builds the environment; its `progress: Callable[[str, float], None] | None` is told of
        preparations that take long.
      scores: a function of (episodes, configuration or None, specification) to numbers by name. Where the configuration
        is None all episodes count alike, as in an evaluation.
      presets: by name, functions `Config -> Config`; they see the agent's id in `config.agent`.
      own_auto_reset: the batched environment, made from a number of environments, that resets as the package itself
        does; for `suite bench` only. None: it has no auto-reset.
      symbols: a function from an environment's state to what its frame shows, int32 [R], for `suite inspect`; None:
        what it shows is not known.
      symbol_values: how many values a symbol has.
      text: a function from an episode's events to the game's own text of the state before each of them and after the
        last, and of each event, for `suite watch` of tasks without frames; None: their symbols' values are shown.
      cost: what a run takes, in words.
      paper_agent: the agent that runs under `paper` unless another is named: what the paper's table of the task is of.
      title: as pages write it.
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
    text: Lazy | None = None
    cost: str = ""
    paper_agent: str = DEFAULT_AGENT
    title: str = ""

    def __post_init__(self) -> None:
        """A task without a title is called by its id."""
        object.__setattr__(self, "title", self.title or self.id)


@dataclasses.dataclass(frozen=True)
class AgentEntry:
    """An agent: a function `Config -> Config` that states what defines it.

    Attributes:
      row: where the paper reports it, "" if nowhere.
      published: reward and score in percent as published for Craftax-classic at 1M steps, "" if there are none.
      millions: of parameters, as published; None if they are not.
      uses_simulator: it learns from the task's own simulator beyond its budget of real steps, so it is a bound that
        others are compared with, and takes no rank.
    """

    id: str
    configure: Lazy
    summary: str
    row: str = ""
    published: str = ""
    millions: float | None = None
    uses_simulator: bool = False


@dataclasses.dataclass(frozen=True)
class PresetEntry:
    """A preset's name and purpose; what it changes belongs to each task (`TaskEntry.presets`)."""

    id: str
    summary: str
