from __future__ import annotations

import json
import logging
import shutil
import subprocess
import sys
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from suite.records import checkpoint
from suite.runtime.errors import UserError


def model(value=1.0):
    layers = nnx.Sequential(nnx.Linear(3, 4, rngs=nnx.Rngs(0)), nnx.Linear(4, 2, rngs=nnx.Rngs(1)))
    return {
        "policy": jax.tree.map(lambda x: x + value, nnx.state(layers, nnx.Param)),
        "half": jnp.arange(3, dtype=jnp.bfloat16) / 3,
        "nothing": None,
        "count": jnp.int32(7),
    }


def resume(value=1.0):
    return {
        "key": jax.random.key(5),
        "keys": jax.random.split(jax.random.key(6), 4).reshape(2, 2),
        "frames": jnp.arange(60, dtype=jnp.uint8).reshape(3, 4, 5),
        "empty": jnp.zeros((0, 3)),
        "flag": jnp.bool_(True),
        "nested": ((), {"x": jnp.float32(value)}, None),
    }


def assert_same(found, wanted):
    assert jax.tree.structure(found) == jax.tree.structure(wanted)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        assert a.dtype == b.dtype and a.shape == b.shape
        if jax.dtypes.issubdtype(a.dtype, jax.dtypes.prng_key):
            a, b = jax.random.key_data(a), jax.random.key_data(b)
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b))


def save(folder, *steps, keep=2):
    for step in steps:
        checkpoint.save(folder, step, model(step), resume(step), {"iteration": step}, keep)


def restore(folder, **changes):
    return checkpoint.restore_latest(folder, *jax.eval_shape(lambda: (model(), resume())), **changes)


def newest(folder):
    return max(folder.glob("step_*"))


def some_file(path, item="model"):
    """The largest file of an item."""
    return max((file for file in (path / item).rglob("*") if file.is_file()), key=lambda file: file.stat().st_size)


def test_round_trip_to_the_bit(tmp_path):
    save(tmp_path, 3)
    found = restore(tmp_path)
    assert (found.step, found.host, found.warnings) == (3, {"iteration": 3, "steps": 3}, ())
    assert_same(found.model, model(3))
    assert_same(found.resume, resume(3))
    assert jax.random.uniform(found.resume["key"]) == jax.random.uniform(jax.random.key(5))


def test_evaluation_reads_the_model_only(tmp_path):
    save(tmp_path, 3)
    found = checkpoint.restore_latest(tmp_path, model())
    assert found.resume is None
    assert_same(found.model, model(3))


def test_nothing_saved(tmp_path):
    assert checkpoint.restore_latest(tmp_path / "none", model()) is None
    assert checkpoint.latest_step(tmp_path / "none") is None


def test_an_item_without_arrays(tmp_path):
    checkpoint.save(tmp_path, 1, {"a": None}, {}, {})
    assert checkpoint.restore_latest(tmp_path, {"a": None}, {}).model == {"a": None}


def test_keeps_the_newest(tmp_path):
    save(tmp_path, 1, 2, 3)
    assert [path.name for path in sorted(tmp_path.iterdir())] == ["step_000000000002", "step_000000000003"]
    save(tmp_path, 4, keep=3)
    assert checkpoint.latest_step(tmp_path) == 4
    assert len(list(tmp_path.iterdir())) == 3


def test_the_same_step_again(tmp_path):
    save(tmp_path, 1, 2)
    checkpoint.save(tmp_path, 2, model(9), resume(9), {})
    assert_same(restore(tmp_path).model, model(9))


def truncate(path):
    file = some_file(path)
    file.write_bytes(file.read_bytes()[:-1])


def flip(path):
    file = some_file(path, "resume")
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)


def empty(path):
    shutil.rmtree(path)
    path.mkdir()


def broken_manifest(path):
    (path / "manifest.json").write_text('{"model')


def emptied_manifest(path):
    (path / "manifest.json").write_text("{}")
    flip(path)


DAMAGE = {
    "truncated": (truncate, "bytes of"),
    "flipped bit": (flip, "has changed"),
    "file deleted": (lambda path: some_file(path).unlink(), "is missing"),
    "item deleted": (lambda path: shutil.rmtree(path / "resume"), "is missing"),
    "host deleted": (lambda path: (path / "host.json").unlink(), "host.json is missing"),
    "manifest deleted": (lambda path: (path / "manifest.json").unlink(), "manifest.json cannot be read"),
    "manifest broken": (broken_manifest, "manifest.json cannot be read"),
    "manifest emptied": (emptied_manifest, "is not in manifest.json"),
    "empty": (empty, "manifest.json cannot be read"),
}


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    folder = tmp_path_factory.mktemp("checkpoints")
    save(folder, 1000, 2000)
    return folder


@pytest.mark.parametrize("name", DAMAGE)
def test_the_one_before_a_damaged_one_is_used(saved, tmp_path, name):
    damage, words = DAMAGE[name]
    folder = shutil.copytree(saved, tmp_path / "checkpoints")
    damage(newest(folder))
    assert checkpoint.latest_step(folder) == 1000
    found = restore(folder)
    assert found.step == 1000
    assert_same((found.model, found.resume), (model(1000), resume(1000)))
    (warning,) = found.warnings
    assert warning.startswith("checkpoint at step 2,000 is damaged (") and words in warning


