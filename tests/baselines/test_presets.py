"""The paper's tables of hyperparameters, row by row (Appendix A). A changed one fails here."""

from __future__ import annotations

import pytest

from suite import registry
from suite.configuration.overrides import dotted

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
    "policy.embedding_size": 0,
    "policy.shared_trunk": False,
    "ppo.target_min_std": 0.1,  # 8
    "ppo.target_spread": "deviation",  # 8
    "ppo.adam_eps": 1e-5,  # 9
    "ppo.learn_from_real": True,
    "evaluation.every_steps": 50_000,  # Section 4.6
    "evaluation.episodes": 32,
}
MODEL_NOTES = {
    "tokenizer.kind": "nearest_neighbor",
    "tokenizer.codebook_size": 4096,
    "tokenizer.threshold": 0.75,  # 13
    "tokenizer.patch": None,  # the task's natural one: 7x7
    "tokenizer.embed_dim": 128,  # 15; these four belong to the VQ-VAEs
    "tokenizer.channels": (64, 64, 128, 128, 256),
    "tokenizer.loss_weights": (1.0, 0.0, 1.0, 0.25),
    "tokenizer.learning_rate": 0.001,
    "world_model.enabled": True,
    "world_model.positions": "flat",  # 20
    "world_model.mask_after_done": False,  # 21
    "world_model.correspondence": False,  # this and the next six are not the paper's
    "world_model.correspondence_radius": 1,
    "world_model.local_embedding": 0,
    "world_model.action_in_tokens": False,
    "world_model.place_heads": False,
    "world_model.ages": 0,
    "world_model.patch_contents": False,
    "world_model.paid": 0,
    "world_model.event_share": 0.0,
    "world_model.token_noise": 0.0,
    "world_model.optimizer": "adam",  # 23
    "world_model.average": 0.0,
    "imagination.min_p": 0.0,
    "imagination.trust": 0.0,
    "imagination.trust_window": 0,
    "imagination.world": "model",
    "imagination.recent": 0,  # Algorithm 1 samples the whole buffer
    "imagination.context": 0,  # 24
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
    elsewhere |= {"world_model.compute_type", "world_model.attention"}
    elsewhere |= {"checkpoint.every_steps", "checkpoint.keep", "checkpoint.keep_resume"}
    covered = (MFRL_TABLE | TWM_TABLE | MBRL_TABLE | NOTES | MODEL_NOTES).keys()
    assert settings("m5").keys() - covered == elsewhere


# Section 4.1 and Table 2: what each model-based agent changes of M5.
NO_BTF = {"world_model.block_teacher_forcing": False}
NO_DYNA = {"ppo.learn_from_real": False}
PATCH_VQ = {
    "tokenizer.kind": "patch_vq_vae",
    "tokenizer.codebook_size": 512,
    "tokenizer.updates": 500,
    "tokenizer.loss_weights": (0.1, 1.0, 1.0, 0.02),
}
FRAME_VQ = {"tokenizer.kind": "vq_vae", "tokenizer.codebook_size": 512, "tokenizer.updates": 500}  # 15
FROM_M5 = {
    "m1": FRAME_VQ | NO_BTF | NO_DYNA,
    "m2": FRAME_VQ | NO_BTF,
    "m3": PATCH_VQ | NO_BTF,
    "m4": NO_BTF,
    "m5_slow": {"world_model.updates": 4000},  # 27
    "m5_patch5": {"tokenizer.patch": (5, 5)},
    "m5_patch9": {"tokenizer.patch": (9, 9)},
    "m5_continuous": {"tokenizer.kind": "continuous"},
    "m5_no_dyna": NO_DYNA,
    "m5_no_nnt": PATCH_VQ,
    "m5_no_nnt_no_patches": FRAME_VQ,
    "m5_no_btf": NO_BTF,
    "m5_tbp0": {"imagination.start_step": 0},
    "m5_annealed": {  # 38
        "imagination.schedule": "linear",
        "imagination.start_step": 0,
        "imagination.updates": 300,
    },
}
# Beyond the paper: docs/agents.md.
M6 = {
    "correspondence": {"world_model.correspondence": True},
    "grid": {"world_model.positions": "grid"},
    "local": {"world_model.local_embedding": 16},
    "contents": {},  # of MinAtar alone
    "action": {"world_model.action_in_tokens": True},
    "min_p": {},  # of games of two players alone
    "places": {"world_model.place_heads": True},
    "ages": {"world_model.ages": 15},
    "muon": {"world_model.optimizer": "muon", "world_model.learning_rate": 0.003},
    "games": {},  # of two players alone
    "average": {"world_model.average": 0.99},
    "codes": {"tokenizer.threshold": 0.5, "tokenizer.codebook_size": 8192},
    "events": {"world_model.event_share": 0.3},
    "paid": {"world_model.paid": 8},
    "noise": {"world_model.token_noise": 0.03},
    "trust": {"imagination.trust": 0.5, "imagination.trust_window": 10},
}


def without(missing=None):
    return {name: value for part, changes in M6.items() if part != missing for name, value in changes.items()}


FROM_M5 |= {"m6": without()} | {f"m6_no_{part}": without(part) for part in M6}
FROM_M5["oracle"] = {"world_model.enabled": False, "imagination.world": "game"}
PRIOR_SIZES = {"policy.embedding_size": 256, "policy.hidden_size": 1024}
FROM_MFRL = {
    "mfrl_no_rnn": {"policy.rnn_size": 0},
    "mfrl_small": PRIOR_SIZES | {"policy.dense_blocks": 0},
    "mfrl_prior": PRIOR_SIZES  # 36
    | {
        "policy.kind": "moon",
        "policy.rnn_size": 0,
        "environment.num_envs": 8,
        "environment.rollout_length": 512,
        "environment.burn_in": 0,
        "ppo.discount": 0.95,
        "ppo.gae_lambda": 0.65,
        "ppo.value_coefficient": 0.5,
        "ppo.target_decay": 0.99,
        "ppo.target_spread": "mean_square",
        "ppo.learning_rate": 3e-4,
        "ppo.anneal_learning_rate": False,
        "ppo.adam_eps": 1e-8,
        "ppo.epochs": 3,
    },
}


@pytest.mark.parametrize(
    ("base", "agent", "changes"),
    [("m5", *item) for item in FROM_M5.items()] + [("mfrl", *item) for item in FROM_MFRL.items()],
)
def test_an_agent_differs_in_what_defines_it_and_in_nothing_else(base, agent, changes):
    found, reference = settings(agent), settings(base)
    different = {name: value for name, value in found.items() if value != reference[name]}
    assert different == {"agent": agent, **changes}


@pytest.mark.parametrize(("task", "least"), [("openspiel/tic_tac_toe", 0.2), ("minatar/breakout", 0.0)])
def test_m6_dreams_what_is_improbable_but_in_games_of_two_players(task, least):
    assert registry.resolve(task, "m6", "small").imagination.min_p == least
    assert registry.resolve(task, "m6_no_min_p", "small").imagination.min_p == 0


def test_m6_knows_what_codes_look_like_in_minatar_alone():
    for task in ("minatar/asterix", "craftax_classic", "openspiel/leduc"):
        m6, without = (registry.resolve(task, agent, "small").world_model for agent in ("m6", "m6_no_contents"))
        assert (m6.patch_contents, without.patch_contents) == (task == "minatar/asterix", False)


def test_m6_learns_games_of_two_players_from_more_at_a_lower_rate():
    for task, preset in (("openspiel/tic_tac_toe", "small"), ("openspiel/bargaining", "paper")):
        model, plain = (registry.resolve(task, agent, preset).world_model for agent in ("m6", "m6_no_games"))
        assert (model.learning_rate, plain.learning_rate) == (0.001, 0.003)
        assert model.sequences == 2 * plain.sequences


@pytest.mark.parametrize(("task", "trust"), [("openspiel/bargaining", 0.9), ("minatar/asterix", 0.5)])
def test_m6_asks_more_of_its_model_in_games_of_two_players(task, trust):
    assert registry.resolve(task, "m6", "small").imagination.trust == trust
    assert registry.resolve(task, "m6_no_trust", "small").imagination.trust == 0


@pytest.mark.parametrize(("task", "threshold", "size"), [("craftax_full", 0.5, 1024), ("minatar/breakout", 0.75, 512)])
def test_m6_has_a_finer_codebook_on_craftax_alone(task, threshold, size):
    tokenizer = registry.resolve(task, "m6", "small").tokenizer
    assert (tokenizer.threshold, tokenizer.codebook_size) == (threshold, size)
    coarse = registry.resolve(task, "m6_no_codes", "small").tokenizer
    assert (coarse.threshold, coarse.codebook_size) == (0.75, 512)


def test_every_agent_of_the_paper_is_held_against_it():
    of_the_paper = {id for id, entry in registry.agents().items() if entry.row}
    assert of_the_paper <= FROM_M5.keys() | FROM_MFRL.keys() | {"m5", "mfrl"}


@pytest.mark.parametrize("agent", ["m1", "m5_no_dyna"])
def test_without_dyna_nothing_is_learned_before_imagination(agent):
    """Fidelity note 26."""
    config = registry.resolve("craftax_classic", agent, "paper")
    assert not config.ppo.learn_from_real and config.imagined_updates(199_999) == 0


def test_annealed_updates_grow_to_300():
    config = registry.resolve("craftax_classic", "m5_annealed", "paper")
    assert [config.imagined_updates(step) for step in (0, 500_000, 1_000_000)] == [0, 150, 300]


def test_random_learns_nothing():
    expected = {"policy.kind": "uniform", "ppo.learn_from_real": False, "world_model.enabled": False}
    assert_contains(settings("random"), expected)


@pytest.mark.parametrize("task", ["craftax_classic", "craftax_full", "minatar/breakout"])
@pytest.mark.parametrize("preset", ["paper", "medium", "small", "smoke"])
@pytest.mark.parametrize("agent", sorted(registry.agents()))
def test_every_agent_has_every_preset(agent, preset, task):
    config = registry.resolve(task, agent, preset)
    assert config.iterations >= 2
    assert (config.agent, config.preset) == (agent, preset)


@pytest.mark.parametrize("preset", ["small", "smoke"])
def test_a_preset_keeps_what_defines_an_agent(preset):
    m5 = settings("m5", preset)
    assert not settings("mfrl", preset)["world_model.enabled"]
    assert settings("m5_slow", preset)["world_model.updates"] == 8 * m5["world_model.updates"]
    for agent in ("m1", "m3", "m5_no_nnt"):
        found = settings(agent, preset)
        assert found["tokenizer.updates"] == m5["world_model.updates"]
        assert found["tokenizer.codebook_size"] == min(512, m5["tokenizer.codebook_size"])
    assert settings("m5_annealed", preset)["imagination.updates"] == 2 * m5["imagination.updates"]
    assert settings("mfrl_prior", preset)["policy.hidden_size"] == m5["policy.hidden_size"] // 2


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
    ("agent", "changes"),
    [
        ("mfrl", {"environment.num_envs": 64, "environment.rollout_length": 64}),
        (
            "m5_slow",
            {
                "environment.num_envs": 16,
                "replay.capacity": 48_000,
                "imagination.num_envs": 16,
                "world_model.sequences": 15,  # 16 do not split into three minibatches
            },
        ),
    ],
)
def test_craftax_full_differs_from_classic_in_what_the_paper_says_and_in_nothing_else(agent, changes):
    """Table "Craftax-classic vs Craftax (full)" and fidelity note 28."""
    ours = dotted(registry.resolve("craftax_full", agent, "paper"))
    different = {name: value for name, value in ours.items() if value != settings(agent)[name]}
    assert different == {"task": "craftax_full", **changes}


