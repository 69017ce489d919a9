from __future__ import annotations

import pytest

from suite import registry
from suite.diagnostics.describe import describe


def described(agent, preset="paper", overrides=()):
    layers = registry.layers("craftax_classic", agent, preset, overrides)
    return describe(layers, registry.task("craftax_classic").spec())


@pytest.fixture(scope="module")
def m5():
    return described("m5")


def shapes(description, module):
    return {
        f"{layer.name}.{name}": shape for layer in description.modules[module] for name, shape in layer.shapes.items()
    }


def test_counts_are_the_papers(m5):
    """Fidelity notes, table of parameter counts: 58.5M."""
    assert m5.parameters("policy") == 55_599_768
    assert m5.parameters("world_model") == 1_699_972
    assert m5.parameters("codebook") == 4096 * 147
    assert m5.total == 58_503_964
    assert m5.as_dict()["parameters"]["total"] == 58_503_964


@pytest.mark.parametrize(
    ("agent", "total", "millions"),
    [
        ("m1", 60_032_287, 60.0),
        ("m2", 60_032_287, 60.0),
        ("m3", 56_564_143, 56.6),
        ("m4", 58_503_964, 58.5),
        ("m5", 58_503_964, 58.5),
        ("m5_slow", 58_503_964, 58.5),
        ("mfrl", 55_599_768, 55.6),
        ("mfrl_prior", 3_951_122, 4.0),
    ],
)
def test_each_rungs_count_is_the_papers(agent, total, millions):
    """Table 1, and the fidelity notes' table of parameter counts."""
    found = described(agent).total
    assert found == total and round(found / 1e6, 1) == millions == registry.agent(agent).millions


def test_a_vq_vae_counts_networks_once_and_its_codebook_twice():
    m3 = described("m3")
    assert m3.parameters("tokenizer") == (147 * 128 + 128) + (128 * 128 + 128) + (128 * 147 + 147)
    assert shapes(m3, "codebook") == {".codebook": (512, 128)}
    assert m3.parameters("world_model") == 778_884


def test_sizes_are_the_papers(m5):
    """Table "MFRL hyperparameters", sizes: CNN output 8x8x128, actor-critic input 8448."""
    policy = shapes(m5, "policy")
    assert policy["memory.input.kernel"] == (8 * 8 * 128, 256)
    assert policy["trunks.0.first.kernel"] == policy["trunks.1.first.kernel"] == (8448, 2048)
    assert shapes(m5, "codebook") == {".codes_KP": (4096, 7 * 7 * 3)}


def test_mfrl_has_the_policy_only():
    description = described("mfrl")
    assert description.total == description.parameters("policy") == 55_599_768
    assert description.modules.keys() == {"policy"}
    assert dict(row[:2] for row in description.derived) == {
        "steps per iteration": 4608,
        "iterations": 217,
        "real steps": 999_936,
    }


def test_other_structures_are_counted():
    """Fidelity notes: the paper's text read literally, and K = 512."""
    literal = described("mfrl", overrides=["policy.cnn_channels=[64,64,128]", "policy.convs_per_block=1"])
    assert literal.total == 54_536_152 + 256 * 257  # the notes' count has no projection of the GRU's output
    assert described("m5", overrides=["tokenizer.codebook_size=512"]).parameters("world_model") == 778_884


def test_random_has_no_parameters():
    assert described("random").total == 0


def test_derived(m5):
    derived = {name: value for name, value, _ in m5.derived}
    assert derived == {
        "steps per iteration": 48 * 96,
        "iterations": 217,
        "real steps": 999_936,
        "first imagination": 202_752,
        "iterations with imagination": 174,
        "imagined policy updates": 174 * 150,
        "imagined steps": 174 * 150 * 48 * 20,
        "world-model gradient steps": 217 * 500 * 3,
        # 2,666 steps of each environment: a frame of 63x63x3 bytes, action, reward and two flags (a step is 10 bytes)
        "replay memory (MiB)": 48 * 2_666 * (63 * 63 * 3 + 10) // 2**20,
    }


def test_sources():
    settings = described("m5_slow", "smoke", ["ppo.discount=0.97"]).settings
    sources = {setting.name: setting.source for setting in settings}
    assert sources["ppo.discount"] == "user"
    assert sources["world_model.updates"] == "agent"
    assert sources["environment.num_envs"] == "preset"
    assert sources["ppo.clip"] == "default"
