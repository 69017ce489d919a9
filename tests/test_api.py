"""The suite from Python (`suite.make`, `train`, `load`, `results`)."""

from __future__ import annotations

import dataclasses
import json
import shutil
import subprocess
import sys

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
from PIL import Image

import suite
from suite import api, registry
from suite.diagnostics.watching import Episode, captions
from suite.records.record import RunRecord, run_folder
from suite.runs.training import Iteration
from suite.runtime.errors import UserError
from tests import documents
from tests.documents import code
from tests.tiny import WIDE_CORRIDOR

TASK = WIDE_CORRIDOR.id
SETTINGS = {"imagination.trust": 0, "imagination.trust_window": 0, "ppo.discount": 0.9}


@pytest.fixture(scope="module", autouse=True)
def registered():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(registry, "TASKS", (*registry.TASKS, WIDE_CORRIDOR))
        yield


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run of m6, stopped by a callback after its first iteration, which then went on; and what callbacks saw."""
    out, seen = tmp_path_factory.mktemp("runs"), []

    def first(iteration):
        seen.append(iteration)
        return True

    stopped = suite.train(TASK, "m6", "smoke", settings=SETTINGS, out=out, callbacks=[first])
    assert (stopped.status, stopped.steps) == ("stopped", seen[0].step)
    assert stopped.policy.act(np.zeros((3, *stopped.spec.observation.shape), np.uint8)).shape == (3,)
    run = suite.train(TASK, "m6", "smoke", settings=SETTINGS, out=str(out), callbacks=[seen.append])
    return run, seen


def test_what_a_run_leaves(trained):
    run, seen = trained
    assert isinstance(run, suite.Run) and (run.status, run.steps) == ("finished", run.config.protocol.steps)
    assert run.config.ppo.discount == 0.9
    assert [type(iteration) for iteration in seen] == [Iteration, Iteration]
    assert run.metrics["step"].tolist() == [iteration.step for iteration in seen]
    assert run.metrics["learn/entropy"].tolist() == pytest.approx([i.metrics["learn/entropy"] for i in seen])
    assert run.episodes["return"].tolist() == [row["return"] for i in seen for row in i.episodes]
    assert len(run.timing) == 2 and len(run.evaluations)
    phases = {name.partition("/")[0] for name in run.metrics.iloc[-1].dropna().index if "/" in name}
    assert phases == {"learn", "tokenizer", "world_model", "imagine"}
    assert run.scores.keys() == registry.task(TASK).scores()(run.episodes, run.config, run.spec).keys() - {
        "episodes",
        "final_episodes",
    }
    again = suite.load(run.folder)
    assert again.scores == run.scores and "finished at step" in repr(again)
    assert run.result.status == again.result.status == "finished" and again.result.evaluation == run.result.evaluation


def test_an_evaluation_is_that_of_the_command(trained, suite, tmp_path):
    copies = [shutil.copytree(trained[0].folder, tmp_path / name) for name in ("first", "second")]
    scores = api.load(copies[0]).evaluate(3)
    assert scores["episodes"] >= 3 and scores["step"] == trained[0].steps
    code, out, _ = suite("evaluate", copies[1], "--episodes", "3", "--quiet", "--json")
    assert code == 0
    assert json.loads(out.splitlines()[-1]) == {"folder": str(copies[1]), **scores}
    first, second = ((folder / "evaluations.csv").read_bytes() for folder in copies)
    assert first == second


def test_results_are_a_table_of_finished_runs(trained):
    run, _ = trained
    table = suite.results(run.folder.parents[3])
    assert isinstance(table, pd.DataFrame) and len(table) == 1
    (row,) = table.to_dict("records")
    assert (row["task"], row["agent"], row["seed"], row["steps"]) == (TASK, "m6", 0, run.steps)
    assert {name: row[name] for name in run.scores} == pytest.approx(run.scores, nan_ok=True)
    with pytest.raises(UserError, match="no finished run"):
        suite.results(run.folder / "checkpoints")


def test_the_policy_acts_as_in_training(trained):
    """What it prefers, memory included, is what the network says of the whole sequence at once."""
    run, _ = trained
    policy, shape = run.policy, run.spec.observation.shape
    frames = np.random.default_rng(0).integers(0, 2, (6, 2, *shape)).astype(np.uint8) * run.spec.observation.high
    first = np.zeros((6, 2), bool)
    first[0], first[3, 1] = True, True
    policy.reset()
    logits = np.stack([policy.preferences(frame, start) for frame, start in zip(frames, first, strict=True)])
    restored = run._restored
    network = restored.agent._policy(restored.model.policy_state)
    whole, _ = network(jnp.asarray(frames), jnp.asarray(first), network.initial_hidden(2))
    np.testing.assert_allclose(logits, whole.logits_TBA, atol=1e-5)

    policy.reset()
    alone = np.stack([policy.preferences(frame[0]) for frame in frames])  # without the batch's axis
    np.testing.assert_allclose(alone, logits[:, 0], atol=1e-5)
    policy.reset(seed=1)
    greedy = policy.act(frames[0], greedy=True)
    np.testing.assert_array_equal(greedy, logits[0].argmax(-1))
    legal = np.zeros((2, run.spec.num_actions), bool)
    legal[:, 1] = True
    assert policy.act(frames[0], legal=legal).tolist() == [1, 1]
    with pytest.raises(UserError, match=r"observation: shape \[5\], expected"):
        policy.act(np.zeros(5, np.uint8))
    with pytest.raises(UserError, match="observation: numbers of type float64, expected whole ones"):
        policy.act(frames[0] / 255)


def test_dreams_are_those_of_the_world_model(trained):
    run, _ = trained
    environment = suite.make(TASK, num_envs=3)
    state, shown = environment.reset(jax.random.key(0))
    frames, actions = [np.asarray(shown.observation)], []
    for t in range(8):
        actions.append(np.asarray(jax.random.randint(jax.random.key(t), (3,), 0, run.spec.num_actions)))
        state, shown = environment.step(jax.random.key(t), state, jnp.asarray(actions[-1]))
        frames.append(np.asarray(shown.observation))
    frames_BT, actions_BT = np.stack(frames, axis=1), np.stack(actions, axis=1)
    model, needs = run.world_model, run.world_model.needs
    assert needs > 0
    before = frames_BT[:, :needs], actions_BT[:, :needs]
    dream = model.dream(frames_BT[:, needs], actions_BT[:, needs:], before)
    steps = 8 - needs
    assert dream.frames.shape == (3, steps, *run.spec.observation.shape) and dream.frames.dtype == np.uint8
    assert dream.rewards.shape == dream.ends.shape == (3, steps)
    assert set(np.unique(dream.rewards)) <= set(run.spec.reward_classes)
    again = model.dream(frames_BT[:, needs], actions_BT[:, needs:], before)
    np.testing.assert_array_equal(dream.frames, again.frames)
    one = model.dream(frames_BT[0, needs], actions_BT[0, needs:])  # it is not told what came before
    assert one.frames.shape == dream.frames.shape[1:] and one.rewards.shape == (steps,)
    tokens = model.encode(frames_BT[:, 0])
    assert model.decode(tokens).shape == frames_BT[:, 0].shape
    np.testing.assert_array_equal(model.encode(frames_BT[0, 0]), tokens[0])
    with pytest.raises(UserError, match="and this model is told of"):
        model.dream(frames_BT[:, 1], actions_BT[:, 1:], (frames_BT[:, :1], actions_BT[:, :1]))
    with pytest.raises(UserError, match="actions are -1 to 1, expected 0 to 1"):
        model.dream(frames_BT[0, 0], [-1, 1])
    with pytest.raises(UserError, match="expected 3 times steps"):
        model.dream(frames_BT[:, 0], actions_BT[0])


def test_bad_input_is_refused_before_anything_is_compiled(tmp_path):
    with pytest.raises(UserError, match="unknown task"):
        suite.make("no_such_game")
    with pytest.raises(UserError, match=r"unknown field 'ppo\.discont'; did you mean 'ppo\.discount'"):
        suite.train(TASK, "mfrl", "smoke", settings={"ppo.discont": 1})
    with pytest.raises(UserError, match=r"ppo.discount=2"):
        suite.train(TASK, "mfrl", "smoke", settings={"ppo.discount": 2})
    with pytest.raises(UserError):
        suite.load(tmp_path)
    with pytest.raises(AttributeError, match="no attribute 'tain'"):
        _ = suite.tain


def test_nothing_is_imported_before_it_is_used():
    script = "import sys, suite; assert 'jax' not in sys.modules; suite.make; assert 'jax' in sys.modules"
    subprocess.run([sys.executable, "-c", script], check=True)


def test_the_notebook_runs(trained, tmp_path, capsys):
    """All its cells, in order, on the task and with the agent that the tests before have compiled."""
    settings, *cells = documents.cells("docs/tutorial.ipynb")
    names: dict = {}
    exec(settings, names)
    steps = 2 * trained[0].config.steps_per_iteration
    ours = {"TASK": TASK, "AGENT": "m6", "PRESET": "smoke", "STEPS": steps, "SETTINGS": SETTINGS, "OUT": tmp_path}
    assert names.keys() - {"__builtins__"} == ours.keys() | {"SEED"}
    names |= ours
    with plt.ioff():
        for cell in cells:
            exec(cell, names)
    pictures = [plt.figure(number) for number in plt.get_fignums()]
    plt.close("all")
    assert [len(picture.axes) for picture in pictures] == [2, 2 * names["HORIZON"]]
    run = names["run"]
    assert run.status == "finished" and len(run.metrics) == 2 + 1
    assert names["dream"].frames.shape == names["real"].shape == (names["HORIZON"], *run.spec.observation.shape)
    assert f"{names['HORIZON']} steps on: " in capsys.readouterr().out


def test_the_example_in_the_documents_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    exec(code("docs/python.md", "python", "import suite"), {})
    assert "% of the cells are right" in capsys.readouterr().out


def test_a_film_of_a_run(trained, suite, tmp_path):
    """`suite watch`: two episodes, and beside each frame what was expected of it."""
    run, _ = trained
    path = tmp_path / "film.gif"
    words = ("watch", run.folder, "--dream", "--episodes", "2", "--steps", "7", "--out", path, "--quiet", "--json")
    code, out, err = suite(*words)
    shown = json.loads(out.splitlines()[-1])
    assert (code, err) == (0, "") and out.splitlines()[0].startswith(f"episode 1: {shown['lengths'][0]} steps, return ")
    with Image.open(path) as image:
        assert shown["film"] == str(path) and 2 <= image.n_frames <= sum(shown["lengths"]) <= 14
    code, out, err = suite("watch", run.folder, "--episodes", "100")
    assert (code, out) == (2, "") and "environments play side by side" in err


def test_what_stands_above_a_frame():
    spec = dataclasses.replace(WIDE_CORRIDOR.spec(), action_names=("back", "on"))
    none = np.zeros((3, 4, 4, 1), np.uint8)
    unlocked = np.array([[False], [True], [True]])
    episode = Episode(none, np.array([0, 1, 1]), np.array([0.0, 1.0, -0.2]), np.array([0.5, 0.25, 0]), unlocked, True)
    assert captions(episode, spec, 2) == [
        "episode 2, step 1: back\nreturn 0.0, value 0.50",
        "episode 2, step 2: on +1.0 arrive!\nreturn 1.0, value 0.25",
        "episode 2, step 3: on -0.2\nreturn 0.8, value 0.00",
    ]


def test_what_cannot_be_filmed(suite, tmp_path):
    for task, agent, words, message in (
        ("openspiel/leduc", "m5", ("--dream",), "shows symbols, and --dream compares frames"),
        (TASK, "mfrl", ("--dream",), "has no world model to dream with: mfrl"),
        (TASK, "m5", ("--steps", "1"), "argument --steps: '1' is no whole number from 2 to 2,147,483,647"),
    ):
        config = registry.resolve(task, agent, "smoke")
        with RunRecord.create(run_folder(tmp_path, config), config, registry.task(task).spec()) as record:
            folder = record.folder
        code, out, err = suite("watch", folder, *words)
        assert (code, out) == (2, "") and message in err and err.count("\n") == 1