@pytest.mark.parametrize("agent", sorted(registry.agents()))
def test_craftax_full_s_model_free_agents_are_those_without_a_model(agent):
    config = registry.resolve("craftax_full", agent, "paper")
    assert config.replay.capacity == (48_000 if config.dreams else 128_000)


def test_another_distribution_s_agent_without_a_model_gets_the_sizes_of_those(monkeypatch):
    theirs = registry.AgentEntry("theirs", registry.Lazy("baselines.model_free:mfrl"), "plays for itself")
    monkeypatch.setattr(registry, "AGENTS", (*registry.AGENTS, theirs))
    assert registry.resolve("craftax_full", "theirs", "paper").environment.num_envs == 64


@pytest.mark.parametrize("game", ["asterix", "breakout", "freeway", "seaquest", "space_invaders"])
def test_minatar_differs_from_craftax_in_what_the_paper_says_and_in_nothing_else(game):
    """Tables "MFRL changes for MinAtar" and "MBRL changes for MinAtar"."""
    ours = dotted(registry.resolve(f"minatar/{game}", "m5", "paper"))
    different = {name: value for name, value in ours.items() if value != settings("m5")[name]}
    assert different == {
        "task": f"minatar/{game}",
        "policy.cnn_norm": "layer",
        "policy.activation": "swish",
        "policy.shared_trunk": True,
        "ppo.discount": 0.95,
        "ppo.gae_lambda": 0.75,
        "ppo.target_decay": 0.925,
        "world_model.updates": 2_000,
        "world_model.reward_weight": 10.0,
        "imagination.updates": 2_000,
        "imagination.entropy_coefficient": 0.05,
    }


@pytest.mark.parametrize(
    ("game", "memory"),
    [("tic_tac_toe", False), ("leduc", True), ("bargaining", True), ("nim", False), ("kuhn_poker", True)],
)
def test_a_memory_only_where_something_is_hidden(game, memory):
    for preset in ("paper", "small", "smoke"):
        assert bool(registry.resolve(f"openspiel/{game}", "m5", preset).policy.rnn_size) == memory


def test_which_agents_are_tied_to_their_budget():
    """All others can be given more steps when they have finished."""
    tied = {id: registry.resolve("craftax_classic", id, "paper").tied_to_budget for id in registry.agents()}
    annealed = ("ppo.anneal_learning_rate=true",)
    expected = dict.fromkeys(("mfrl", "mfrl_no_rnn", "mfrl_small"), annealed)
    expected["m5_annealed"] = ("imagination.schedule=linear",)
    assert {id: names for id, names in tied.items() if names} == expected
