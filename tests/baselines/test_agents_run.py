"""Kinds of agents on a tiny task, and some on others: two iterations of Algorithm 1, the second one dreams."""

from __future__ import annotations

import pandas as pd
import pytest

from suite import registry
from suite.runs import training
from suite.runtime.reporting import QuietReporter
from tests.tiny import WIDE_CORRIDOR

# Of these each setting runs in another agent, and test_presets says which settings those are. What m6 lacks without one
# of its parts, m5 lacks too. m2 is m1 that learns as m5 does, m4 and m5_no_btf are m3 with the tokens of m5, m5_no_nnt
# is m5 with those of m3, m5_no_nnt_no_patches with those of m1, and m5_no_dyna learns as m1 does. The others differ
# from m5 or mfrl in numbers. test_api trains m6, and m5 on Breakout.
ALIKE = {agent for agent in registry.agents() if agent.startswith("m6_no_")}
ALIKE |= {
    "m2",
    "m4",
    "m5_no_btf",
    "m5_no_nnt",
    "m5_no_nnt_no_patches",
    "m5_no_dyna",
    "m5_annealed",
    "m5_patch9",
    "m5_slow",
    "m5_tbp0",
    "m6",
    "mfrl_small",
}
AGENTS = sorted(registry.agents().keys() - ALIKE)


@pytest.mark.parametrize(
    ("task", "agent"),
    [("wide_corridor", agent) for agent in AGENTS]
    + [("openspiel/tic_tac_toe", "m6"), ("openspiel/tic_tac_toe", "oracle")],  # of symbols, with turns
)
def test_two_iterations(task, agent, tmp_path, monkeypatch):
    monkeypatch.setattr(registry, "TASKS", (*registry.TASKS, WIDE_CORRIDOR))
    # An m6 of two iterations knows nothing of rewards, so that it is made to dream.
    overrides = ["imagination.trust=0", "imagination.trust_window=0"] if agent == "m6" else []
    config = registry.resolve(task, agent, "smoke", overrides)
    result = training.run(config, tmp_path, QuietReporter())
    assert (result.status, result.steps) == ("finished", config.protocol.steps)
    metrics = pd.read_csv(result.folder / "metrics.csv")
    assert len(metrics) == 2
    last = metrics.iloc[-1].dropna().index
    phases = {name.partition("/")[0] for name in last if "/" in name}
    expected = {"learn"} if config.ppo.learn_from_real else set()
    if config.dreams:
        expected.add("imagine")
    if config.world_model.enabled:
        codes_to_learn = config.tokenizer.kind != "continuous" and not task.startswith("openspiel/")
        expected |= {"world_model"} | ({"tokenizer"} if codes_to_learn else set())
    assert phases == expected
