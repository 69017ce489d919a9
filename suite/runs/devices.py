"""On how many devices a run computes: what was asked for, and what its sizes allow."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import jax

from suite.configuration.schema import Config
from suite.interface.host import HostEnvironment
from suite.runs.saved_model import agent_for
from suite.runtime import processes
from suite.runtime.compilation import device_kind
from suite.runtime.errors import UserError
from suite.runtime.reporting import Reporter

Asked = int | Literal["all"] | None


def chosen(config: Config, asked: Asked) -> int:
    """How many devices a run uses: some of this process's, or all of several processes'.

    Args:
      config: of the run.
      asked: a number; "all" that are visible; None: one CPU, or as many accelerators as its sizes can be divided by.

    Raises:
      UserError: there are not so many, or its sizes cannot be divided by so many.
    """
    kind, visible = device_kind(), jax.device_count()
    if processes.number() > 1:
        if asked not in (None, "all", visible):
            raise UserError(f"--devices {asked}: {processes.number()} processes use all of their {visible} devices")
        asked = visible
    if asked is None:
        return 1 if kind == "cpu" else next(n for n in range(visible, 0, -1) if n == 1 or not any(_misfits(config, n)))
    number = _visible(asked)
    require_equal_shares(config, number)
    return number


def _visible(asked: int | Literal["all"]) -> int:
    """So many devices, if there are so many."""
    kind, visible = device_kind(), jax.device_count()
    number = visible if asked == "all" else asked
    if not 1 <= number <= visible:
        more = "; XLA_FLAGS=--xla_force_host_platform_device_count=N splits a CPU" if kind == "cpu" else ""
        raise UserError(f"--devices {asked}: JAX sees {visible} of kind {kind}{more}")
    return number


def used(config: Config, asked: Asked, reporter: Reporter) -> list[jax.Device]:
    """The devices that are `chosen`; one for a task that steps on the host, which one process of Python plays.

    Raises:
      UserError: as `chosen`, or several are asked for of such a task.
    """
    number = chosen(config, asked)
    # Only where there are several is the task itself looked at.
    if number > 1 and isinstance(agent_for(config, reporter).batched.environment, HostEnvironment):
        if asked is not None or processes.number() > 1:
            raise UserError(f"{config.task} steps on the host, which feeds one device of one process: --devices 1")
        number = 1
    return jax.devices()[:number]


def used_together(config: Config, seeds: int, asked: Asked, reporter: Reporter) -> list[jax.Device]:
    """The devices between which so many runs, that differ by their seed, are divided: no more than there are runs.

    Raises:
      UserError: there are not so many devices, there are several processes, or the task steps on the host.
    """
    if processes.number() > 1:
        raise UserError("--together is for one process: leave --coordinator away")
    if asked is None:
        asked = 1 if device_kind() == "cpu" else "all"
    number = min(_visible(asked), seeds)
    if isinstance(agent_for(config, reporter, computed(seeds, number)).batched.environment, HostEnvironment):
        raise UserError(f"{config.task} steps on the host, where runs take turns: leave --together away")
    return jax.devices()[:number]


def computed(seeds: int, devices: int) -> int:
    """How many runs are computed so that each device has as many: some of them for nothing."""
    return -(-seeds // devices) * devices


def require_equal_shares(config: Config, devices: int) -> None:
    """Raises a UserError, which names sizes that would do, if so many cannot have equal shares of every batch."""
    if devices > 1 and (problems := list(_misfits(config, devices))):
        raise UserError(f"--devices {devices}: {'; '.join(problems)}")


def _misfits(config: Config, devices: int) -> Iterator[str]:
    """What keeps so many devices from having equal shares of every batch."""
    env, model, dream = config.environment, config.world_model, config.imagination
    batches = [("environment.num_envs", env.num_envs, "ppo.minibatches", config.ppo.minibatches)]
    if not config.learns_from_real:
        batches = [("environment.num_envs", env.num_envs, "", 1)]
    if config.dreams:
        batches.append(("imagination.num_envs", dream.num_envs, "imagination.minibatches", dream.minibatches))
    if model.enabled:
        batches.append(("world_model.sequences", model.sequences, "world_model.minibatches", model.minibatches))
    for name, total, parts_name, parts in batches:
        share = parts * devices
        if total % share:
            near = [str(size) for size in (total // share * share, -(-total // share) * share) if size]
            divided = f" in {parts_name}={parts} minibatches" if parts > 1 else ""
            yield f"{name}={total}{divided} has no {devices} equal parts, {name}={' or '.join(near)} has"
    if config.policy.cnn_norm == "batch":
        yield "policy.cnn_norm=batch takes the mean of a whole batch, which no device has: instance or layer"
