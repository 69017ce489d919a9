"""Several seeds as one program: each run's record is that which it leaves alone."""

from __future__ import annotations

import dataclasses
import itertools
import json
from pathlib import Path

import pandas as pd
import pytest

from suite import registry
from suite.agent.phases import Agent
from suite.cli import main
from suite.runs import training
from suite.runs.devices import computed, used_together
from suite.runs.progress import Progress
from suite.runtime.errors import RunError, UserError
from suite.runtime.reporting import QuietReporter
from tests.runs.test_training import StopAt, assert_same, programs
from tests.tiny import CORRIDOR

SEEDS = range(4)
LONG = (pytest.mark.devices, pytest.mark.timeout(3600))
CASES = [
    ("corridor", "mfrl"),
    *(
        pytest.param(case, marks=LONG)
        for case in itertools.product(("craftax_classic", "minatar/breakout", "openspiel/leduc"), ("m5", "m6"))
    ),
]
CERTAIN_DREAMS = "imagination.trust=0", "imagination.trust_window=0", "imagination.start_step=0"


@pytest.fixture(autouse=True, scope="module")
def tiny_task():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(registry, "TASKS", (*registry.TASKS, CORRIDOR))
        yield


def of_all_seeds(task="corridor", agent="mfrl"):
    settings = ["evaluation.every_steps=64", *(() if agent == "mfrl" else CERTAIN_DREAMS)]
    return [registry.resolve(task, agent, "smoke", settings, seed) for seed in SEEDS]


def together(out, reporter=None):
    return training.run_together(of_all_seeds(), out, reporter or QuietReporter())


@pytest.fixture(scope="module")
def alone(tiny_task, tmp_path_factory):
    """What each seed leaves by itself."""
    out = tmp_path_factory.mktemp("alone")
    return [training.run(each, out, QuietReporter()) for each in of_all_seeds()]


@pytest.mark.parametrize("case", CASES, ids="-".join)
def test_four_records_are_those_of_separate_runs_and_each_program_is_compiled_once(case, tmp_path):
    configs = of_all_seeds(*case)
    found = training.run_together(configs, tmp_path / "together", QuietReporter())
    compiled = programs()
    assert set(compiled) <= {0, 1} and compiled[:2] == [1, 1], "of each phase one, for all seeds and iterations"
    for mine, each in zip(found, configs, strict=True):
        theirs = training.run(each, tmp_path / "alone", QuietReporter())
        assert_same(mine, theirs)
        fields = [json.loads((run.folder / "record.json").read_text()) for run in (mine, theirs)]
        assert fields[0].keys() == fields[1].keys() and fields[0]["columns"] == fields[1]["columns"]
        assert [record["device"]["seeds"] for record in fields] == [4, 1]
        timing = [pd.read_csv(run.folder / "timing.csv") for run in (mine, theirs)]
        assert list(timing[0]) == list(timing[1]) and len(timing[0]) == len(timing[1])


def test_runs_that_were_stopped_together_go_on_alone_and_those_stopped_alone_together(alone, tmp_path):
    assert {result.status for result in together(tmp_path, StopAt("learn", 2))} == {"stopped"}
    first, second, *_ = of_all_seeds()
    assert training.run(first, tmp_path, QuietReporter()).status == "finished"
    assert training.run(second, tmp_path, StopAt("collect", 2)).status == "stopped"
    found = together(tmp_path)  # one is at its end, one is further than the other two
    assert [result.status for result in found] == ["already finished", "finished", "finished", "finished"]
    for mine, theirs in zip(found, alone, strict=True):
        assert_same(dataclasses.replace(mine, status="finished"), theirs)
    assert {result.status for result in together(tmp_path)} == {"already finished"}


def test_one_that_diverges_does_not_stop_the_others(alone, tmp_path, monkeypatch):
    take = Progress.take

    def diverged(self, phase, part):
        if self.config.seed == 2 and self.steps == 96:
            raise RunError("learn/policy_loss became nan")
        take(self, phase, part)

    monkeypatch.setattr(Progress, "take", diverged)
    found = together(tmp_path)
    assert [result.status for result in found] == ["finished", "finished", "failed", "finished"]
    assert found[2].reason == "learn/policy_loss became nan"
    record = json.loads((found[2].folder / "record.json").read_text())
    assert record["status"] == "failed" and record["steps"] == 64
    for i in (0, 1, 3):
        assert_same(found[i], alone[i])


def test_shares_are_equal():
    assert [computed(seeds, devices) for seeds, devices in ((4, 1), (4, 4), (7, 4), (3, 2))] == [4, 4, 8, 4]


def test_a_task_that_steps_on_the_host_takes_its_turns(tmp_path):
    settings = registry.resolve("gymnasium/CartPole-v1", "mfrl", "smoke")
    with pytest.raises(UserError, match="steps on the host"):
        used_together(settings, 2, None, QuietReporter())


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["--seed", "1", "--together"], "for several seeds"),
        (["--together"], "for several seeds"),
        (["--seeds", "0-1", "--together", "--coordinator", "auto"], "without --coordinator"),
        (["--seeds", "0-1", "--together", "--devices", "99"], "JAX sees"),
    ],
)
def test_what_cannot_be_together(words, problem, tmp_path, capsys):
    assert main(["run", "corridor", "--preset", "smoke", "--out", str(tmp_path / "runs"), *words]) == 2
    assert problem in capsys.readouterr().err
    assert not list(Path(tmp_path).rglob("record.json"))


def test_the_command(tmp_path, capsys):
    words = ["run", "corridor", "--agent", "random", "--preset", "smoke", "--seeds", "0-2", "--together", "--json"]
    assert main([*words, "--out", str(tmp_path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "seeds 0, 1, 2 together" in lines[0]
    told = json.loads(lines[-1])
    assert [run["seed"] for run in told["runs"]] == [0, 1, 2] and told["mean"].keys() == told["standard_error"].keys()
    assert {run["status"] for run in told["runs"]} == {"finished"}
    assert Agent.collect._cache_size() == 1
