"""Every agent on a tiny task, and the ladder on MinAtar: two whole iterations of Algorithm 1, the second one dreams."""

from __future__ import annotations

import jax
import pandas as pd
import pytest

from suite import registry, run
from suite.reporting import QuietReporter
from tests.tiny import WIDE_CORRIDOR


@pytest.fixture(autouse=True, scope="module")
def hasty_compilation():
    """Twenty agents are compiled here to run for a moment each."""
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


RUNGS = ("m1", "m3", "m5")  # m2 and m4 differ from these in what the tiny task shows as well


@pytest.mark.parametrize(
    ("task", "agent"),
    [("wide_corridor", agent) for agent in sorted(registry.agents())]
    + [("minatar/breakout", agent) for agent in RUNGS],  # as the paper's Figure "MinAtar"
)
def test_two_iterations(task, agent, tmp_path, monkeypatch):
    monkeypatch.setattr(registry, "TASKS", (*registry.TASKS, WIDE_CORRIDOR))
    config = registry.resolve(task, agent, "smoke")
    result = run.run(config, tmp_path, QuietReporter())
    assert (result.status, result.steps) == ("finished", 64)
    metrics = pd.read_csv(result.folder / "metrics.csv")
    assert len(metrics) == 2
    last = metrics.iloc[-1].dropna().index
    phases = {name.partition("/")[0] for name in last if "/" in name}
    expected = {"learn"} if config.ppo.learn_from_real else set()
    if config.world_model.enabled:
        expected |= {"world_model", "imagine"} | ({"tokenizer"} if config.tokenizer.kind != "continuous" else set())
    assert phases == expected