def test_a_renamed_checkpoint_is_not_taken_for_another(saved, tmp_path):
    folder = shutil.copytree(saved, tmp_path / "checkpoints")
    newest(folder).rename(folder / "step_000000003000")
    found = restore(folder)
    assert found.step == 1000
    assert found.warnings == ("checkpoint at step 3,000 is damaged (it is of step 2,000) and is not used",)
    newest(folder).rename(folder / "step_3000")  # no name of ours
    assert checkpoint.latest_step(folder) == 1000


def test_orbax_is_silent_and_others_are_not(tmp_path, monkeypatch, caplog):
    """After an error its threads, tasks and writes go on for a while."""
    heard = []
    monkeypatch.setattr(sys, "unraisablehook", heard.append)
    checkpoint._quiet_orbax.cache_clear()
    save(tmp_path, 1)
    for error in (RuntimeError("Event loop is closed"), RuntimeError("something else")):
        sys.unraisablehook(types.SimpleNamespace(exc_value=error))
    assert [str(raised.exc_value) for raised in heard] == ["something else"]
    for logger, told in (("asyncio", "Task exception was never retrieved: orbax/checkpoint"), ("asyncio", "mine")):
        logging.getLogger(logger).error(told)
    assert caplog.messages == ["mine"]


def test_all_damaged(saved, tmp_path):
    folder = shutil.copytree(saved, tmp_path / "checkpoints")
    for path in folder.iterdir():
        flip(path)
    with pytest.raises(UserError, match=r"step 2,000 is damaged.*step 1,000 is damaged.*no checkpoint in .* is whole$"):
        restore(folder)
    checkpoint.drop_resume(folder)  # what cannot be told to be good is not deleted either
    assert len(list(folder.iterdir())) == 2


def test_a_damaged_later_one_does_not_push_out_good_ones(saved, tmp_path):
    folder = shutil.copytree(saved, tmp_path / "checkpoints")
    flip(newest(folder))
    save(folder, 1500)  # the run went on from 1000
    assert sorted(path.name for path in folder.iterdir()) == ["step_000000001000", "step_000000001500"]


def test_a_kill_while_saving(saved, tmp_path, monkeypatch):
    """At each of its steps: what was whole stays whole, and a leftover does no harm."""
    folder = shutil.copytree(saved, tmp_path / "checkpoints")

    for target in ("_save_tree", "_write_manifest", "os", "_steps"):
        with monkeypatch.context() as patch:

            def killed(*args, patch=patch, **kwargs):
                patch.setattr(shutil, "rmtree", lambda *args, **kwargs: None)  # the dead do not clean up
                raise KeyboardInterrupt

            patch.setattr(checkpoint, target, types.SimpleNamespace(replace=killed) if target == "os" else killed)
            with pytest.raises(KeyboardInterrupt):
                save(folder, 3000)
        assert any(folder.glob("*.partial")) == (target != "_steps")
        assert restore(folder).step == (3000 if target == "_steps" else 2000)
    save(folder, 4000)
    assert sorted(path.name for path in folder.iterdir()) == ["step_000000003000", "step_000000004000"]


def test_dropping_what_only_going_on_needs(saved, tmp_path):
    folder = shutil.copytree(saved, tmp_path / "checkpoints")
    checkpoint.drop_resume(folder)
    checkpoint.drop_resume(folder)
    (path,) = folder.iterdir()
    assert not (path / "resume").exists()
    assert not any(name.startswith("resume") for name in json.loads((path / "manifest.json").read_text()))
    found = restore(folder)
    assert found.resume is None
    assert_same(found.model, model(2000))


def test_a_kill_while_dropping_leaves_a_whole_checkpoint(saved, tmp_path, monkeypatch):
    folder = shutil.copytree(saved, tmp_path / "checkpoints")

    def killed(path, *args, **kwargs):
        if path.name == "resume":
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("suite.records.checkpoint.shutil.rmtree", killed)
        with pytest.raises(KeyboardInterrupt):
            checkpoint.drop_resume(folder)
    assert checkpoint.latest_step(folder) == 2000
    assert_same(restore(folder).resume, resume(2000))


@pytest.mark.parametrize(
    "change", [{"half": jnp.zeros(4, jnp.bfloat16)}, {"more": jnp.zeros(2)}, {"count": None}, {"count": jnp.zeros(1)}]
)
def test_a_checkpoint_of_another_network(saved, change):
    with pytest.raises(UserError, match="does not fit this version or configuration"):
        checkpoint.restore_latest(saved, model() | change)


REFUSED_WRITE = """
import resource, sys
from pathlib import Path
import jax.numpy as jnp, numpy as np
from suite.records import checkpoint

folder, small = Path(sys.argv[1]), {"x": jnp.ones(3)}
noise = np.random.default_rng(0).integers(0, 256, 300_000, dtype=np.uint8)  # so that it cannot be compressed
checkpoint.save(folder, 1, small, small, {})
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
try:
    checkpoint.save(folder, 2, small, {"x": jnp.asarray(noise)}, {})
except Exception as error:
    print(error)
print(checkpoint.restore_latest(folder, small).step)
"""


def test_a_write_that_the_system_refuses_is_one_error_and_no_log(tmp_path):
    ran = subprocess.run(
        [sys.executable, "-c", REFUSED_WRITE, str(tmp_path)], capture_output=True, text=True, timeout=120
    )
    assert ran.stderr == ""
    *error, step = ran.stdout.splitlines()
    assert "File too large" in " ".join(error)
    assert step == "1" and [path.name for path in tmp_path.iterdir()] == ["step_000000000001"]
