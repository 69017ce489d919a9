from __future__ import annotations

import pytest

from suite import registry
from suite.registry import AgentEntry, Lazy
from suite.runtime.errors import UserError

PUBLISHED = {  # Tables 1 and 2: reward, score
    "mfrl": ("55.49 +- 1.33 %", "16.77 +- 1.11 %"),
    "mfrl_no_rnn": ("41.82 +- 0.97 %", "8.33 +- 0.44 %"),
    "mfrl_small": ("51.35 +- 0.80 %", "12.93 +- 0.56 %"),
    "mfrl_prior": ("47.40 +- 0.58 %", "10.71 +- 0.29 %"),
    "m1": ("31.93 +- 2.22 %", "4.98 +- 0.50 %"),
    "m2": ("43.36 +- 1.84 %", "8.85 +- 0.63 %"),
    "m3": ("58.92 +- 1.03 %", "19.36 +- 1.42 %"),
    "m4": ("64.96 +- 1.13 %", "25.55 +- 0.86 %"),
    "m5": ("67.42 +- 0.55 %", "27.91 +- 0.63 %"),
    "m5_slow": ("69.66 +- 1.20 %", "31.77 +- 1.43 %"),
    "m5_patch5": ("57.28 +- 1.14 %", "18.26 +- 1.18 %"),
    "m5_patch9": ("45.55 +- 0.88 %", "10.12 +- 0.40 %"),
    "m5_continuous": ("21.20 +- 0.55 %", "2.43 +- 0.09 %"),
    "m5_no_dyna": ("55.02 +- 5.34 %", "18.79 +- 2.14 %"),
    "m5_no_nnt": ("60.66 +- 1.38 %", "21.79 +- 1.33 %"),
    "m5_no_nnt_no_patches": ("45.86 +- 1.42 %", "10.36 +- 0.69 %"),
    "m5_no_btf": ("64.96 +- 1.13 %", "25.55 +- 0.86 %"),
    "m5_tbp0": ("33.54 +- 10.09 %", "12.86 +- 4.05 %"),
}


def test_published_numbers():
    published = {id: f"reward {reward}, score {score}" for id, (reward, score) in PUBLISHED.items()}
    published |= {"m5_annealed": "reward 65.71 +- 1.11 %"}  # Section 4.3 gives no score
    agents = registry.agents()
    assert {id: entry.published for id, entry in agents.items() if entry.published} == published
    assert {id for id, entry in agents.items() if entry.row} == published.keys()
    assert all(agents[id].row.startswith(("Table ", "Appendix ")) for id in published)


def test_docstrings_name_the_published_numbers():
    for id, entry in registry.agents().items():
        text = entry.configure().__doc__
        for number in entry.published.replace("reward ", "").replace("score ", "").split(", "):
            assert number.removesuffix(" %") in text, id


def test_everything_registered_can_be_imported():
    for task in registry.tasks().values():
        for lazy in (task.make, task.scores, *task.presets.values()):
            assert callable(lazy())
        assert task.spec().id == task.id
        assert task.presets.keys() <= registry.presets().keys() and {"small", "smoke"} <= task.presets.keys()
    for agent in registry.agents().values():
        assert callable(agent.configure())


def test_the_catalog_names_each_part_where_it_lives():
    """Imports by strings, which the import linter does not see."""
    tasks, agents = registry.tasks().values(), registry.agents().values()
    named = {
        "adapters": [lazy for task in tasks for lazy in (task.spec, task.make, task.own_auto_reset, task.symbols)],
        "leaderboards.scoring": [task.scores for task in tasks],
        "baselines": [lazy for task in tasks for lazy in task.presets.values()] + [a.configure for a in agents],
    }
    for place, parts in named.items():
        modules = {lazy.reference.partition(":")[0] for lazy in parts if lazy is not None}
        assert modules and all(f"{module}.".startswith(f"{place}.") for module in modules), place


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("craftax_clasic", "m5", "paper"), "unknown task 'craftax_clasic'; did you mean 'craftax_classic'?"),
        (("craftax_classic", "mrfl", "paper"), "unknown agent 'mrfl'; did you mean 'mfrl'?"),
        (("craftax_classic", "zzz", "paper"), f"unknown agent 'zzz'; valid: {', '.join(sorted(registry.agents()))}"),
        (("craftax_classic", "m5", "papr"), "unknown preset 'papr'; did you mean 'paper'?"),
    ],
)
def test_unknown_ids(arguments, message):
    with pytest.raises(UserError) as caught:
        registry.resolve(*arguments)
    assert str(caught.value) == message


