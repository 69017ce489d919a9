"""Whole runs on a tiny task: resuming, stopping, diverging, evaluating."""

from __future__ import annotations

import errno
import io
import json
import os
import re
import shutil
import signal
import sys
from pathlib import Path

import jax
import numpy as np
import pandas as pd
import pytest

from leaderboards.results import finished_in
from suite import registry
from suite.agent.phases import Agent
from suite.records import checkpoint
from suite.records import record as record_module
from suite.records.record import RunRecord
from suite.records.tables import CsvTable
from suite.runs import evaluation, progress, training
from suite.runs.saved_model import restore
from suite.runtime.errors import RunError, UserError
from suite.runtime.reporting import QuietReporter, RichReporter
from tests.tiny import CORRIDOR, PENNIES


@pytest.fixture(autouse=True)
def corridor(monkeypatch):
    monkeypatch.setattr(registry, "TASKS", (*registry.TASKS, CORRIDOR, PENNIES))


class StopAt(QuietReporter):
    """Sends this process a signal when a phase begins for the n-th time: as a user, or a cluster, would."""

    def __init__(self, phase: str, times: int, number: signal.Signals = signal.SIGTERM):
        super().__init__()
        self.phase, self.times, self.number = phase, times, number

    def update(self, steps, phase, fields):
        if phase == self.phase:
            self.times -= 1
            if self.times == 0:
                os.kill(os.getpid(), self.number)


class Killed(Exception):  # noqa: N818 -- no error of the run's
    pass


class KillAt(StopAt):
    """Ends the run on the spot, as `kill -9` does: nothing more is written."""

    def update(self, steps, phase, fields):
        if phase == self.phase:
            self.times -= 1
            if self.times == 0:
                raise Killed


def killed(*_):
    raise Killed


EVERYTHING = "world_model.optimizer=muon", "world_model.average=0.5"  # that a checkpoint of m5 may hold besides


def config(agent: str = "m5", *overrides: str, seed: int = 0):
    return registry.resolve("corridor", agent, "smoke", EVERYTHING + overrides, seed)


def files(folder: Path) -> dict[str, bytes]:
    """What must not depend on how often a run was stopped."""
    names = ("config.json", "episodes.csv", "metrics.csv", "evaluations.csv")
    return {name: (folder / name).read_bytes() for name in names}


def last_model(folder: Path):
    return [np.asarray(x) for x in jax.tree.leaves(restore(RunRecord.open(folder, lock=False), QuietReporter()).model)]


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(registry, "TASKS", (*registry.TASKS, CORRIDOR))
        result = training.run(config(), tmp_path_factory.mktemp("whole"), QuietReporter())
    assert result.status == "finished"
    return result


def assert_same(result, uninterrupted):
    assert result.status == "finished"
    assert files(result.folder) == files(uninterrupted.folder)
    mine_and_theirs = (last_model(run.folder) for run in (result, uninterrupted))
    for mine, theirs in zip(*mine_and_theirs, strict=True):
        np.testing.assert_array_equal(mine, theirs)
    assert pd.Series(result.scores).equals(pd.Series(uninterrupted.scores))  # nan where no episode ended


def programs() -> list[int]:
    """How many programs each phase has."""
    phases = (Agent.start, Agent.collect, Agent.remember, Agent.learn)
    phases += (Agent.update_tokenizer, Agent.code, Agent.update_world_model, Agent.imagine)
    return [phase._cache_size() for phase in phases]


