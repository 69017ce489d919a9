"""A run on eight devices is the run on one: a CPU is split into eight, in a process of its own."""

from __future__ import annotations

import itertools
import json
import math
import os
import re
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pandas as pd
import pytest

from suite import registry
from suite.runs.devices import chosen, used
from suite.runtime import layout
from suite.runtime.errors import UserError
from suite.runtime.reporting import QuietReporter
from tests.runs.on_devices import SHARED, SIZES, WHERE

TASKS, AGENTS = ("craftax_classic", "minatar/breakout", "openspiel/leduc"), ("mfrl", "m1", "m5", "m6")
LONG = (pytest.mark.devices, pytest.mark.timeout(3600))
SHORT = ("corridor", "m6")
CASES = [
    SHORT,
    *(pytest.param(case, marks=LONG) for case in itertools.product(TASKS, AGENTS)),
]


@pytest.fixture(scope="module", params=CASES, ids=lambda case: "-".join(case))
def trained(request, tmp_path_factory):
    """What `tests.runs.on_devices` printed of a task and an agent, whose programs all but the short case compile fully.

    Half compiled, sums round more differently, and frames and tokens of a VQ-VAE, which are whole numbers, differ by 1.
    """
    words = [str(tmp_path_factory.mktemp("devices")), *request.param]
    strict = {"JAX_NUMPY_DTYPE_PROMOTION": "strict", "JAX_NUMPY_RANK_PROMOTION": "raise"}  # as in all tests
    fully = {} if request.param == SHORT else {"JAX_DISABLE_MOST_OPTIMIZATIONS": "0", "XLA_FLAGS": ""}
    done = subprocess.run(
        [sys.executable, "-m", "tests.runs.on_devices", *words],
        capture_output=True,
        text=True,
        env=os.environ | strict | fully,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout.splitlines()[-1])


def table(trained, where, name):
    return pd.read_csv(f"{trained['folders'][where]}/{name}.csv")


