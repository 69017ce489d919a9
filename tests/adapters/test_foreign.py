"""What the bridges take and refuse: every case is a test, and a row of the table in docs/extending.md.

`python -m tests.adapters.test_foreign` prints the table.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pettingzoo
import pytest
from gymnasium import spaces

from adapters.gymnasium import task as gymnasium_bridge
from adapters.pettingzoo import task as pettingzoo_bridge
from suite import cli, registry
from suite.runtime.errors import RunError, UserError, host_errors
from tests.adapters.foreign import Env, Game
from tests.contract import check_spec, check_types
from tests.documents import REPOSITORY

DOCUMENT = "docs/extending.md"
HEADING = "| what it is | id | what becomes of it |\n|---|---|---|\n"
STEPS = 20
FLOATS = spaces.Box(-np.inf, np.inf, (3,), np.float64)


@dataclasses.dataclass(frozen=True)
class Case:
    """An environment and what the suite makes of it.

    Attributes:
      what: it is, in the table's words.
      id: of the task.
      refused: what the one line says, at least; "": it trains.
      stops: the same of a fault that only play finds.
      make: what the id makes, if nobody has registered it; `options` are Gymnasium's.
      play: the actions of the test's play.
    """

    what: str
    id: str
    refused: str = ""
    stops: str = ""
    make: Callable[[], Any] | None = None
    options: dict[str, Any] = dataclasses.field(default_factory=dict)
    play: tuple[int, ...] = (0, 1)


def gym(what: str, refused: str = "", options: dict[str, Any] | None = None, **peculiarity: Any) -> Case:
    rest = {key: peculiarity.pop(key) for key in ("stops", "play") if key in peculiarity}
    return Case(what, "gymnasium/my/Env-v0", refused, make=lambda: Env(**peculiarity), options=options or {}, **rest)


def zoo(what: str, refused: str = "", **peculiarity: Any) -> Case:
    return Case(what, "pettingzoo/my/game_v0", refused, make=lambda: Game(**peculiarity))


def missing() -> None:
    raise gymnasium.error.DependencyNotInstalled("install\n  another package")


def image(*shape: int, dtype: Any = np.uint8, high: float = 255, low: float = 0) -> spaces.Box:
    return spaces.Box(low, high, shape, dtype)


def fill(*shape: int) -> Callable[[int], np.ndarray]:
    return lambda time: np.full(shape, time % 256, np.uint8)


CASES = [
    Case("four floats, two of them without bounds", "gymnasium/CartPole-v1"),
    Case("six floats", "gymnasium/Acrobot-v1"),
    Case("a tuple of numbers", "gymnasium/Blackjack-v1"),
    Case("one number of 16", "gymnasium/FrozenLake-v1"),
    Case("one number of 500", "gymnasium/Taxi-v4"),
    gym("a picture [height, width, 3]", observation=image(12, 8, 3)),
    gym("a picture, channel first", observation=image(3, 12, 8)),
    gym("a grey picture [height, width]", observation=image(12, 8)),
    gym("four grey pictures, channel first", observation=image(4, 84, 84), shows=fill(4, 84, 84)),
    gym("a picture of floats in [0, 1]", observation=image(12, 8, 3, dtype=np.float32, high=1)),
    gym("a picture of floats in [-1, 1], channel first", observation=image(3, 12, 8, dtype=np.float32, low=-1, high=1)),
    gym(
        "a picture of floats without bounds",
        "from -inf to inf",
        observation=image(12, 8, 3, dtype=float, low=-np.inf, high=np.inf),
    ),
    gym("seven planes of bits", observation=image(10, 10, 7, dtype=np.bool_, high=1)),
    gym("30 planes of bits", "up to 16 channels", observation=image(10, 10, 30, dtype=np.bool_, high=1)),
    gym("a large picture", observation=image(210, 160, 3), shows=fill(210, 160, 3)),
    gym("a picture that is too large", "ResizeObservation", observation=image(600, 400, 3)),
    gym("a picture beside other things", observation=spaces.Dict(image=image(7, 7, 3), mission=spaces.Text(9))),
    gym(
        "nested parts", observation=spaces.Dict(goal=spaces.Tuple((spaces.Discrete(3), image(2, dtype=float, high=9))))
    ),
    gym("parts of any number", "cannot be flattened", observation=spaces.Sequence(spaces.Discrete(3))),
    gym("floats without bounds", observation=FLOATS),
    gym("a float that never changes in random play", observation=FLOATS, shows=lambda time: np.zeros(3)),
    gym("floats, some infinite", observation=FLOATS, shows=lambda time: np.array([time, np.inf, -np.inf])),
    gym(
        "floats, nan from the third step on",
        "step 3 of the episode of seed 0: the observation holds nan",
        observation=FLOATS,
        shows=lambda time: np.full(3, np.nan if time > 2 else 0.5),
    ),
    gym("300 floats", "300 numbers", observation=image(300, dtype=float)),
    gym("whole numbers without bounds", observation=spaces.Box(-(2**62), 2**62, (2,), np.int64)),
    gym("whole numbers of few values", observation=spaces.Box(-3, 4, (2, 2), np.int16)),
    gym("numbers from outside of their space", "outside its space", shows=lambda time: time),
    gym("actions that start at 5", actions=spaces.Discrete(3, start=5)),
    gym("several actions", actions=spaces.MultiDiscrete([3, 4])),
    gym("several buttons", actions=spaces.MultiBinary(3)),
    gym("too many actions together", "2,500 combinations", actions=spaces.MultiDiscrete([50, 50])),
    gym("one action", "fewer than two actions", actions=spaces.Discrete(1)),
    Case("continuous actions", "gymnasium/Pendulum-v1", "its actions are Box"),
    gym("rewards up to a million", pay=lambda taken: 1e5 * (len(taken) % 11)),
    gym("rewards of a ten-millionth", pay=lambda taken: 1e-7 * (len(taken) % 4)),
    gym("rewards beyond float32", "the reward is inf", pay=lambda taken: 1e39),
    gym(
        "a reward that is nan",
        "step 2 of the episode of seed 0: the reward is nan",
        pay=lambda taken: np.nan if len(taken) == 2 else 0.0,
    ),
    gym(
        "a reward that becomes nan where random play does not come",
        stops="step 20 of the episode of seed",
        pay=lambda taken: np.nan if taken[-20:] == [1] * 20 else 0.0,
        play=(1,),
    ),
    gym("a reward of None", "step 1 of the episode of seed 0: the reward is nan", pay=lambda taken: None),
    gym("raises in a step", "step 1 of the episode of seed 0: ZeroDivisionError: division by zero", raises="step"),
    gym("raises in a reset", "step 0 of the episode of seed 0: OSError: no display found", raises="reset"),
    gym("ends with the first step", length=1),
    gym("is only cut off, by a time limit", options={"max_episode_steps": 7}),
    gym("never ends"),
    gym("means something else by P and max_steps", own={"P": np.eye(2), "max_steps": math.inf}),
    gym("does not heed its seed", "its seed does not determine it", observation=spaces.Discrete(200), seeded=False),
    gym(
        "says that its seed does not determine it", "its seed does not determine it", options={"nondeterministic": True}
    ),
    Case("needs another package", "gymnasium/my/Env-v0", "install another package", make=missing),
    Case("nobody has heard of it", "gymnasium/CartPoll-v1", "Did you mean: `CartPole`?"),
    Case("an old version", "gymnasium/Taxi-v3", "deprecated"),
    Case("in a package that is not there", "gymnasium/no_such_package:Env-v0", "No module named 'no_such_package'"),
    Case("a board game", "pettingzoo/connect_four_v3"),
    Case("simultaneous moves, no action mask", "pettingzoo/rps_v2"),
    zoo("one agent dies before the other", lives=(2, 4)),
    zoo("three agents", "3 agents, not two", agents=3),
    zoo("one agent", "1 agent, not two", agents=1),
    zoo("continuous actions", "not Discrete", actions=spaces.Box(0, 1)),
    zoo("floats", "not whole numbers", observation=spaces.Box(0, 1)),
    zoo("a player without a legal action", "agent_0 has no legal action", legal=(0, 0)),
    zoo("over before it begins", "over before its first step", lives=(0, 0)),
    zoo("a reward that is nan", "step 5 of the episode of seed 0: the reward is", reward=np.nan),
    Case("needs another package", "pettingzoo/my/game_v0", "install another package", make=missing),
    Case("nobody has heard of it", "pettingzoo/connect_five_v3", "did you mean 'classic/connect_four-v3'"),
    Case("two players", "openspiel/kuhn_poker"),
    Case("parameters", "openspiel/mnk(m=3,n=4,k=3)"),
    Case("made of another game", "openspiel/misere(game=tic_tac_toe())"),
    Case("the other game is not named", "openspiel/misere", "misere(game=tic_tac_toe())"),
    Case(
        "simultaneous moves",
        "openspiel/goofspiel(num_cards=3)",
        "turn_based_simultaneous_game(game=goofspiel(num_cards=3))",
    ),
    Case("simultaneous moves, in turn", "openspiel/turn_based_simultaneous_game(game=goofspiel(num_cards=3))"),
    Case("three players", "openspiel/kuhn_poker(players=3)", "it has 3 players, not two; kuhn_poker(players=2) has"),
    Case("one player", "openspiel/catch", "it has 1 player, not two"),
    Case("four players", "openspiel/hearts", "it has 4 players, not two"),
    Case(
        "no such parameter",
        "openspiel/kuhn_poker(cards=4)",
        "Unknown parameter 'cards'. Available parameters are: players",
    ),
    Case("a bracket is missing", "openspiel/kuhn_poker(players=2", "Missing closing bracket"),
    Case("floats", "openspiel/oware", "not whole numbers"),
    Case("no observations", "openspiel/coin_game", "no observation tensor"),
    Case("chance without probabilities", "openspiel/negotiation", "the probabilities of its chance events"),
    Case("misspelt", "openspiel/leduk", "did you mean 'leduc'"),
]


@contextlib.contextmanager
def registered(case: Case) -> Iterator[None]:
    """Its environment, if it is one of this module, under its id."""
    _, _, id = case.id.partition("/")
    with contextlib.ExitStack() as ended:
        if case.make and case.id.startswith("gymnasium"):
            gymnasium.register(id, entry_point=case.make, **case.options)
            ended.callback(gymnasium.registry.pop, id)
        elif case.make:
            spec = pettingzoo.EnvSpec(id, case.make)
            pettingzoo.aec_registry[spec.id] = spec
            ended.callback(pettingzoo.aec_registry.pop, spec.id)
        for bridge in (gymnasium_bridge, pettingzoo_bridge):
            bridge._imported.cache_clear()
        yield


def outcome(case: Case) -> str:
    """What becomes of it, in the table's words."""
    with registered(case):
        try:
            spec = registry.task(case.id).spec()
        except UserError as error:
            return f"refused: {error}"
        try:
            play(case)
        except RunError as error:
            return f"stops: {error}"
    seen, levels = spec.observation, [f"{reward:g}" for reward in spec.reward_classes]
    shape = "x".join(map(str, seen.shape))
    symbols = f"symbol{'s' if shape != '1' else ''} of {seen.high + 1} values"
    kind = symbols if seen.kind == "symbols" else "cells" if seen.kind == "grid" else "pixels"
    patches = f" in patches of {seen.patch[0]}x{seen.patch[1]}" if seen.patch else ""
    rewards = ", ".join(levels) if len(levels) < 4 else f"{levels[0]} to {levels[-1]} in {len(levels)} levels"
    return f"trains: {shape} {kind}{patches}, {spec.num_actions} actions, rewards {rewards}"


