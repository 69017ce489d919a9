"""Curves at Weights & Biases, offline: the package's own files are read back."""

from __future__ import annotations

import json
import sys

import pandas as pd
import pytest

from suite import registry
from suite.runs import training
from suite.runtime.reporting import QuietReporter
from tests.tiny import CORRIDOR

SMOKE = ["run", "corridor", "--agent", "random", "--preset", "smoke", "--quiet", "--wandb", "corridors"]


@pytest.fixture(autouse=True)
def corridor(monkeypatch, tmp_path):
    monkeypatch.setattr(registry, "TASKS", (*registry.TASKS, CORRIDOR))
    monkeypatch.chdir(tmp_path)
    yield
    if wandb := sys.modules.get("wandb"):
        wandb.teardown()  # it remembers its first settings


def pieces(log, block=32_768):
    """Of a log as LevelDB writes them: parts with a header (checksum, length, kind), none of them across two blocks."""
    position, piece = 7, b""  # after the file's own header
    while position + 7 <= len(log):
        if (left := block - position % block) < 7:
            position += left
            continue
        length, kind = int.from_bytes(log[position + 4 : position + 6], "little"), log[position + 6]
        piece += log[position + 7 : position + 7 + length]
        position += 7 + length
        if kind in (1, 4):  # whole, or the last of several
            yield piece
            piece = b""


def points(file):
    """What one process sent: settings of the run, and its curves' points."""
    from wandb.proto.wandb_internal_pb2 import Record

    runs, rows = [], []
    for data in pieces(file.read_bytes()):
        record = Record.FromString(data)
        if record.HasField("run"):
            runs.append(record.run)
        if record.HasField("history"):
            items = record.history.item
            rows.append({item.key or ".".join(item.nested_key): json.loads(item.value_json) for item in items})
    return runs[0], rows


def test_a_run_that_was_stopped_goes_on_as_the_same_run_there(tmp_path, monkeypatch):
    wandb = pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    config = registry.resolve("corridor", "random", "smoke")
    stop = [lambda iteration: iteration.step == 64]
    first = training.run(config, tmp_path, QuietReporter(), callbacks=stop, wandb="corridors")
    assert (first.status, first.steps) == ("stopped", 64) and wandb.run is None
    result = training.run(config, tmp_path, QuietReporter(), wandb="corridors")
    assert result.status == "finished" and wandb.run is None
    wandb.teardown()  # as at the process's end: everything is in the files then
    id = (result.folder / "wandb" / "id.txt").read_text()
    files = sorted(result.folder.glob(f"wandb/offline-run-*/run-{id}.wandb"))
    assert len(files) == 2
    (run, rows), (again, more) = map(points, files)
    for sent in (run, again):
        assert (sent.run_id, sent.project, sent.run_group) == (id, "corridors", "corridor/random/smoke")
        assert sent.display_name == "corridor/random/smoke/seed_0"
    metrics = pd.read_csv(result.folder / "metrics.csv").drop(columns="episodes")
    curves = pd.DataFrame([*rows, *more]).rename(columns={"_step": "step"})[metrics.columns]
    assert len(rows) == 2
    pd.testing.assert_frame_equal(curves, metrics, check_dtype=False)
    settings = {item.key: json.loads(item.value_json) for item in run.config.update}
    assert settings["protocol"]["steps"] == 192


def test_a_finished_run_is_none_there(tmp_path, monkeypatch):
    config = registry.resolve("corridor", "random", "smoke", seed=1)
    training.run(config, tmp_path, QuietReporter())
    monkeypatch.setattr("suite.runs.training.require_wandb", lambda: None)
    result = training.run(config, tmp_path, QuietReporter(), wandb="corridors")
    assert result.status == "already finished" and not (result.folder / "wandb").exists()


@pytest.mark.parametrize("command", ["run", "sweep"])
def test_where_it_is_not_installed_one_line_says_how(suite, monkeypatch, tmp_path, command):
    monkeypatch.setitem(sys.modules, "wandb", None)
    sweep = ["sweep", "--tasks", "corridor", "--agents", "random", "--preset", "smoke", "--wandb", "corridors"]
    code, out, err = suite(*(SMOKE if command == "run" else sweep))
    assert (code, out, err.count("\n")) == (2, "", 1) and "pip install -e '.[wandb]'" in err
    assert not list(tmp_path.iterdir())


def test_without_an_account_one_line_says_so(suite, monkeypatch, tmp_path):
    pytest.importorskip("wandb")
    for name, value in {"WANDB_MODE": "online", "WANDB_API_KEY": "", "HOME": str(tmp_path), "NETRC": "none"}.items():
        monkeypatch.setenv(name, value)
    code, _, err = suite(*SMOKE)
    assert code == 2 and err.startswith("error: Weights & Biases: No API key") and err.count("\n") == 1
    assert "with WANDB_MODE=offline it needs neither account nor network" in err
