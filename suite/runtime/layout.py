"""One program on many devices: the rows of every batch are split between them, and all else is on each of them.

Rows are environments, rows of the replay buffer, sequences that the world model learns from, and dreams. Parameters,
optimizers' states, codebooks and statistics are the same everywhere. XLA divides the work of a program accordingly and
adds up what is summed over rows. Where it would move rows between devices instead, `per_device` gives each device the
same function of its own rows.

All of this is decided by the mesh that `over` sets. Without one, on one device, the functions here return what they are
given: the programs are those of one device.

Several runs that differ by their seed may also be one program, `of_each_seed`: all that they carry has one more axis,
the first, and that one is split between the devices instead.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

AXIS = "data"
SEEDS = "seeds"  # the axis of a mesh whose devices have whole runs, instead of rows of one

Tree = TypeVar("Tree")
Function = TypeVar("Function", bound=Callable[..., Any])


@contextlib.contextmanager
def over(devices: Sequence[jax.Device], axis: str = AXIS) -> Iterator[None]:
    """Splits what is traced and called inside, in this thread, between these devices, if several.

    `axis`: what is split: batches, or `SEEDS`.
    """
    with same(Mesh(devices, (axis,), axis_types=(AxisType.Auto,)) if len(devices) > 1 else None):
        yield


def mesh() -> Mesh | None:
    """What `over` has set in this thread, to be set in another one with `same`."""
    found = jax.sharding.get_mesh()
    return None if found.empty else found


@contextlib.contextmanager
def same(mesh: Mesh | None) -> Iterator[None]:
    """Sets the mesh that `mesh` returned in another thread."""
    if mesh is None and jax.sharding.get_mesh().empty:
        yield
    else:
        with jax.set_mesh(mesh):
            yield


def devices() -> int:
    """Between how many devices arrays are split here: 1 on one device, and inside of what is called on each of them."""
    found = jax.sharding.get_abstract_mesh()
    return 1 if found.empty or found.manual_axes else found.size


def of_seeds() -> bool:
    """Whether devices have whole runs, so that everything is split along its first axis."""
    return SEEDS in jax.sharding.get_abstract_mesh().axis_names


def takes_turns() -> bool:
    """Whether a device computes one run after another, rather than all of its share at once."""
    return jax.default_backend() == "cpu"


def of_each_seed(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function` of arrays with one more axis, the first, that of seeds: what it returns for each seed's arrays alone.

    Each device takes an equal share of seeds. On a CPU it takes one after the other, and gives what `function` itself
    gives to the last bit. XLA's batched programs are slower there, by 1.7 times for `mfrl` (docs/speed.md), and
    round otherwise. An accelerator takes its share at once, since that fills it.
    """

    def own(*arguments: Any) -> Any:
        if len(jax.tree.leaves(arguments)[0]) == 1:
            alone = function(*jax.tree.map(lambda x: x[0], arguments))
            return jax.tree.map(lambda x: x[None], alone)
        if takes_turns():
            return jax.lax.map(lambda each: function(*each), arguments)
        return jax.vmap(function)(*arguments)

    if devices() == 1:
        return own
    spec = PartitionSpec(SEEDS)
    return jax.shard_map(own, in_specs=spec, out_specs=spec, check_vma=False)


def split(tree: Tree, axis: int = 0) -> Tree:
    """The same arrays, or shapes of arrays, each split along this axis between the devices."""
    return _put(tree, _spec(axis))


def replicated(tree: Tree) -> Tree:
    """The same arrays, or shapes of arrays, whole on every device."""
    return _put(tree, _spec(None))


def per_device(function: Function, in_axes: Any, out_axes: Any) -> Function:
    """`function`, called on every device with its own rows of the arguments.

    It must treat rows apart from each other. Its gradients by arguments that every device has whole are summed.

    Args:
      function: of arrays, by position.
      in_axes: along which axis arguments are split, as for `jax.vmap`; None: every device has the whole of them.
      out_axes: likewise of what it returns, never None.
    """
    if devices() == 1:
        return function
    # Unchecked: what it would check is which values are the same on all devices, and loops that begin with constants,
    # as games have them, do not tell.
    in_specs, out_specs = (jax.tree.map(_spec, axes, is_leaf=lambda x: x is None) for axes in (in_axes, out_axes))
    return jax.shard_map(function, in_specs=in_specs, out_specs=out_specs, check_vma=False)


def row_of_all(row: jax.Array, rows: int) -> jax.Array:
    """Which row of the whole batch is this one of the `rows` that a function called by `per_device` sees."""
    return jax.lax.axis_index(AXIS) * rows + row if _inside() else row


def take(tree: Tree, row_B: jax.Array, column_BT: jax.Array) -> Tree:
    """Elements [B, T] of arrays [R, C, ...]: of these rows, split along R, those in these columns; split along B.

    Each device contributes those that it has, so that no more than what is taken moves.
    """

    def own(tree: Tree, row_B: jax.Array, column_BT: jax.Array) -> Tree:
        rows = len(jax.tree.leaves(tree)[0])
        own_B = row_B - jax.lax.axis_index(AXIS) * rows
        has_B = (own_B >= 0) & (own_B < rows)
        return jax.tree.map(lambda x: _shared(x[own_B.clip(0, rows - 1)[:, None], column_BT], has_B), tree)

    if devices() == 1:
        return jax.tree.map(lambda x: x[row_B[:, None], column_BT], tree)
    return per_device(own, (0, None, None), 0)(tree, row_B, column_BT)


def _shared(taken_BT: jax.Array, has_B: jax.Array) -> jax.Array:
    """Of elements [B, T, ...], each of which one device has, this device's share of B."""
    if jax.dtypes.issubdtype(taken_BT.dtype, jax.dtypes.prng_key):
        return jax.random.wrap_key_data(_shared(jax.random.key_data(taken_BT), has_B))
    number = taken_BT.astype(jnp.uint8) if taken_BT.dtype == bool else taken_BT
    counted = jnp.where(has_B.reshape(-1, *(1,) * (number.ndim - 1)), number, jnp.zeros((), number.dtype))
    return jax.lax.psum_scatter(counted, AXIS, tiled=True).astype(taken_BT.dtype)


def _inside() -> bool:
    """Whether this is inside of what `per_device` calls on several devices."""
    return AXIS in jax.sharding.get_abstract_mesh().manual_axes


def _spec(axis: int | None) -> PartitionSpec:
    return PartitionSpec() if axis is None else PartitionSpec(*[None] * axis, SEEDS if of_seeds() else AXIS)


def _put(tree: Tree, spec: PartitionSpec) -> Tree:
    if devices() == 1:
        return tree

    def put(x: Any) -> Any:
        if isinstance(x, jax.core.Tracer):
            return jax.lax.with_sharding_constraint(x, spec)
        sharding = NamedSharding(jax.sharding.get_mesh(), spec)
        if isinstance(x, jax.Array):
            return _placed(x, sharding)
        return jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding)

    return jax.tree.map(put, tree)


def _placed(x: jax.Array, sharding: NamedSharding) -> jax.Array:
    if sharding.is_fully_addressable or not x.is_fully_addressable:
        return jax.device_put(x, sharding)
    # Each of several processes has the whole array, and puts its part onto its own devices.
    if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key):
        return jax.random.wrap_key_data(_placed(jax.random.key_data(x), sharding))
    host = np.asarray(x)
    return jax.make_array_from_callback(x.shape, sharding, lambda index: host[index])
