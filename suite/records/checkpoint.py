"""Saving and restoring a run with Orbax: atomic, verified, and in two items.

`checkpoints/step_<n>/` holds `model` (what evaluation needs), `resume` (what only going on needs: environments, replay,
optimizers), `host.json` (plain values) and `manifest.json` (size and CRC-32 of every file), written last. A checkpoint
whose files differ from its manifest, or which has another step's name, does not count: the one before it is used.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
import logging
import os
import re
import shutil
import sys
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from suite.records.tables import write_whole
from suite.runtime.errors import UserError

MANIFEST = "manifest.json"
CHUNK = 1 << 24


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """A checkpoint read back. `resume` is None if it was not asked for or was dropped; `warnings` are for the user."""

    step: int
    model: Any
    resume: Any
    host: dict[str, Any]
    warnings: tuple[str, ...]


def save(folder: Path, step: int, model: Any, resume: Any, host: dict[str, Any], keep: int = 2) -> None:
    """Writes a checkpoint; it counts once it is whole. Then removes all but the newest `keep`.

    Args:
      folder: of all the run's checkpoints.
      step: real environment steps; a checkpoint of the same step is replaced.
      model: pytree of arrays, typed PRNG keys included.
      resume: likewise.
      host: JSON values; "steps" is added.
      keep: how many checkpoints stay.
    """
    folder.mkdir(parents=True, exist_ok=True)
    final, partial = folder / _name(step), folder / f"{_name(step)}.partial"
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir()
    try:
        _save_tree(partial / "model", model)
        _save_tree(partial / "resume", resume)
        (partial / "host.json").write_text(json.dumps(host | {"steps": step}))
        _write_manifest(partial)
        if final.exists():
            shutil.rmtree(final)
        os.replace(partial, final)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    steps = _steps(folder)
    later = [other for other in steps if other > step]  # damaged, or we would have gone on from there
    for other in later + steps[len(later) + keep :]:
        shutil.rmtree(folder / _name(other))


def restore_latest(folder: Path, model_template: Any, resume_template: Any = None) -> Checkpoint | None:
    """The newest checkpoint that is whole, or None if there is none.

    Args:
      folder: of all the run's checkpoints.
      model_template: arrays or `jax.ShapeDtypeStruct`s in the structure that was saved. What is split between
        devices in it is restored so.
      resume_template: likewise; None: `resume` is not read.

    Raises:
      UserError: there are checkpoints but none is whole, or their contents do not fit the templates.
    """
    warnings: list[str] = []
    steps = _steps(folder)
    for step in steps:
        path = folder / _name(step)
        if damage := _damage(path):
            warnings.append(f"checkpoint at step {step:,} is damaged ({damage}) and is not used")
            continue
        wanted = resume_template is not None and (path / "resume").exists()
        return Checkpoint(
            step=step,
            model=_restore_tree(path / "model", model_template),
            resume=_restore_tree(path / "resume", resume_template) if wanted else None,
            host=json.loads((path / "host.json").read_text()),
            warnings=tuple(warnings),
        )
    if steps:
        raise UserError(f"{'; '.join(warnings)}; no checkpoint in {folder} is whole")
    return None


def latest_step(folder: Path) -> int | None:
    """The step of the newest checkpoint that is whole, None if there is none."""
    return next((step for step in _steps(folder) if not _damage(folder / _name(step))), None)


def drop_resume(folder: Path, but_newest: bool = False) -> None:
    """Deletes all but the newest checkpoint and, without `but_newest`, what of it only going on needs.

    For a finished run, which goes on only if it is given more steps.
    """
    newest = latest_step(folder)
    for step in _steps(folder) if newest is not None else ():
        path = folder / _name(step)
        if step != newest:
            shutil.rmtree(path)
        elif not but_newest and (path / "resume").exists():
            _write_manifest(path, without="resume")  # first: a kill in between leaves a whole checkpoint
            shutil.rmtree(path / "resume")


def _name(step: int) -> str:
    return f"step_{step:012d}"


def _steps(folder: Path) -> list[int]:
    """Steps of all finished checkpoints, newest first."""
    names = (path.name.removeprefix("step_") for path in folder.glob("step_*"))
    return sorted((int(name) for name in names if re.fullmatch("[0-9]{12,}", name)), reverse=True)


def _leaves(tree: Any) -> dict[str, Any]:
    """Leaves by path, but for empty ones: Orbax takes no array of size zero."""
    paths, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {jax.tree_util.keystr(path): leaf for path, leaf in paths if leaf.size}


@contextlib.contextmanager
def _orbax() -> Iterator[Any]:
    """An Orbax checkpointer. zarr3 in one OCDBT store: few files, and no slower than one file per array."""
    import orbax.checkpoint as ocp

    _quiet_orbax()
    # Each process for itself: of several that train one run together the first one saves, and all of them restore.
    me = jax.process_index()
    alone = ocp.options.MultiprocessingOptions(
        primary_host=me, active_processes={me}, barrier_sync_key_prefix=f"process_{me}"
    )
    options: dict[str, Any] = {} if jax.process_count() == 1 else {"multiprocessing_options": alone}
    handler = ocp.PyTreeCheckpointHandler(use_ocdbt=True, use_zarr3=True, **options)
    checkpointer = ocp.Checkpointer(handler, **options)
    try:
        yield checkpointer
    finally:
        checkpointer.close()


@functools.cache
def _quiet_orbax() -> None:
    """Silences what Orbax's threads, tasks and writes say of an error, for as long as they go on after it.

    The error itself is raised here, too: once is enough.
    """
    logging.getLogger("absl").addFilter(lambda record: "orbax" not in record.pathname)
    logging.getLogger("asyncio").addFilter(lambda record: "orbax" not in logging.Formatter().format(record))
    hook = sys.unraisablehook

    def heard(raised: sys.UnraisableHookArgs) -> None:
        if not (isinstance(raised.exc_value, RuntimeError) and str(raised.exc_value) == "Event loop is closed"):
            hook(raised)

    sys.unraisablehook = heard


def _save_tree(path: Path, tree: Any) -> None:
    import orbax.checkpoint as ocp

    if leaves := _leaves(tree):
        with _orbax() as checkpointer:
            checkpointer.save(path.absolute(), args=ocp.args.PyTreeSave(leaves))
    else:
        path.mkdir()


def _restore_tree(path: Path, template: Any) -> Any:
    import orbax.checkpoint as ocp

    device = jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
    flat, structure = jax.tree_util.tree_flatten_with_path(template)
    places = {name: leaf.sharding for name, leaf in _leaves(template).items() if _is_placed(leaf)}
    wanted = {
        name: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=places.get(name, device))
        for name, leaf in _leaves(template).items()
    }
    arrays: dict[str, Any] = {}
    with _orbax() as checkpointer:
        if wanted:
            stored = {name: leaf.shape for name, leaf in _metadata(checkpointer, path).items()}
            if misfit := next((n for n in wanted.keys() | stored if not _fits(n, wanted, stored)), None):
                raise UserError(f"{path} does not fit this version or configuration: {misfit}")
            arguments = ocp.checkpoint_utils.construct_restore_args(wanted)
            arrays = checkpointer.restore(path.absolute(), args=ocp.args.PyTreeRestore(wanted, restore_args=arguments))
    arrays = {name: array if name in places else _unbound(array) for name, array in arrays.items()}
    leaves = [arrays.get(jax.tree_util.keystr(key)) for key, _ in flat]
    leaves = [
        jnp.zeros(leaf.shape, leaf.dtype) if array is None else array
        for array, (_, leaf) in zip(leaves, flat, strict=True)
    ]
    return jax.tree_util.tree_unflatten(structure, leaves)


def _is_placed(leaf: Any) -> bool:
    """Whether a template says on which of this process's devices it is to be: no one of them need hold all of it."""
    sharding = getattr(leaf, "sharding", None)
    key = jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return isinstance(sharding, jax.sharding.NamedSharding) and sharding.is_fully_addressable and not key


