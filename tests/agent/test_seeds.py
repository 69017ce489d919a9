"""Several seeds of one agent as a leading axis."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

from suite import registry
from suite.agent.algorithm import first_programs, start_key
from suite.agent.phases import Agent
from suite.agent.seeds import part, split, stacked, unstacked
from suite.configuration.schema import Config
from suite.runs import training
from suite.runtime import layout
from suite.runtime.reporting import QuietReporter
from tests.tiny import CORRIDOR, PENNIES, Corridor

MEASURED = ("imagination.trust=0.02", "imagination.trust_window=2")
KNOWN = -2.0  # of rewards, by then: some seeds' models know more, others less


@pytest.fixture(autouse=True)
def tiny_tasks(monkeypatch):
    monkeypatch.setattr(registry, "TASKS", (*registry.TASKS, CORRIDOR, PENNIES))


def tables(result, name):
    return pd.read_csv(result.folder / f"{name}.csv")


def assert_nearly_the_same(found, expected):
    """The same play, and the same numbers but for rounding. `tests/runs/test_together.py` has it exactly."""
    for mine, theirs in zip(found, expected, strict=True):
        assert mine.status == "finished"
        for name in ("episodes", "evaluations"):
            pd.testing.assert_frame_equal(tables(mine, name), tables(theirs, name))
        pd.testing.assert_frame_equal(tables(mine, "metrics"), tables(theirs, "metrics"), rtol=1e-2, atol=1e-4)


def test_one_alone_has_no_such_axis():
    tree = {"a": jnp.arange(3), "key": jax.random.key(1)}
    assert stacked([tree]) is tree and unstacked(tree, 1) == [tree] and part(tree, 1, 0) is tree
    both = stacked([tree, {"a": jnp.arange(3) + 5, "key": jax.random.key(2)}])
    assert both["a"].tolist() == [[0, 1, 2], [5, 6, 7]] and part(both, 2, 1)["a"].tolist() == [5, 6, 7]
    alone = [split(jax.random.key(seed), 3) for seed in (1, 2)]
    for i, keys in enumerate(split(both["key"], 3)):
        assert (keys == stacked([own[i] for own in alone])).all()


def test_games_whose_steps_differ(tmp_path):
    """An event of chance is no step, so that seeds have different numbers of them."""
    configs = [registry.resolve("pennies", "mfrl", "smoke", seed=seed) for seed in (0, 1, 2)]
    found = training.run_together(configs, tmp_path / "together", QuietReporter())
    assert_nearly_the_same(found, [training.run(each, tmp_path / "alone", QuietReporter()) for each in configs])


def test_each_dreams_as_it_would_alone_or_does_not(tmp_path, monkeypatch):
    monkeypatch.setattr(
        Config, "imagined_updates", lambda self, steps, known=None: 2 * (known is None or known > KNOWN)
    )
    configs = [registry.resolve("corridor", "m5", "smoke", MEASURED, seed) for seed in range(4)]
    found = training.run_together(configs, tmp_path / "together", QuietReporter())
    assert_nearly_the_same(found, [training.run(each, tmp_path / "alone", QuietReporter()) for each in configs])
    dreams = [tuple(tables(run, "metrics")["imagine/policy_loss"].notna()) for run in found]
    assert len(set(dreams)) > 1, "not in the same iterations as each other"


def test_all_at_once_as_on_an_accelerator(tmp_path, monkeypatch):
    configs = [registry.resolve("corridor", "mfrl", "smoke", seed=seed) for seed in (0, 1)]
    alone = [training.run(each, tmp_path / "alone", QuietReporter()) for each in configs]
    monkeypatch.setattr(layout, "takes_turns", lambda: False)
    assert_nearly_the_same(training.run_together(configs, tmp_path / "together", QuietReporter()), alone)


@pytest.mark.parametrize("agent_id", ["m1", "m6", "oracle"])
def test_every_phase_can_be_computed_all_at_once(agent_id, monkeypatch):
    monkeypatch.setattr(layout, "takes_turns", lambda: False)
    agent = Agent(registry.resolve("corridor", agent_id, "smoke"), Corridor(), seeds=2)
    state = jax.eval_shape(agent.init, stacked([start_key(seed) for seed in (0, 1)]))
    for _, program in first_programs(agent, state):
        assert {x.shape[0] for x in jax.tree.leaves(program.out_info)} == {2}
    keys, number, steps = (jax.ShapeDtypeStruct((2,), kind) for kind in (start_key(0).dtype, jnp.int32, jnp.float32))
    dreamt = None if state.world_model is None else state.world_model.dreaming
    arguments = (state.policy, dreamt, state.tokenizer, state.replay, keys, number, steps)
    policy, _ = jax.eval_shape(lambda *arguments: Agent.imagine(agent, *arguments), *arguments)
    assert jax.tree.map(np.shape, policy) == jax.tree.map(np.shape, state.policy)