@pytest.fixture
def terminal():
    """A terminal that can be closed: under `nohup` its signal is ignored, and then by the suite too."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize(
    ("phase", "times", "number"),
    [("collect", 3, signal.SIGTERM), ("imagine", 2, signal.SIGHUP)],
    ids=["told", "closed"],
)
def test_a_stopped_and_resumed_run_is_an_uninterrupted_one(tmp_path, uninterrupted, terminal, phase, times, number):
    stopped = training.run(config(), tmp_path, StopAt(phase, times, number))
    assert stopped.status == "stopped"
    assert 0 < stopped.steps < config().total_steps
    before = programs()
    assert_same(training.run(config(), tmp_path, QuietReporter(), resume=True), uninterrupted)
    assert programs() == before  # what was read from disk is to JAX what was computed: it compiles nothing anew


PHASES = ["start", "collect", "learn", "tokenizer", "world_model", "imagine", "checkpoint", "evaluate"]


@pytest.mark.parametrize("phase", PHASES)
def test_a_killed_run_goes_on_from_its_last_checkpoint(tmp_path, uninterrupted, phase):
    late = {"start": 1, "checkpoint": 2, "evaluate": 1, "imagine": 2}.get(phase, 5)
    with pytest.raises(Killed):
        training.run(config(), tmp_path, KillAt(phase, late))
    result = training.run(config(), tmp_path, QuietReporter())
    assert_same(result, uninterrupted)


def test_what_is_played_again_was_recorded_first_and_is_kept(tmp_path):
    with pytest.raises(Killed):
        training.run(config(), tmp_path, KillAt("collect", 4))  # three iterations recorded, a checkpoint after two
    result = training.run(config(), tmp_path, QuietReporter())
    aside = list((result.folder / "replaced").glob("*/metrics.csv"))
    assert len(aside) == 1
    replaced = pd.read_csv(aside[0])
    metrics = pd.read_csv(result.folder / "metrics.csv")
    assert replaced["step"].tolist() == [96]
    pd.testing.assert_frame_equal(replaced, metrics[metrics["step"] == 96].reset_index(drop=True))


def test_a_finished_run_is_not_run_again(uninterrupted):
    before = files(uninterrupted.folder)
    again = training.run(config(), uninterrupted.folder.parents[3], QuietReporter())
    assert again.status == "already finished"
    assert again.scores == uninterrupted.scores
    assert files(uninterrupted.folder) == before


@pytest.fixture
def copied(tmp_path, uninterrupted):
    """A finished run to damage, and the call that it was made by."""
    folder = tmp_path / uninterrupted.folder.relative_to(uninterrupted.folder.parents[3])
    shutil.copytree(uninterrupted.folder, folder)
    return folder, lambda: training.run(config(), tmp_path, QuietReporter())


def put_status(folder: Path, status: str) -> None:
    path = folder / "record.json"
    path.write_text(path.read_text().replace('"status": "finished"', f'"status": "{status}"'))


def test_a_run_killed_before_it_says_that_it_is_finished(copied, uninterrupted):
    """What only going on needs is dropped by then."""
    folder, again = copied
    put_status(folder, "running")
    assert_same(again(), uninterrupted)
    put_status(folder, "done")
    with pytest.raises(UserError, match=r"record.json is damaged: status='done': input should be 'running', "):
        again()


def test_a_run_killed_while_it_ends_keeps_nothing_that_only_going_on_needs(tmp_path, uninterrupted, monkeypatch):
    def killed(*args):
        raise Killed

    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(RunRecord, "finish", killed)
        training.run(config(), tmp_path, QuietReporter())
    result = training.run(config(), tmp_path, QuietReporter())
    assert_same(result, uninterrupted)
    assert [path.name for path in (result.folder / "checkpoints").iterdir()] == ["step_000000000192"]


def test_a_final_evaluation_of_which_rows_are_missing_is_played_again(copied, uninterrupted):
    folder, again = copied
    put_status(folder, "running")
    header, *rows = (folder / "evaluations.csv").read_bytes().splitlines(keepends=True)
    (folder / "evaluations.csv").write_bytes(header + b"".join(rows[:2]) + rows[2][:3])
    assert_same(again(), uninterrupted)
    kept = sorted((folder / "replaced").glob("*/evaluations.csv"))
    assert b"".join(path.read_bytes().removeprefix(header) for path in kept) == rows[2][:3] + b"".join(rows[:2])


def change(name: str, old: bytes, new: bytes):
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes().replace(old, new, 1))


def cut(name: str, end: int):
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes()[:end])


def a_row_less(folder: Path) -> None:
    (folder / "episodes.csv").write_bytes((folder / "episodes.csv").read_bytes()[:-2].rpartition(b"\n")[0] + b"\n")


DAMAGE = {
    "deleted": (lambda folder: (folder / "episodes.csv").unlink(), "episodes.csv is missing"),
    "emptied": (cut("episodes.csv", 0), "episodes.csv is cut off in line 1"),
    "truncated": (cut("episodes.csv", -3), "episodes.csv is cut off in line "),
    "a row less": (a_row_less, " episodes, metrics.csv counted "),
    "nan": (change("episodes.csv", b",1.0,", b",nan,"), " is nan, not a finite number"),
    "another header": (
        change("episodes.csv", b"length", b"duration"),
        "episodes.csv has columns step, return, duration",
    ),
    "torn evaluation": (cut("evaluations.csv", -3), "evaluations.csv is cut off in line 5"),
    "no metrics": (lambda folder: (folder / "metrics.csv").unlink(), "metrics.csv is missing"),
    "an iteration less": (cut("metrics.csv", -1), "metrics.csv is cut off in line 7"),
    "another configuration": (
        change("config.json", b'"discount": 0.9', b'"discount": 0.8'),
        "configuration that was run",
    ),
    "another seed": (change("record.json", b'"seed": 0', b'"seed": 1'), "record.json says seed=1, config.json 0"),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_what_is_wrong_with_a_finished_run_is_said_and_nothing_is_put_in_its_place(copied, name):
    folder, again = copied
    damage, message = DAMAGE[name]
    damage(folder)
    before = {path: path.read_bytes() for path in folder.glob("*.csv")}
    with pytest.raises(UserError, match=re.escape(message)):
        again()
    with pytest.raises(UserError, match=re.escape(message)):
        (record,) = finished_in([folder])
        record.episodes(), record.table("evaluations")
    assert {path: path.read_bytes() for path in folder.glob("*.csv")} == before


def test_a_run_does_not_go_on_without_the_rows_before_its_checkpoint(tmp_path):
    with pytest.raises(Killed):
        training.run(config(), tmp_path, KillAt("collect", 4))
    (folder,) = tmp_path.glob("*/*/*/seed_0")
    (folder / "episodes.csv").unlink()
    before = (folder / "metrics.csv").read_bytes()
    with pytest.raises(UserError, match=r"episodes.csv has 0 episodes, metrics.csv counted \d+"):
        training.run(config(), tmp_path, QuietReporter())
    assert (folder / "metrics.csv").read_bytes() == before and not (folder / "episodes.csv").exists()


def test_a_second_signal_waits_for_the_checkpoint_that_is_being_written(tmp_path, monkeypatch):
    save = checkpoint._save_tree

    def interrupted(*args):
        os.kill(os.getpid(), signal.SIGINT)
        save(*args)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(checkpoint, "_save_tree", interrupted)
        training.run(config(), tmp_path, QuietReporter())
    (folder,) = tmp_path.glob("*/*/*/seed_0")
    assert checkpoint.latest_step(folder / "checkpoints") == 64


def test_a_terminal_that_is_gone_cannot_be_told_and_the_run_stops_all_the_same(tmp_path, monkeypatch, terminal):
    class Gone(io.StringIO):
        def write(self, text: str) -> int:
            raise OSError(errno.EIO, "Input/output error")

    def close(iteration):
        monkeypatch.setattr(sys, "stderr", Gone())
        os.kill(os.getpid(), signal.SIGHUP)

    result = training.run(config(), tmp_path, RichReporter(interval=0), callbacks=[close])
    monkeypatch.undo()
    assert (result.status, result.steps) == ("stopped", 32)
    assert checkpoint.latest_step(result.folder / "checkpoints") == 32


@pytest.mark.parametrize("budget", [100, 160])
def test_a_finished_run_takes_more_steps_as_if_it_had_had_them_from_the_start(tmp_path, uninterrupted, budget):
    first = training.run(config("m5", f"protocol.steps={budget}"), tmp_path, QuietReporter())
    assert first.status == "finished" and first.steps == budget // 32 * 32
    assert [path.name for path in (first.folder / "checkpoints").iterdir()] == [f"step_{first.steps:012d}"]
    with pytest.raises(Killed):
        training.run(config(), tmp_path, KillAt("imagine", 1))
    result = training.run(config(), tmp_path, QuietReporter())
    assert_same(result, uninterrupted)
    fields, others = (json.loads((run.folder / "record.json").read_text()) for run in (result, uninterrupted))
    assert [more["step"] for more in fields["resumed"]] == [first.steps] * 2
    for name in ("config_digest", "protocol", "protocol_hash", "status", "steps"):
        assert fields[name] == others[name]
    aside = result.folder / "replaced" / f"0001_with_{budget}_steps" / "evaluations.csv"
    assert set(pd.read_csv(aside)["step"]) == {first.steps}
    assert training.run(config(), tmp_path, QuietReporter()).status == "already finished"
    with pytest.raises(UserError, match=f"holds a run with protocol.steps=192, not {budget}; choose another --out"):
        training.run(config("m5", f"protocol.steps={budget}"), tmp_path, QuietReporter())


def test_of_a_run_with_more_steps_only_planned_evaluations_stay(tmp_path):
    evaluated = "evaluation.every_steps=64", "evaluation.episodes=1"
    folders = []
    for budgets in ((64, 96, 128, 140), (140,)):
        for steps in budgets:
            settings = config("random", *evaluated, f"protocol.steps={steps}")
            result = training.run(settings, tmp_path / str(len(budgets)), QuietReporter())
            assert result.status == "finished"
        folders.append(result.folder)
    assert files(folders[0]) == files(folders[1])
    assert list(pd.read_csv(folders[0] / "evaluations.csv")["step"].unique()) == [64, 128]


@pytest.mark.parametrize("before", [True, False], ids=["before", "after"])
def test_a_run_killed_while_it_was_given_more_steps_has_the_old_ones_or_the_new(tmp_path, monkeypatch, before):
    less = config("random", "protocol.steps=96")
    folder = training.run(less, tmp_path, QuietReporter()).folder
    with monkeypatch.context() as patch, pytest.raises(Killed):
        if before:
            patch.setattr(CsvTable, "set_aside", killed)
        else:
            calls = []
            patch.setattr(record_module, "settle_config", lambda *args: killed() if calls else calls.append(args))
        training.run(config("random"), tmp_path, QuietReporter())
    record = RunRecord.open(folder, lock=False)
    assert (record.finished, record.config.protocol.steps) == ((True, 96) if before else (False, 192))
    if before:
        assert training.run(less, tmp_path, QuietReporter()).status == "already finished"
    more = training.run(config("random"), tmp_path, QuietReporter())
    whole = training.run(config("random"), tmp_path / "whole", QuietReporter())
    assert files(more.folder) == files(whole.folder)


def test_a_run_that_was_told_to_keep_less_takes_no_more_steps(tmp_path):
    folder = training.run(config("random", "protocol.steps=64"), tmp_path, QuietReporter()).folder
    assert list(folder.glob("checkpoints/*/resume"))
    lean = "protocol.steps=64", "checkpoint.keep_resume=false"
    assert training.run(config("random", *lean), tmp_path, QuietReporter()).status == "already finished"
    assert not list(folder.glob("checkpoints/*/resume"))
    before = files(folder)
    with pytest.raises(UserError, match=r"finished after protocol\.steps=64 and did not keep what more steps"):
        training.run(config("random"), tmp_path, QuietReporter())
    assert files(folder) == before


def test_records_are_complete(uninterrupted):
    fields = json.loads((uninterrupted.folder / "record.json").read_text())
    assert fields["status"] == "finished"
    assert fields["steps"] == 192
    assert {"collect", "learn", "tokenizer", "world_model", "imagine", "evaluate", "total"} <= set(
        fields["wall_clock_seconds"]
    )
    metrics = pd.read_csv(uninterrupted.folder / "metrics.csv")
    assert metrics["step"].tolist() == [32, 64, 96, 128, 160, 192]
    assert metrics["imagine/policy_loss"].notna().tolist() == [False, False, True, True, True, True]
    assert metrics["world_model/observation_loss"].iloc[-1] < metrics["world_model/observation_loss"].iloc[0]
    episodes = pd.read_csv(uninterrupted.folder / "episodes.csv")
    assert (episodes["return"] == episodes["arrive"]).all()
    assert (episodes["length"] <= 6).all()
    assert [path.name for path in uninterrupted.folder.glob("checkpoints/*")] == ["step_000000000192"]


def test_the_first_episodes_of_an_evaluation_are_whole(tmp_path, uninterrupted):
    folder = shutil.copytree(uninterrupted.folder, tmp_path / "copy")
    scores = evaluation.evaluate(folder, 10, QuietReporter())
    assert scores["step"] == 192
    assert scores["episodes"] == 12  # three rounds of four environments
    rows = pd.read_csv(folder / "evaluations.csv")
    assert len(rows) == 4 + 12  # the run's own, and these


def test_evaluations_beside_training_leave_it_as_it_is(tmp_path, uninterrupted):
    settings = config("m5", "evaluation.every_steps=64", "evaluation.episodes=8")
    with pytest.raises(Killed):
        training.run(settings, tmp_path, KillAt("checkpoint", 2))  # the evaluation before it is thrown away
    folder = training.run(settings, tmp_path, QuietReporter()).folder
    for name in ("episodes.csv", "metrics.csv"):
        assert (folder / name).read_bytes() == (uninterrupted.folder / name).read_bytes()
    rows = pd.read_csv(folder / "evaluations.csv")
    assert rows["step"].value_counts(sort=False).to_dict() == {64: 8, 128: 8, 192: 8}
    rounds = [part.drop(columns="step").to_numpy().tolist() for _, part in rows.groupby("step")]
    assert rounds[0] != rounds[1]  # randomness of their own


def test_a_broken_checkpoint_gives_way_to_the_one_before(tmp_path, uninterrupted):
    with pytest.raises(Killed):
        training.run(config(), tmp_path, KillAt("collect", 6))
    folder = next(tmp_path.glob("*/*/*/seed_0"))
    newest = max((folder / "checkpoints").glob("step_*"))
    file = max((newest / "resume").rglob("*"), key=lambda path: path.stat().st_size if path.is_file() else 0)
    file.write_bytes(file.read_bytes()[:-1])
    warned = []
    reporter = QuietReporter()
    reporter.warning = warned.append
    assert_same(training.run(config(), tmp_path, reporter), uninterrupted)
    assert len(warned) == 1
    assert "damaged" in warned[0]


def test_where_no_checkpoint_is_whole_only_who_trains_is_told_of_out(tmp_path, copied):
    folder, again = copied
    put_status(folder, "running")
    (path,) = (folder / "checkpoints").iterdir()
    path.rename(path.with_name("step_000000000160"))
    with pytest.raises(UserError, match=r"it is of step 192\) .* is whole; choose another --out to start anew$"):
        again()
    with pytest.raises(UserError, match=r"no checkpoint in \S+ is whole$"):
        evaluation.evaluate(folder, 4, QuietReporter())


def test_without_a_world_model_nothing_of_it_exists(tmp_path):
    result = training.run(config("mfrl"), tmp_path, QuietReporter())
    columns = pd.read_csv(result.folder / "metrics.csv").columns
    assert not any(name.startswith(("tokenizer", "world_model", "imagine")) for name in columns)
    assert "learn/entropy" in columns
    # Its learning rate goes by the budget, so it takes no more steps and keeps nothing for them.
    assert not list(result.folder.glob("checkpoints/*/resume"))
    before = files(result.folder)
    tied = "192, not 256, and what it learned depends on the budget, by ppo.anneal_learning_rate=true; choose"
    with pytest.raises(UserError, match=tied):
        training.run(config("mfrl", "protocol.steps=256"), tmp_path, QuietReporter())
    assert files(result.folder) == before


def test_random_learns_nothing(tmp_path):
    result = training.run(config("random"), tmp_path, QuietReporter())
    assert list(pd.read_csv(result.folder / "metrics.csv").columns) == ["step", "reward_per_step", "episodes", "return"]


def test_achievements_are_counted_while_it_runs(tmp_path, monkeypatch):
    shown = []

    class Watcher(QuietReporter):
        def update(self, steps, phase, fields):
            if fields:
                shown.append((steps, fields["achievements"]))

    class NoneMore(progress.IterationLog):
        def add(self, phase, part):
            values = super().add(phase, part)
            self.rows = [row | {"arrive": 0} for row in self.rows]
            return values

    training.run(config("random"), tmp_path, Watcher(), callbacks=[lambda iteration: iteration.step == 96])
    monkeypatch.setattr(progress, "IterationLog", NoneMore)
    episodes = training.run(config("random"), tmp_path, Watcher()).folder / "episodes.csv"
    first = pd.read_csv(episodes).query("arrive == 1")["step"].min()
    assert first <= 96 and shown == [(step, int(step >= first)) for step in (32, 64, 96, 128, 160, 192)]


def test_seeds_differ(tmp_path):
    first, second = (training.run(config("random", seed=seed), tmp_path, QuietReporter()) for seed in (0, 1))
    assert files(first.folder)["episodes.csv"] != files(second.folder)["episodes.csv"]


def test_a_diverged_loss_stops_the_run_and_says_where(tmp_path):
    settings = config("mfrl", "ppo.learning_rate=1e30", "ppo.max_grad_norm=1e30")
    with pytest.raises(RunError, match=r"learn/.* became .* in phase learn at step \d+"):
        training.run(settings, tmp_path, QuietReporter())


def test_resume_without_a_run_is_an_error(tmp_path):
    with pytest.raises(UserError, match="nothing to resume"):
        training.run(config(), tmp_path, QuietReporter(), resume=True)


def test_chance_does_not_count_towards_the_budget(tmp_path):
    """Fidelity note 32. An episode of pennies is three events, one of them chance's; all environments are in step."""
    result = training.run(registry.resolve("pennies", "mfrl", "smoke"), tmp_path, QuietReporter())
    # 4 environments play 8 events: three, three and two of them are chance's, in turn.
    steps = pd.read_csv(result.folder / "metrics.csv")["step"]
    assert steps.diff().tolist()[1:4] == [20, 24, 20] and steps[0] == 20
    assert 150 - 32 < result.steps == steps.iloc[-1] <= 150
    episodes = pd.read_csv(result.folder / "episodes.csv")
    assert (episodes["length"] == 3).all()
    assert episodes["step"].tolist()[:8] == [8] * 4 + [16] * 4  # two of three events count, in four environments
    assert set(episodes["return"]) == {-1.0, 1.0}


def test_a_game_that_was_stopped_goes_on_where_it_was(tmp_path):
    config = registry.resolve("pennies", "m5", "smoke")
    whole = training.run(config, tmp_path / "whole", QuietReporter())
    assert training.run(config, tmp_path / "parts", StopAt("imagine", 2)).status == "stopped"
    parts = training.run(config, tmp_path / "parts", QuietReporter())
    assert parts.status == "finished" and files(parts.folder) == files(whole.folder)
    metrics = pd.read_csv(whole.folder / "metrics.csv")
    assert metrics["world_model/legal_accuracy"].notna().all() and metrics["world_model/chance_excess"].notna().all()
