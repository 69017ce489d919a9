"""What random play tells of a host engine: whether it works, and what it shows and pays. Always the same play."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator

import numpy as np

from suite.interface.host import CheckedEngine, HostEngine, HostStep
from suite.interface.turns import CHANCE
from suite.runtime.errors import RunError, UserError

LOOK = 100  # steps of which it is seen whether an engine does the same again
FEW_REWARDS, MANY_INTEGERS = 3, 16  # up to so many rewards are their own classes; more share evenly spaced ones
GAPS = 10


def random_steps(engine: HostEngine, num_actions: int, steps: int) -> Iterator[HostStep]:
    """What `steps` random legal steps and the resets between them show, always the same."""
    random = np.random.default_rng(0)
    host_step = engine.reset(0)
    yield host_step
    for seed in range(1, steps + 1):
        if host_step.player == CHANCE:
            action = random.choice(len(host_step.chance_C), p=host_step.chance_C)
        else:
            action = random.choice(num_actions if host_step.legal_A is None else np.flatnonzero(host_step.legal_A))
        host_step = engine.step(int(action))
        yield host_step
        if host_step.terminated or host_step.truncated:
            host_step = engine.reset(seed)
            yield host_step


def random_play(id: str, engine: HostEngine, num_actions: int, steps: int = 1000) -> Iterator[HostStep]:
    """`random_steps` of an engine that nobody has tried yet.

    Raises:
      UserError: what `CheckedEngine` finds wrong with the engine of the task `id`.
    """
    try:
        yield from random_steps(CheckedEngine(id, engine), num_actions, steps)
    except RunError as error:
        raise UserError(str(error)) from error


def require_determined(id: str, play: Callable[[], Iterator[HostStep]]) -> None:
    """Looks whether random play, begun twice, is the same for its first `LOOK` steps.

    Raises:
      UserError: it is not, so a run of the task `id` could not be resumed.
    """
    one, other = (list(itertools.islice(play(), LOOK)) for _ in range(2))
    pairs = zip(itertools.chain(*one), itertools.chain(*other), strict=True)
    if not all(np.array_equal(a, b) for a, b in pairs):
        raise UserError(f"{id} cannot be a task: its seed does not determine it")


def rewards_of(play: Iterable[HostStep]) -> set[float]:
    """The rewards of these steps, and 0: of games, both players'."""
    return {0.0}.union(*(np.ravel(host_step.reward).tolist() for host_step in play))


def reward_classes(rewards: Iterable[float]) -> tuple[float, ...]:
    """`EnvironmentSpec.reward_classes` for rewards that are known to occur.

    The rewards themselves and 0, if that makes at most 3, or at most 16 integers; at least 0 and 1. Else some ten
    evenly spaced levels, one of them 0, over the range of the rewards with its ends at integers. Of rewards that are
    all below 0.1 the same, as if they were so many powers of ten larger that one is not.
    """
    known = {0.0, *rewards}
    most = max(map(abs, known))
    scale = 10 ** max(0, -math.ceil(math.log10(most))) if most else 1
    levels = {round(scale * reward, 6) for reward in known}
    integers = all(level.is_integer() for level in levels)
    if len(levels) > (MANY_INTEGERS if integers else FEW_REWARDS):
        low, high = math.floor(min(levels)), math.ceil(max(levels))
        gap = (high - low) / GAPS
        first, last = math.floor(round(low / gap, 6)), math.ceil(round(high / gap, 6))
        levels = {round(gap * n, 6) for n in range(first, last + 1)}
    return tuple(sorted(level / scale for level in levels) if len(levels) > 1 else (0.0, 1.0))
