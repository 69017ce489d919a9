"""The paper's tables of hyperparameters, row by row (Appendix A). A changed one fails here."""

from __future__ import annotations

import pytest

from suite import registry
from suite.overrides import dotted

# Table "MFRL hyperparameters"; sizes of layers are counted in test_describe.
MFRL_TABLE = {
    "environment.num_envs": 48,
    "environment.rollout_length": 96,
    "policy.rnn_size": 256,
    "policy.hidden_size": 2048,
    "ppo.discount": 0.925,
    "ppo.gae_lambda": 0.625,
    "ppo.clip": 0.2,
    "ppo.value_coefficient": 1.0,
    "ppo.entropy_coefficient": 0.01,
    "ppo.target_decay": 0.95,
    "ppo.learning_rate": 0.00045,
    "ppo.max_grad_norm": 0.5,
    "ppo.minibatches": 8,
    "ppo.epochs": 4,
}
# Table "Hyperparameters for the transformer world model".
TWM_TABLE = {
    "world_model.sequence_length": 20,
    "world_model.embed_dim": 128,
    "world_model.layers": 3,
    "world_model.heads": 8,
    "world_model.block_teacher_forcing": True,
    "world_model.dropout": 0.1,
    "world_model.learning_rate": 0.001,
    "world_model.max_grad_norm": 0.5,
}
# Table "MBRL main parameters".
MBRL_TABLE = {
    "environment.num_envs": 48,
    "environment.rollout_length": 96,
    "imagination.horizon": 20,
    "environment.burn_in": 5,
    "replay.capacity": 128_000,
    "tokenizer.updates": 25,
    "world_model.updates": 500,
    "world_model.minibatches": 3,
    "imagination.start_step": 200_000,
    "imagination.updates": 150,
    "ppo.minibatches": 8,
    "imagination.minibatches": 1,
    "ppo.epochs": 4,
    "imagination.epochs": 1,
    "ppo.anneal_learning_rate": False,
}
# What the text and the fidelity notes add to the tables: the note's number.
NOTES = {
    "protocol.steps": 1_000_000,
    "protocol.final_fraction": 0.1,  # 29
    "policy.kind": "actor_critic",
    "policy.cnn_channels": (64, 128, 128),  # table of parameter counts
    "policy.blocks_per_stack": 2,
    "policy.convs_per_block": 2,
    "policy.max_pixels": 63,  # 4
    "policy.cnn_norm": "instance",  # 1
    "policy.activation": "relu",
    "policy.dense_blocks": 2,
    "policy.shared_trunk": False,
    "ppo.target_min_std": 0.1,  # 8
    "ppo.adam_eps": 1e-5,  # 9
    "ppo.learn_from_real": True,
}
MODEL_NOTES = {
    "tokenizer.kind": "nearest_neighbor",
    "tokenizer.codebook_size": 4096,
    "tokenizer.threshold": 0.75,  # 13
    "tokenizer.patch": None,  # the task's natural one: 7x7
    "world_model.enabled": True,
    "world_model.positions": "flat",  # 20
    "world_model.mask_after_done": False,  # 21
    "world_model.symbol_places": True,  # games only
    "world_model.initial_std": 0.02,  # GPT-2's
    "world_model.reward_classes": None,  # the task's levels: 22
    "world_model.sequences": 48,
    "world_model.reward_weight": 1.0,  # 23
    "world_model.adam_eps": 1e-5,  # 23
    "imagination.num_envs": 48,
    "imagination.schedule": "constant",
    "imagination.entropy_coefficient": 0.01,
}


def settings(agent, preset="paper", **options):
    return dotted(registry.resolve("craftax_classic", agent, preset, **options))


def assert_contains(found, expected):
    assert {name: found[name] for name in expected} == expected


@pytest.mark.parametrize("table", [MFRL_TABLE, TWM_TABLE, MBRL_TABLE, NOTES, MODEL_NOTES])
def test_m5_is_the_papers(table):
    assert_contains(settings("m5"), table)


def test_mfrl_is_the_papers():
    assert_contains(
        settings("mfrl"), MFRL_TABLE | NOTES | {"ppo.anneal_learning_rate": True, "world_model.enabled": False}
    )


def test_the_tables_leave_out_no_hyperparameter():
    """A new field must be given its value for the paper here, or be named as no hyperparameter."""
    elsewhere = {"task", "agent", "preset", "seed", "environment.burn_in_start", "policy.compute_type"}
    elsewhere |= {"world_model.compute_type", "checkpoint.every_steps", "checkpoint.keep"}
    covered = (MFRL_TABLE | TWM_TABLE | MBRL_TABLE | NOTES | MODEL_NOTES).keys()
    assert settings("m5").keys() - covered == elsewhere


def test_m5_slow_differs_in_world_model_updates_only():
    """4000 instead of 500: fidelity note 27."""
    slow, fast = settings("m5_slow"), settings("m5")
    assert {name: value for name, value in slow.items() if value != fast[name]} == {
        "agent": "m5_slow",
        "world_model.updates": 4000,
    }


def test_random_learns_nothing():
    expected = {"policy.kind": "uniform", "ppo.learn_from_real": False, "world_model.enabled": False}
    assert_contains(settings("random"), expected)


@pytest.mark.parametrize("preset", ["paper", "small", "smoke"])
@pytest.mark.parametrize("agent", sorted(registry.agents()))
def test_every_agent_has_every_preset(agent, preset):
    config = registry.resolve("craftax_classic", agent, preset)
    assert config.iterations >= 2
    assert (config.agent, config.preset) == (agent, preset)


@pytest.mark.parametrize("preset", ["small", "smoke"])
def test_a_preset_keeps_what_defines_an_agent(preset):
    assert not settings("mfrl", preset)["world_model.enabled"]
    assert settings("m5_slow", preset)["world_model.updates"] == 8 * settings("m5", preset)["world_model.updates"]


@pytest.mark.parametrize("preset", ["small", "smoke"])
def test_m5_imagines_in_every_preset(preset):
    config = registry.resolve("craftax_classic", "m5", preset)
    assert config.imagined_updates(config.total_steps) > 0
    assert config.imagined_updates(config.steps_per_iteration) == 0  # warmup first


def test_schedule_of_imagined_updates():
    config = registry.resolve("craftax_classic", "m5", "paper")
    counts = [config.imagined_updates((i + 1) * config.steps_per_iteration) for i in range(config.iterations)]
    assert (config.iterations, sum(counts), counts.index(150)) == (217, 174 * 150, 43)
    linear = ["imagination.schedule=linear", "imagination.start_step=0", "imagination.updates=300"]
    config = registry.resolve("craftax_classic", "m5", "paper", linear)
    assert [config.imagined_updates(step) for step in (0, 500_000, 1_000_000)] == [0, 150, 300]


@pytest.mark.parametrize(
    ("game", "memory"),
    [("tic_tac_toe", False), ("leduc", True), ("bargaining", True), ("nim", False), ("kuhn_poker", True)],
)
def test_a_memory_only_where_something_is_hidden(game, memory):
    for preset in ("paper", "small", "smoke"):
        assert bool(registry.resolve(f"openspiel/{game}", "m5", preset).policy.rnn_size) == memory