def assert_alike(found, expected):
    """The same metrics but for rounding; what is near 0 is a difference of numbers that are not."""
    pd.testing.assert_frame_equal(found, expected, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("where", [name for name in WHERE if name != "one"])
def test_the_record_is_that_of_one_device(trained, where):
    """Stopped on all devices and gone on with on one, and the other way round."""
    expected, found = (table(trained, name, "metrics") for name in ("one", where))
    assert len(expected) == 2
    assert_alike(found, expected)
    first = expected["step"].iloc[0]
    expected, found = (table(trained, name, "episodes").query(f"step <= {first}") for name in ("one", where))
    pd.testing.assert_frame_equal(found, expected)


def test_seeds_on_devices_of_their_own_leave_the_record_of_one_alone(trained):
    """Three on two devices, so that one of them is computed twice."""
    assert len(trained["together"]) == SHARED + 1
    expected, found = table(trained, "one", "metrics"), pd.read_csv(f"{trained['together'][0]}/metrics.csv")
    assert_alike(found, expected)
    first = expected["step"].iloc[0]
    expected, found = table(trained, "one", "episodes"), pd.read_csv(f"{trained['together'][0]}/episodes.csv")
    pd.testing.assert_frame_equal(found.query(f"step <= {first}"), expected.query(f"step <= {first}"))
    others = [(Path(folder) / "metrics.csv").read_bytes() for folder in trained["together"]]
    assert len(set(others)) == len(others)
    devices = [json.loads((Path(folder) / "record.json").read_text())["device"] for folder in trained["together"]]
    assert {(device["count"], device["seeds"]) for device in devices} == {(SHARED, SHARED + 1)}


def test_a_record_says_on_how_many_devices(trained):
    counts = {}
    for name, folder in trained["folders"].items():
        record = json.loads((Path(folder) / "record.json").read_text())
        counts[name] = (record["device"]["count"], *(part["device"]["count"] for part in record["resumed"]))
    assert counts == {name: (first, others)[: 1 + (first != others)] for name, (first, others) in WHERE.items()}


def test_neither_the_buffer_nor_frames_are_gathered(trained):
    """But what the host reads of episodes, the few frames that codes are made of, and which steps are events."""
    gathered = [
        (phase, kind, math.prod(map(int, sizes.split(","))))
        for phase, moved in trained["moved"].items()
        for operation, shapes in moved
        for kind, sizes in re.findall(r"(\w+)\[([\d,]+)\]", shapes)
        if operation == "all-gather"
    ]
    assert any(phase == "collect" for phase, *_ in gathered)
    envs, minibatch = SIZES["environment.num_envs"], SIZES["world_model.sequences"] // SIZES["world_model.minibatches"]
    most = {
        "collect": {"pred": 22, "s32": 1, "f32": 1},  # of a step: its episode's totals and achievements
        "tokenizer": {"u8": 63 * 63 * 3, "s32": 81},  # of a frame: itself, or its codes, which a VQ-VAE counts
        "world_model": {"pred": 1, "s32": 1},
    }
    rows = {
        "collect": envs * SIZES["environment.rollout_length"],
        "tokenizer": minibatch * 8,
        "world_model": SIZES["replay.capacity"],
    }
    assert [g for g in gathered if g[2] > rows.get(g[0], 0) * most.get(g[0], {}).get(g[1], 0)] == []


def test_a_kernel_of_ours_computes_the_same_and_all_devices_work_is_counted(trained):
    if "flops" not in trained:
        pytest.skip("only of the smallest case")
    assert trained["kernel_difference"] < 1e-5
    assert trained["flops"] == [2 * 8 * 3 * 5] * 2
    adds, does_not = trained["shares"]
    assert 0 < adds < 1 and does_not == 0


@pytest.fixture
def eight_gpus(monkeypatch):
    monkeypatch.setattr("suite.runs.devices.device_kind", lambda: "gpu")
    monkeypatch.setattr(jax, "device_count", lambda: 8)


@pytest.mark.parametrize(
    ("settings", "asked", "number"),
    [
        ({}, None, 2),  # smoke: minibatches of two environments
        ({"ppo.minibatches": 1, "imagination.num_envs": 8, "world_model.sequences": 8}, None, 4),
        (SIZES, None, 8),
        (SIZES, "all", 8),
        (SIZES, 4, 4),
        ({}, 1, 1),
        ({"policy.cnn_norm": "batch"}, None, 1),
    ],
)
def test_as_many_accelerators_as_fit(eight_gpus, settings, asked, number):
    assert chosen(registry.resolve("minatar/breakout", "m5", "smoke", settings, steps=384), asked) == number


@pytest.mark.parametrize(
    ("asked", "line"),
    [
        (9, "JAX sees 8 of kind gpu"),
        (
            8,
            "environment.num_envs=4 in ppo.minibatches=2 minibatches has no 8 equal parts, "
            "environment.num_envs=16 has; "
            "imagination.num_envs=4 has no 8 equal parts, imagination.num_envs=8 has; "
            "world_model.sequences=4 in world_model.minibatches=2 minibatches has no 8 equal parts, "
            "world_model.sequences=16 has",
        ),
        ("all", "environment.num_envs=16 has"),
    ],
)
def test_what_does_not_fit_is_named_with_the_nearest_sizes_that_do(eight_gpus, asked, line):
    with pytest.raises(UserError, match=re.escape(line)):
        chosen(registry.resolve("minatar/breakout", "m5", "smoke"), asked)


def test_a_task_on_the_host_feeds_one_device(eight_gpus, monkeypatch):
    monkeypatch.setattr(jax, "devices", lambda: list(range(8)))
    config = registry.resolve("gymnasium/CartPole-v1", "mfrl", "smoke", SIZES, steps=384)
    assert used(config, None, QuietReporter()) == [0]
    with pytest.raises(UserError, match="steps on the host"):
        used(config, 8, QuietReporter())


def test_commands_refuse_more_devices_than_there_are(suite, tmp_path):
    for words in (["run", "minatar/breakout"], ["bench", "minatar/breakout"]):
        code, _, err = suite(*words, "--preset", "smoke", "--devices", "2")
        assert code == 2 and "--devices 2: JAX sees 1 of kind cpu" in err and err.count("\n") == 1
    words = ["--tasks", "minatar/breakout", "--agents", "mfrl", "--preset", "smoke", "--devices", "2"]
    code, _, err = suite("sweep", *words, "--out", tmp_path)
    assert code == 2 and err.startswith("error: minatar/breakout, agent mfrl: --devices 2:")


def test_describe_tells_the_memory_of_each_device(suite):
    words = ["describe", "minatar/breakout", "--agent", "m5", "--preset", "small", "world_model.sequences=16"]
    derived = {}
    for devices in (1, 2):
        code, out, _ = suite(*words, "--devices", devices, "--json")
        assert code == 0
        derived[devices] = json.loads(out.splitlines()[-1])["derived"]
    assert "replay memory of each device (MiB)" not in derived[1]
    assert derived[2]["replay memory of each device (MiB)"] == derived[2]["replay memory (MiB)"] // 2


def test_on_one_device_there_is_no_layout():
    tree = {"a": np.zeros(2)}
    with layout.over(jax.devices()[:1]):
        assert layout.devices() == 1 and layout.mesh() is None
        assert layout.split(tree) is tree and layout.replicated(tree) is tree
        assert layout.per_device(chosen, (0,), 0) is chosen
