"""Several processes, on one machine or on many, that train one run together: `jax.distributed`.

All of them do the same, step by step, on their own devices' rows. The first one's record and checkpoints last.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import re
import sys
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np

from suite.runtime import layout
from suite.runtime.errors import RunError, UserError

LAUNCHER = "auto"  # for the coordinator: what SLURM or MPI say
TIMEOUT = 300  # seconds that processes wait for each other to start
SIGNS = "(?i)gloo|nccl|coordination service|heartbeat|connection (reset|closed)"  # that another process died
LOST = 30  # seconds until a process that says nothing counts as lost
_lost = False


def join(coordinator: str, processes: int | None, process: int | None) -> None:
    """Meets the other processes. Before anything else is done with JAX.

    Args:
      coordinator: HOST:PORT of the first process, or `LAUNCHER`.
      processes, process: how many there are, and which of them is this one, from 0; None: as the launcher says.

    Raises:
      UserError: the others were not to be found, or the launcher says nothing.
    """
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    try:
        jax.distributed.initialize(
            None if coordinator == LAUNCHER else coordinator,
            processes,
            process,
            initialization_timeout=TIMEOUT,
            heartbeat_timeout_seconds=LOST,
        )
    except (RuntimeError, ValueError) as error:
        if coordinator == LAUNCHER:
            raise UserError(f"--coordinator auto: no launcher says where; give HOST:PORT instead ({error})") from error
        raise UserError(f"--coordinator {coordinator}: the processes do not meet there: {error}") from error
    atexit.register(_leave_the_lost)
    if not is_first():
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115 -- for good: one of them tells the results


def number() -> int:
    """How many processes there are."""
    return jax.process_count()


def is_first() -> bool:
    """Whether this is the process whose record lasts."""
    return jax.process_index() == 0


def votes(flag: bool) -> list[bool]:
    """What each device's process says, once all of them have said it: processes wait here for each other."""
    if number() == 1:
        return [flag]
    mesh = layout.mesh()
    assert mesh is not None
    sharding = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec(layout.AXIS))
    said_D = jax.make_array_from_callback((mesh.size,), sharding, lambda _: np.array([flag]))
    return np.asarray(jax.jit(layout.replicated)(said_D)).tolist()


def whole(tree: Any) -> Any:
    """Arrays that each process has the whole of; of one process, the same arrays."""
    return tree if number() == 1 else jax.tree.map(_whole, tree)


def _whole(x: jax.Array) -> Any:
    if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key):
        words = _whole(jax.random.key_data(x))
        with layout.over([]):
            return jax.random.wrap_key_data(jax.numpy.asarray(words))
    return np.asarray(x if x.is_fully_replicated else jax.jit(layout.replicated)(x))


@contextlib.contextmanager
def lost_ones() -> Iterator[None]:
    """Turns what JAX raises where another process died, which has many types, into a `RunError`."""
    global _lost
    try:
        yield
    except Exception as error:
        if number() == 1 or not re.search(SIGNS, str(error)):
            raise
        _lost = True
        raise RunError(
            "another process of this run was lost; the same commands go on from the newest checkpoint "
            f"({' '.join(str(error).split())[:200]})"
        ) from error


def _leave_the_lost() -> None:
    """Ends this process without the goodbye that waits for all others, one of which is no more."""
    if _lost:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(RunError.exit_code)