def _unbound(array: jax.Array) -> jax.Array:
    """The same array, as free to move between devices as one that was computed: Orbax binds what it reads to a device.

    JAX compiles a program anew for arrays that are bound, so that a run which goes on would compile all of its own.
    """
    if jax.dtypes.issubdtype(array.dtype, jax.dtypes.prng_key):
        return jax.random.wrap_key_data(jax.device_put(np.asarray(jax.random.key_data(array))))
    return jax.device_put(np.asarray(array))


def _metadata(checkpointer: Any, path: Path) -> dict[str, Any]:
    return checkpointer.metadata(path.absolute()).item_metadata.tree


def _fits(name: str, wanted: dict[str, Any], stored: dict[str, Any]) -> bool:
    if name not in wanted or name not in stored:
        return False
    shape = tuple(wanted[name].shape)
    axes = len(shape)
    if jax.dtypes.issubdtype(wanted[name].dtype, jax.dtypes.prng_key):  # stored as words, along one more axis
        return shape == tuple(stored[name])[:axes] and len(stored[name]) == axes + 1
    return shape == tuple(stored[name])


def _write_manifest(path: Path, without: str = "") -> None:
    """Sizes and checksums of all files but those under the folder `without`."""
    names = [name for name in _files(path) if name.parts[0] != without]
    entries = {str(name): [(path / name).stat().st_size, _crc32(path / name)] for name in names}
    write_whole(path / MANIFEST, json.dumps(entries).encode())


def _files(path: Path) -> list[Path]:
    """All that a manifest lists, relative to the checkpoint: not itself, what a kill left of it, or hidden files."""
    files = (file.relative_to(path) for file in sorted(path.rglob("*")) if file.is_file())
    ours = (MANIFEST, f"{MANIFEST}.partial")
    return [file for file in files if file.parts[0] not in ours and not file.name.startswith(".")]


def _damage(path: Path) -> str:
    """What is wrong with a checkpoint, "" if nothing is."""
    try:
        entries = json.loads((path / MANIFEST).read_text())
        dropped = not any(name.startswith("resume/") for name in entries)  # a kill may have left a part of it
        for file in _files(path):
            if str(file) not in entries and not (dropped and file.parts[0] == "resume"):
                return f"{file} is not in {MANIFEST}"
        for name, (size, checksum) in entries.items():
            file = path / name
            if not file.is_file():
                return f"{name} is missing"
            if file.stat().st_size != size:
                return f"{name} has {file.stat().st_size} bytes of {size}"
            if _crc32(file) != checksum:
                return f"{name} has changed"
        if (step := json.loads((path / "host.json").read_text())["steps"]) != int(path.name.removeprefix("step_")):
            return f"it is of step {step:,}"
    except (OSError, LookupError, ValueError, TypeError, AttributeError) as error:
        return f"{MANIFEST} cannot be read: {type(error).__name__}"
    return ""


def _crc32(file: Path) -> int:
    checksum = 0
    with file.open("rb") as stream:
        while chunk := stream.read(CHUNK):
            checksum = zlib.crc32(chunk, checksum)
    return checksum