def play(case: Case) -> None:
    """Some play, in which whatever ends begins again; what is shown is as the specification says."""
    environment = registry.task(case.id).make()()
    check_spec(environment)
    check_types(environment, num_envs=2)
    seat, key = (jnp.int32(1),) if environment.spec.two_player else (), jax.random.key(0)
    with host_errors():
        state, shown = environment.reset(key, *seat)
        for action in itertools.islice(itertools.cycle(case.play), STEPS):
            if shown.turn is not None:
                action = int(np.flatnonzero(shown.turn.legal_A if shown.turn.player else shown.turn.chance_C)[-1])
            state, shown = environment.step(key, state, jnp.int32(action))
            assert shown.observation.max() <= environment.spec.observation.high and np.isfinite(shown.reward)
            if shown.terminated or shown.truncated:
                state, shown = environment.reset(key, *seat)


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.what}: {case.id}")
def test_case(case, capsys):
    became = outcome(case)
    if case.refused:
        with registered(case):
            assert cli.main(["run", case.id, "--preset", "smoke"]) == UserError.exit_code
        said = capsys.readouterr()
        assert (said.out, said.err) == ("", f"error: {became.removeprefix('refused: ')}\n")
    else:
        assert became.startswith("stops: " if case.stops else "trains: ")
    assert (case.refused or case.stops) in became
    assert f"| {case.what} | `{case.id}` | {became} |" in (REPOSITORY / DOCUMENT).read_text().splitlines()


def test_cartpole_is_trained_and_evaluated(tmp_path, capsys):
    """Whole runs of others are as those of our own tasks: they differ in the specification alone."""
    words = ["run", "gymnasium/CartPole-v1", "--agent", "mfrl", "--preset", "smoke", "--out", str(tmp_path)]
    assert cli.main([*words, "--quiet", "--json"]) == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert result["status"] == "finished" and result["scores"]["episodes"] > 0
    evaluations = pd.read_csv(Path(result["folder"]) / "evaluations.csv")
    assert len(evaluations) >= 4 and (evaluations["return"] == evaluations["length"]).all()  # 1 for every step


def test_the_table_has_these_cases_and_no_others():
    text = (REPOSITORY / DOCUMENT).read_text()
    rows = text.partition(HEADING)[2].partition("\n\n")[0].splitlines()
    assert [row.rpartition(" | ")[0] for row in rows] == [f"| {case.what} | `{case.id}`" for case in CASES]
    assert len(rows) >= 30


if __name__ == "__main__":
    print(HEADING + "\n".join(f"| {case.what} | `{case.id}` | {outcome(case)} |" for case in CASES))
