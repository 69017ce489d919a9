"""The benchmark measures every phase, and its projection adds up. No speed is asserted."""

from __future__ import annotations

import pytest

from suite import registry
from suite.benchmarks import comparisons, phases
from suite.runtime.reporting import QuietReporter
from tests.tiny import CORRIDOR
from tests.walks import Walks


def test_every_phase_is_measured_and_projected(monkeypatch):
    monkeypatch.setattr(registry, "TASKS", (*registry.TASKS, CORRIDOR))
    monkeypatch.setattr(comparisons, "NUM_ENVS", 4)
    monkeypatch.setattr(comparisons, "NUM_STEPS", 8)
    config = registry.resolve("corridor", "m5", "smoke")
    report = phases.bench(config, QuietReporter(), start_up=False)
    shown = {row["phase"]: row for row in report["phases of one iteration"]}
    assert list(shown) == ["collect", "remember", "learn", "tokenizer", "code", "world_model", "imagine"]
    assert sum(row["share %"] for row in shown.values()) == pytest.approx(100)
    assert all(shown[name]["GFLOP/s"] > 0 for name in ("collect", "learn", "world_model", "imagine"))
    # Six iterations of everything; two imagined updates in each of the last four.
    ms = {name: row["ms"] for name, row in shown.items()}
    seconds = (6 * (sum(ms.values()) - ms["imagine"]) + 4 * ms["imagine"]) / 1e3
    assert report["projected hours of the whole run"] == pytest.approx(seconds / 3600)
    assert [row["environment"] for row in report["environment steps/s, random actions"]] == [
        "exact auto-reset",
        "no reset",
    ]
    assert report["one imagined step"][0]["times faster"] > 0
    assert [row["tokens"] for row in report["one imagined frame"]] == ["as a block", "token by token"]
    assert all(row["ms"] > 0 for row in report["one imagined frame"])
    attention = report["attention of one layer, forward and backward"]
    assert [row["attention"] for row in attention] == ["ours, plain operations", "jax.nn.dot_product_attention"]


def test_hosted_engines_are_compared_without_the_variant_that_plays_past_the_end(monkeypatch):
    monkeypatch.setattr(comparisons, "NUM_ENVS", 2)
    monkeypatch.setattr(comparisons, "NUM_STEPS", 30)
    monkeypatch.setattr(registry, "TASKS", (*registry.TASKS, CORRIDOR))
    (row,) = comparisons.compare_resets(registry.resolve("corridor", "m5", "smoke"), Walks())
    assert row["environment"] == "exact auto-reset" and row["steps/s"] > 0
