"""Policies of other people's: `suite evaluate TASK --policy module:Class`."""

from __future__ import annotations

import json

import numpy as np
import pytest

from suite import cli, registry
from suite.registry import catalog
from suite.runs.external import evaluate_policy
from suite.runtime.errors import UserError
from suite.runtime.reporting import QuietReporter
from tests.documents import code
from tests.tiny import CORRIDOR, PENNIES


@pytest.fixture(autouse=True)
def tiny(monkeypatch):
    monkeypatch.setattr(registry, "TASKS", (CORRIDOR, PENNIES))


class Uniform:
    def __init__(self, spec):
        self.spec = spec

    def preferences(self, observation, first, acting):
        assert observation.dtype == np.uint8 and first.dtype == acting.dtype == bool
        return np.zeros((len(observation), self.spec.num_actions))


class Seer(Uniform):
    """Guesses the coin it is shown, and never walks left."""

    def preferences(self, observation, first, acting):
        right = observation[:, 1] == 2 if self.spec.two_player else np.ones(len(observation), bool)
        return np.where(right[:, None], [-np.inf, 0.0], [0.0, -np.inf])


class Counting(Uniform):
    """Remembers: it leaves the corridor's middle after three steps only."""

    def __init__(self, spec):
        super().__init__(spec)
        self.time = np.zeros(48, int)

    def preferences(self, observation, first, acting):
        self.time[: len(first)] = np.where(first, 0, self.time[: len(first)] + 1)
        return np.where((self.time[: len(first)] < 3)[:, None], [0.0, -np.inf], [-np.inf, 0.0])


class Wrong(Uniform):
    def preferences(self, observation, first, acting):
        return np.zeros((len(observation), 1))


class Nan(Uniform):
    def preferences(self, observation, first, acting):
        return np.full((len(observation), 2), np.nan)


class Other(Uniform):
    """Gives what it is made with."""

    gives: object = 0.0

    def preferences(self, observation, first, acting):
        return np.full((len(observation), self.spec.num_actions), self.gives)


class Infinite(Other):
    gives = np.inf


class Large(Other):
    gives = 1e300


class Never(Other):
    gives = -np.inf


class Text(Other):
    gives = "left"


class Ragged(Uniform):
    def preferences(self, observation, first, acting):
        return [[0.0], [0.0, 1.0]]


class Few(Uniform):
    def preferences(self, observation):
        return np.zeros((len(observation), 2))


class Unmade:
    def __init__(self):
        pass


class Failing(Uniform):
    def preferences(self, observation, first, acting):
        return {}["moves"]


class Mute:
    def __init__(self, spec):
        pass


def scores(task, name, episodes=None):
    return evaluate_policy(task, f"tests.runs.test_external:{name}", episodes, QuietReporter())


def test_a_better_policy_scores_better():
    """Seeing the coin wins every game in seat 1; in seat 2 there is nothing to decide, and the opponent guesses."""
    assert scores("pennies", "Seer")["return"] == pytest.approx(0.5, abs=0.1)
    uniform = scores("pennies", "Uniform")
    assert uniform["return"] == pytest.approx(0.0, abs=0.12) and uniform["episodes"] >= 1000


def test_a_policy_may_remember():
    seer, counting = (scores("corridor", name) for name in ("Seer", "Counting"))
    assert seer["episodes"] == counting["episodes"] == 48
    assert seer["reward_percent"] > 0 and counting["reward_percent"] > 0


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("Infinite", "preferences(observation, first, acting) of Infinite gave inf, expected numbers of shape [48, 2]"),
        ("Large", "of Large gave inf, expected numbers"),
        ("Never", "of Never gave -inf for every action, expected numbers"),
        ("Text", "of Text gave values of type <U4, expected numbers"),
        ("Ragged", "preferences(observation, first, acting) of Ragged raised ValueError: "),
        ("Few", "its method preferences(observation) is called as preferences(observation, first, acting)"),
        ("Unmade", "Unmade() cannot be called as Unmade(spec)"),
        ("CORRIDOR", "cannot be called as CORRIDOR(spec)"),
        ("Failing", "of Failing raised KeyError: 'moves' (test_external.py, line "),
        ("Wrong", "gave shape [48, 1], expected numbers of shape [48, 2]"),
        ("Nan", "gave nan, expected numbers of shape [48, 2]"),
        ("Mute", "it has no method preferences(observation, first, acting)"),
        ("Unifrm", "tests.runs.test_external has no 'Unifrm'; did you mean 'Uniform'?"),
    ],
)
def test_a_policy_that_is_none_is_one_line(name, message):
    with pytest.raises(UserError) as caught:
        scores("pennies", name)
    assert message in str(caught.value)


@pytest.mark.parametrize("reference", ["nowhere:Policy", "tests.runs.test_external", ":Uniform"])
def test_a_wrong_reference_is_one_line(reference):
    with pytest.raises(UserError, match=f"--policy={reference}: "):
        evaluate_policy("pennies", reference, None, QuietReporter())


def test_the_command(capsys):
    words = [
        "evaluate",
        "pennies",
        "--policy",
        "tests.runs.test_external:Seer",
        "--episodes",
        "96",
        "--quiet",
        "--json",
    ]
    assert cli.main(words) == 0
    fields = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert fields["episodes"] == 96 and fields["policy"] == "tests.runs.test_external:Seer"
    assert cli.main(["evaluate", "pennies"]) == 2
    assert "--policy module:Class" in capsys.readouterr().err


def test_readmes_policy_plays_as_readme_says(tmp_path, monkeypatch, capsys):
    (tmp_path / "mypolicy.py").write_text(code("README.md", "python", "class Caller"))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(registry, "TASKS", catalog.TASKS)
    assert cli.main(["evaluate", "openspiel/leduc", "--policy", "mypolicy:Caller", "--quiet", "--json"]) == 0
    scores = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert scores["episodes"] >= 1_000 and 0 < scores["normalized_return"] < 1
