"""What Algorithm 1's iterations share, and what they do not."""

from __future__ import annotations

import jax
import numpy as np

from suite import registry
from suite.agent.algorithm import evaluation_key, first_programs, iterate, iteration_key, start_key
from suite.agent.phases import Agent
from suite.records import checkpoint
from suite.runs.saved_model import Remainder, SavedModel
from suite.runtime.compilation import Ahead
from tests.tiny import WIDE_CORRIDOR, WideCorridor


def test_no_two_parts_of_any_two_runs_have_the_same_randomness():
    keys = []
    for seed in (0, 1, 7):
        keys += [start_key(seed), *(iteration_key(seed, i) for i in range(5))]
        keys += [evaluation_key(seed, step) for step in (0, 1_024, 2_048)]
    assert len({tuple(np.asarray(jax.random.key_data(key)).tolist()) for key in keys}) == len(keys)
    assert (jax.random.key_data(iteration_key(7, 3)) == jax.random.key_data(iteration_key(7, 3))).all()


def test_an_iteration_compiles_nothing_that_was_compiled_ahead(monkeypatch, tmp_path):
    """Neither a run's first one, nor the one that goes on from a checkpoint."""
    monkeypatch.setattr(registry, "TASKS", (*registry.TASKS, WIDE_CORRIDOR))
    config = registry.resolve(WIDE_CORRIDOR.id, "m6", "smoke")
    assert not config.tied_to_budget
    object.__setattr__(config, "protocol", None)  # so that whoever reads the budget fails
    agent = Agent(config, WideCorridor())
    key, ahead, compiled = start_key(0), Ahead(), []
    template = jax.eval_shape(agent.init, key)
    ahead.begin(first_programs(agent, template))
    state = agent.init(key)
    checkpoint.save(tmp_path, 0, SavedModel.of(state), Remainder.of(state).stored(), {}, keep=1)
    restored = checkpoint.restore_latest(tmp_path, SavedModel.of(template), Remainder.of(template).stored())

    def listen(event, seconds, **_):
        if event == "/jax/core/compile/backend_compile_duration":
            compiled.append(seconds)

    called = {}

    def call(phase, function, *arguments):
        ahead.wait(phase)
        before = len(compiled)
        result = jax.block_until_ready(function(*arguments))
        called.setdefault(phase, []).append(len(compiled) - before)
        return result

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        for start in (state, Remainder(**restored.resume).with_model(restored.model)):
            iterate(agent, start, iteration_key(0, 0), 0, call, lambda steps, known: 0)
        jax.jit(lambda x: x + 1)(1.0)
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
        ahead.close()
    assert compiled, "what is compiled is counted"
    assert called == {phase: [0, 0] for phase in called}
    assert called.keys() == {"collect", "remember", "learn", "tokenizer", "code", "world_model"}