def test_the_preset_fits_the_machine(monkeypatch):
    monkeypatch.setattr(registry, "_on_accelerator", lambda: True)
    config = registry.resolve("craftax_classic")
    assert (config.preset, config.policy.compute_type, config.world_model.compute_type) == (
        "paper",
        "bfloat16",
        "bfloat16",
    )
    monkeypatch.setattr(registry, "_on_accelerator", lambda: False)
    config = registry.resolve("craftax_classic")
    assert (config.preset, config.policy.compute_type) == ("small", "float32")


def test_the_user_has_the_last_word():
    overrides = ["world_model.updates=7", "policy.compute_type=bfloat16"]
    layers = registry.layers("craftax_classic", "m5_slow", "small", overrides, seed=3, steps=20_000)
    assert [source for source, _ in layers] == ["default", "preset", "agent", "user"]
    config = layers[-1][1]
    assert (config.seed, config.protocol.steps, config.world_model.updates) == (3, 20_000, 7)
    assert config.policy.compute_type == "bfloat16"


class Point:
    """An entry point of another distribution."""

    name = "theirs"

    def __init__(self, load):
        self.load = load


def install(monkeypatch, load):
    monkeypatch.setattr(registry, "_entry_points", lambda group: [Point(load)])


def test_other_distributions_add_but_do_not_replace(monkeypatch):
    install(monkeypatch, lambda: AgentEntry("theirs", Lazy("baselines.ladder:m5"), "an agent"))
    assert "theirs" in registry.agents()
    install(monkeypatch, lambda: AgentEntry("m5", Lazy("nowhere:m5"), "an impostor"))
    assert registry.agents()["m5"].summary != "an impostor"


def broken():
    raise ImportError("no module named x")


@pytest.mark.parametrize(("load", "message"), [(broken, "cannot be loaded"), (lambda: 3, "is no AgentEntry")])
def test_a_broken_entry_point_is_named(monkeypatch, load, message):
    install(monkeypatch, load)
    with pytest.raises(UserError, match=f"'theirs'.*{message}"):
        registry.agents()


def test_a_task_without_the_default_preset(monkeypatch):
    import dataclasses

    entry = registry.task("craftax_classic")
    entry = dataclasses.replace(entry, presets={"smoke": entry.presets["smoke"]})
    monkeypatch.setattr(registry, "TASKS", (entry,))
    assert registry.resolve("craftax_classic").preset == "smoke"


@pytest.mark.parametrize("id", ["openspiel/kuhn_poker", "gymnasium/FrozenLake-v1", "pettingzoo/connect_four_v3"])
def test_a_family_has_more_tasks_than_are_listed(id):
    entry = registry.task(id)
    assert id not in registry.tasks()
    assert entry.id == entry.spec().id == id
    for lazy in (entry.make, entry.scores, *entry.presets.values()):
        assert callable(lazy())
    assert registry.resolve(id, preset="small").task == id


@pytest.mark.parametrize(
    ("id", "message"),
    [
        ("openspiel/leduk", "leduc"),
        ("openspiel/", "unknown task 'openspiel/'"),
        ("gymnasium/FrozenLak-v1", "FrozenLake"),
        ("pettingzoo/connect_five_v3", "connect_four"),
        ("minatari/breakout", "unknown task 'minatari/breakout'"),
    ],
)
def test_a_wrong_name_in_a_family_is_one_line(id, message):
    with pytest.raises(UserError, match=message) as caught:
        registry.resolve(id)
    assert "\n" not in str(caught.value)


def test_presets_of_the_games():
    """The paper's table for OpenSpiel, and fidelity note 6: a memory only where something is hidden."""
    config = registry.resolve("openspiel/leduc", "m5", "paper")
    assert (config.protocol.steps, config.imagination.start_step) == (100_000, 0)
    assert (config.world_model.updates, config.imagination.updates) == (2_000, 2_000)
    assert config.imagination.entropy_coefficient == 0.05 and config.ppo.entropy_coefficient == 0.01
    assert config.world_model.reward_weight == 1.0 and config.policy.shared_trunk
    assert (config.ppo.discount, config.ppo.gae_lambda, config.ppo.target_decay) == (0.925, 0.625, 0.95)
    assert config.policy.rnn_size == 256
    assert registry.resolve("openspiel/tic_tac_toe", "m5", "paper").policy.rnn_size == 0


@pytest.mark.parametrize(
    ("task", "preset", "agent"),
    [
        ("craftax_full", "paper", "m5_slow"),  # its table reports the slow one
        ("craftax_full", "small", "m5"),
        ("craftax_classic", "paper", "m5"),
        ("minatar/breakout", "paper", "m5"),
    ],
)
def test_the_agent_that_runs_unless_another_is_named(task, preset, agent):
    assert registry.resolve(task, preset=preset).agent == agent
    assert registry.resolve(task, "mfrl", preset).agent == "mfrl"
