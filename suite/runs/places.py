"""Where runs go on side by side on one machine: each on GPUs of its own, or on two CPU cores."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import jax

from suite.runtime.compilation import device_kind

if TYPE_CHECKING:
    from suite.runs.devices import Asked

CPUS_PER_RUN = 2

Environment = dict[str, str]


def places(waiting: int, jobs: int | None = None, devices: Asked = None) -> list[Environment]:
    """What each of the runs that go on at once finds in its environment.

    With GPUs, a run sees only its own, and is not slowed by the others. Fewer runs than GPUs get several each. More
    runs than GPUs share them and their memory. Without GPUs, runs share what there is.

    Args:
      waiting: how many runs there are, at least one.
      jobs: how many go on at once; None: as many as the machine has room for.
      devices: of each run, as `suite.runs.devices.chosen` allows it; None: as many as fall to it.
    """
    gpus = _gpus()
    if not gpus:
        jobs = jobs or default_jobs()
        return [share_of_memory(1 / jobs)] * jobs
    if devices is None:
        each = max(1, len(gpus) // min(jobs or len(gpus), waiting))
    else:
        each = len(gpus) if devices == "all" else devices
    groups = [gpus[first : first + each] for first in range(0, len(gpus) // each * each, each)]
    jobs = jobs or len(groups)
    share = share_of_memory(1 / -(-jobs // len(groups)))
    return [_only(groups[job % len(groups)]) | share for job in range(jobs)]


def default_jobs(cores_each: int = CPUS_PER_RUN) -> int:
    """How many runs this machine takes at once: one on an accelerator, or one for every two CPU cores or so many."""
    if device_kind() != "cpu":
        return 1
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, cores // cores_each)


def share_of_memory(share: float) -> Environment:
    """The environment of runs that share one GPU, of which JAX otherwise takes three quarters for the first."""
    return {"XLA_PYTHON_CLIENT_MEM_FRACTION": f"{0.9 * share:.2f}"} if share < 1 else {}


def _gpus() -> list[str]:
    """The numbers by which JAX knows the GPUs that this process sees."""
    return [str(device.local_hardware_id) for device in jax.local_devices()] if device_kind() == "gpu" else []


def _only(gpus: list[str]) -> Environment:
    """The environment of a run that sees these. JAX's variables count among those that CUDA's own leave visible."""
    return dict.fromkeys(("JAX_CUDA_VISIBLE_DEVICES", "JAX_ROCM_VISIBLE_DEVICES"), ",".join(gpus))
