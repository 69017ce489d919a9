"""Runs that are published begin as their records say, and forged ones do not."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pandas as pd
import pytest

from leaderboards.boards import Standing
from leaderboards.replay import differences, first_iteration, replay
from leaderboards.results import Entry
from suite import registry
from suite.configuration.schema import Config
from suite.records.record import RunRecord
from suite.runs import training
from suite.runtime.reporting import QuietReporter
from tests.tiny import WIDE_CORRIDOR

QUIET = QuietReporter()


@pytest.fixture(scope="module", autouse=True)
def registered():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(registry, "TASKS", (*registry.TASKS, WIDE_CORRIDOR))
        yield


def train(out, agent="m5", seed=0, task=WIDE_CORRIDOR.id):
    config = registry.resolve(task, agent, "smoke", ["evaluation.every_steps=0"], seed)
    return training.run(config, out, QUIET, callbacks=[lambda iteration: True]).folder


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Folders of runs: of one agent, of its next seed, and of the model-free one."""
    out = tmp_path_factory.mktemp("runs")
    return {"run": train(out), "seed": train(out, seed=1), "agent": train(out, "mfrl")}


def replayed(folder):
    record = RunRecord.open(folder, lock=False)
    return differences(record, first_iteration(record.config))


def test_a_run_begins_as_its_record_says(runs):
    assert replayed(runs["run"]) == replayed(runs["seed"]) == []


def dressed_as(other):
    """The tables of another run, under this one's name."""

    def forge(folder, runs):
        for name in ("episodes.csv", "metrics.csv"):
            shutil.copy(runs[other] / name, folder / name)

    return forge


def metric(name, change):
    def forge(folder, runs):
        table = pd.read_csv(folder / "metrics.csv")
        table[name] = change(table[name]) if name in table else change(table["step"])
        table.to_csv(folder / "metrics.csv", index=False)

    return forge


def longer(folder, runs):
    table = pd.read_csv(folder / "episodes.csv")
    table["length"] += 1
    table.to_csv(folder / "episodes.csv", index=False)


def setting(folder, runs):
    """Another configuration than the run had, and its digest in the record."""
    path = folder / "config.json"
    config = json.loads(path.read_text())
    config["ppo"]["discount"] = 0.5
    path.write_text(json.dumps(config))
    path = folder / "record.json"
    fields = json.loads(path.read_text())
    path.write_text(json.dumps(fields | {"config_digest": Config(**config).digest()}))


FORGERIES = {
    "another seed": (dressed_as("seed"), "episodes.csv"),
    "another agent": (dressed_as("agent"), "metrics.csv lacks world_model/loss"),
    "an episode": (longer, "length is"),
    "a loss": (metric("world_model/loss", lambda loss: 0.8 * loss), "world_model/loss is"),
    "what play paid": (metric("reward_per_step", lambda reward: 1.001 * reward), "reward_per_step is"),
    "a metric of another agent": (
        metric("world_model/copied_share", lambda step: 0 * step + 0.5),
        "which is not this agent's",
    ),
    "another setting": (setting, "learn/"),
}


@pytest.mark.parametrize(("forge", "found"), FORGERIES.values(), ids=FORGERIES)
def test_forgeries_are_found(runs, forge, found, tmp_path):
    folder = shutil.copytree(runs["run"], tmp_path / "run")
    forge(folder, runs)
    assert any(found in problem for problem in replayed(folder))


def test_processes_side_by_side_replay_each_run_once(tmp_path):
    folders = [train(tmp_path, "random", seed, "openspiel/tic_tac_toe") for seed in (0, 1, 2)]
    shutil.copy(folders[0] / "episodes.csv", folders[1] / "episodes.csv")
    rows = [standing(*folders[:2]), standing(folders[2])]
    found = dict(replay(rows, None, QUIET, jobs=2))
    assert found.keys() == {folder.name for folder in folders}
    assert found["seed_0"] == found["seed_2"] == []
    assert "episodes" in found["seed_1"][0]
    assert len(list(replay(rows, 1, QUIET, jobs=1))) == 1


def standing(*folders):
    """A published row of these runs, whose evidence is said to lie in folders named after them."""
    records = tuple(RunRecord.open(folder, lock=False) for folder in folders)
    return Standing(Entry(records), tuple(Path(folder.name) for folder in folders))
