from __future__ import annotations

import pytest

from suite.configuration.overrides import apply_changes, dotted, parse_overrides
from suite.registry import resolve
from suite.runtime.errors import UserError


def changed(*overrides):
    return dotted(resolve("craftax_classic", "m5", "paper", overrides))


@pytest.mark.parametrize(
    ("override", "value"),
    [
        ("ppo.discount=0.97", 0.97),
        ("ppo.discount=0", 0.0),
        ("ppo.learning_rate=3e-4", 3e-4),
        ("protocol.steps=2_000_000", 2_000_000),
        ("policy.cnn_channels=[16,32]", (16, 32)),
        ("policy.cnn_channels=(16, 32)", (16, 32)),
        ("policy.cnn_norm=batch", "batch"),
        ("tokenizer.patch=[9,9]", (9, 9)),
        ("tokenizer.patch=null", None),
        ("world_model.mask_after_done=true", True),
        ("world_model.mask_after_done=True", True),
        ("world_model.reward_classes=[0,1,3]", (0.0, 1.0, 3.0)),
        ("imagination.start_step=0", 0),
    ],
)
def test_values(override, value):
    found = changed(override)[override.partition("=")[0]]
    assert found == value and type(found) is type(value)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("ppo.discount", "'ppo.discount' is no setting; write dotted.name=value, such as ppo.discount=0.97"),
        ("ppo.discout=1", "unknown field 'ppo.discout'; did you mean 'ppo.discount'?"),
        ("ppo.gamma=0.9", "unknown field 'ppo.gamma'; did you mean 'ppo.discount'?"),
        ("T_BP=0", "unknown field 'T_BP'; did you mean 'imagination.start_step'?"),
        (
            "learning_rate=1",
            "did you mean 'ppo.learning_rate' or 'tokenizer.learning_rate' or",
        ),
        ("seed=3", "unknown field 'seed'; it is set by --seed"),
        ("steps=3", "it is set by --steps"),
        ("qqqqq=3", "`suite describe TASK` lists every field"),
        ("ppo.discount=high", "ppo.discount='high': input should be a valid number"),
        ("ppo.discount=1", "ppo.discount=1: input should be less than 1"),
        ("ppo.discount=nan", "ppo.discount="),
        ("ppo.gae_lambda=NaN", "ppo.gae_lambda=nan"),
        ("ppo.learning_rate=inf", "ppo.learning_rate="),
        ("ppo.learning_rate=-1", "ppo.learning_rate=-1: input should be greater than 0"),
        ("ppo.epochs=2.5", "ppo.epochs=2.5: input should be a valid integer"),
        ("ppo.epochs=true", "ppo.epochs=True: input should be a number"),
        ("ppo.epochs=", "ppo.epochs=''"),
        ("policy.shared_trunk=1", "policy.shared_trunk=1: input should be true or false"),
        ("policy.cnn_norm=group", "policy.cnn_norm='group': input should be 'instance', 'batch' or 'layer'"),
        ("world_model.positions=spiral", "world_model.positions='spiral': input should be 'flat' or 'grid'"),
        ("environment.num_envs=0", "environment.num_envs=0: input should be greater than 0"),
        ("environment.num_envs=20", "ppo.minibatches=8 must divide environment.num_envs=20"),
        ("checkpoint.keep=1", "checkpoint.keep=1: input should be greater than or equal to 2"),
    ],
)
def test_bad_ones_say_what_is_wrong_in_one_line(override, message):
    with pytest.raises(UserError) as caught:
        changed(override)
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_changes_that_fit_only_together():
    found = changed("environment.num_envs=20", "ppo.minibatches=4")
    assert (found["environment.num_envs"], found["ppo.minibatches"]) == (20, 4)


def test_every_field_has_a_dotted_name_that_sets_it():
    config = resolve("craftax_classic", "m5", "paper")
    fields = dotted(config)
    assert apply_changes(config, fields) == config
    nested = [name for name in fields if "." in name]
    assert parse_overrides([f"{name}=1" for name in nested]) == dict.fromkeys(nested, 1)
