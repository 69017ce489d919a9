"""How fast each phase is, where the time goes, and how far that is from what the device can do (`suite bench`)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from suite import registry
from suite.agent.algorithm import iterate, iteration_key, start_key
from suite.agent.phases import Agent
from suite.benchmarks.collectives import share_in_collectives
from suite.benchmarks.comparisons import (
    Rows,
    compare_attention,
    compare_caches,
    compare_resets,
    compare_samplers,
    compare_starts,
    seconds_of,
)
from suite.benchmarks.flops import count_flops
from suite.configuration.schema import Config
from suite.records.record import peak_memory
from suite.runtime import layout
from suite.runtime.compilation import enable_compilation_cache
from suite.runtime.reporting import Reporter

MODEL_UPDATES = 2  # measured of the tokenizer's and the world model's, then scaled: on a CPU one can take seconds


def bench(config: Config, reporter: Reporter, start_up: bool = True, devices: int = 1) -> dict[str, Any]:
    """Measures a configuration on this machine. Run it alone: it shares its numbers with whatever else runs.

    Args:
      config: what to measure.
      reporter: where progress goes.
      start_up: also start the same command twice in new processes, with an empty and a filled cache.
      devices: between how many the phases' batches are split; then it also says how fast they are on one, and which
        share of the time of all devices their exchanges take.

    Returns:
      tables and numbers by title, for printing.
    """
    enable_compilation_cache()
    environment = registry.task(config.task).make()(progress=reporter.texture)
    measured = dataclasses.replace(
        config,
        tokenizer=dataclasses.replace(config.tokenizer, updates=min(MODEL_UPDATES, config.tokenizer.updates)),
        world_model=dataclasses.replace(config.world_model, updates=min(MODEL_UPDATES, config.world_model.updates)),
    )
    reporter.message("measuring the device's matrix products")
    peak: dict[str, float] = {
        kind: matmul_rate(kind) for kind in {config.policy.compute_type, config.world_model.compute_type}
    }
    report: dict[str, Any] = {f"matrix products, {kind} (GFLOP/s)": rate / 1e9 for kind, rate in peak.items()}
    agent = Agent(measured, environment)
    with layout.over(jax.local_devices()[:devices]):
        phases = phase_table(agent, config, peak, reporter)
    if devices > 1:
        reporter.message("measuring the same on one device")
        for row, alone in zip(phases, phase_table(agent, config, peak, reporter), strict=True):
            row["times one device's speed"] = alone["ms"] / row["ms"]
    report["phases of one iteration"] = phases
    report |= _summary(config, agent, phases)
    reporter.message("comparing ways to reset the environment")
    report["environment steps/s, random actions"] = compare_resets(config, environment)
    if config.world_model.enabled:
        reporter.message("comparing with and without the key-value cache")
        report["one imagined step"] = compare_caches(agent)
        reporter.message("comparing ways to compute attention")
        report["attention of one layer, forward and backward"] = compare_attention(agent)
        if samplers := compare_samplers(agent):
            report["one imagined frame"] = samplers
    if start_up:
        reporter.message("starting the same command twice")
        report["seconds to the first training step"] = compare_starts(config)
    report["peak memory (MiB)"] = {name: bytes_ / 2**20 for name, bytes_ in peak_memory().items()}
    return report


def matmul_rate(compute_type: str) -> float:
    """FLOP/s of a large square matrix product of random numbers, the ceiling that phases are compared with."""
    size = 2048 if jax.default_backend() == "cpu" else 8192
    a, b = (jax.random.normal(jax.random.key(i), (size, size), jnp.dtype(compute_type)) for i in range(2))
    product = jax.jit(jnp.matmul)
    jax.block_until_ready(product(a, b))
    return 2 * size**3 / seconds_of(lambda: product(a, b))


def phase_table(agent: Agent, config: Config, peak: dict[str, float], reporter: Reporter) -> Rows:
    """One row per phase of an iteration after warmup: time, share, and what it achieves.

    `agent` has few model updates, and one imagined one is measured; their time is scaled to `config`'s.
    """
    rows: Rows = []
    scales = {
        "tokenizer": config.tokenizer.updates / max(1, agent.config.tokenizer.updates),
        "world_model": config.world_model.updates / max(1, agent.config.world_model.updates),
        "imagine": config.imagination.updates,
    }

    def measure(phase: str, function: Callable[..., Any], *arguments: Any) -> Any:
        """Times a phase of Algorithm 1. The first of its results takes the place of the argument that is donated."""
        reporter.message(f"measuring {phase}")
        flops = count_flops(function, *arguments)
        donated = 1 if phase == "collect" else 0
        holder = [jax.block_until_ready(function(*arguments))]

        def call() -> Any:
            previous = holder[0][0] if isinstance(holder[0], tuple) else holder[0]
            holder[0] = function(*arguments[:donated], previous, *arguments[donated + 1 :])
            return holder[0]

        seconds = seconds_of(call)
        row = {} if layout.devices() == 1 else {"collectives %": 100 * share_in_collectives(call, layout.devices())}
        kind = (config.world_model if phase in ("tokenizer", "world_model") else config.policy).compute_type
        rows.append(
            {
                "phase": phase,
                "ms": 1e3 * seconds * scales.get(phase, 1),
                "share %": 0.0,
                "GFLOP/s": flops / seconds / 1e9,
                "% of matmul": 100 * flops / seconds / (peak[kind] * layout.devices()),
                **row,
            }
        )
        return holder[0]

    state = agent.init(start_key(config.seed))
    iterate(agent, state, iteration_key(config.seed, 0), 0, measure, lambda *_: 1 if config.dreams else 0)
    total = sum(row["ms"] for row in rows)
    for row in rows:
        row["share %"] = 100 * row["ms"] / total
    return rows


def _summary(config: Config, agent: Agent, phases: Rows) -> dict[str, Any]:
    """Rates of the phases, and from them the wall-clock of the whole run."""
    ms = {row["phase"]: row["ms"] for row in phases}
    steps = config.steps_per_iteration
    report: dict[str, Any] = {"environment steps/s while collecting": steps / (ms["collect"] / 1e3)}
    updates = sum(config.imagined_updates((i + 1) * steps) for i in range(config.iterations))
    seconds = config.iterations * sum(value for phase, value in ms.items() if phase != "imagine") / 1e3
    plan, model = config.imagination, config.world_model
    if config.dreams:
        imagined = plan.num_envs * plan.horizon
        report["imagined steps/s, learning included"] = imagined * plan.updates / (ms["imagine"] / 1e3)
        seconds += updates * ms["imagine"] / max(1, plan.updates) / 1e3
    if model.enabled:
        tokens = model.sequences * model.sequence_length * (agent.tokens.tokens_per_frame + 1) * model.updates
        report["world-model training tokens/s"] = tokens / (ms["world_model"] / 1e3)
    report["projected hours of the whole run"] = seconds / 3600
    return report
