"""The runs of a sweep on a Ray cluster. Imported only when it is asked for: Ray is an optional extra.

Each run is a Ray task that starts the same process as on one machine. Ray starts a task again, maybe elsewhere, whose
worker or node died; the process of the old one is told to stop with its worker, and the new one goes on from the
checkpoint, if records lie on storage that all nodes share.
"""

from __future__ import annotations

import logging
import math
import os
import socket
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import ray
import ray.exceptions

from suite.runs.places import CPUS_PER_RUN, Environment, share_of_memory
from suite.runs.sweep import PAUSE, RETRIES, Outcome, Process, Run
from suite.runtime.errors import UserError

LOCAL = "local"  # Ray's word for: start one here
TIMEOUT = 10.0  # seconds
OBJECT_STORE = 100 * 2**20  # bytes: commands and results are small


class Cluster:
    """A connection to Ray, and what each run asks it for."""

    def __init__(
        self, address: str | None = None, gpus: float = 0.0, jobs: int | None = None, retries: int | None = None
    ):
        """Connects.

        Args:
          address: of a cluster; None: the variable RAY_ADDRESS, or else Ray is started on this machine, for so long.
          gpus: for each run: 0, which then computes on CPUs, a part of one, or a whole number.
          jobs: how many are to go on at once, so that each asks for no more than its share of the CPUs.
          retries: how often a run is started again whose worker or node died; None: `suite.runs.sweep.RETRIES`.

        Raises:
          UserError: there is no such cluster, or Ray was to start here and this machine lacks so many GPUs.
        """
        os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
        address = address or os.environ.get("RAY_ADDRESS") or LOCAL
        _require_reachable(address)
        own: dict[str, Any] = {"include_dashboard": False, "object_store_memory": OBJECT_STORE}
        with warnings.catch_warnings():
            # JAX fears for forks of its process; Ray's become other programs at once.
            warnings.filterwarnings("ignore", r"os\.fork\(\) was called", RuntimeWarning)
            try:
                ray.init(address, log_to_driver=False, logging_level=logging.ERROR, **own if address == LOCAL else {})
            except (ConnectionError, RuntimeError, ValueError, OSError) as error:
                raise UserError(f"cannot use Ray at {address}: {error}") from error
        nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        if address == LOCAL and gpus > nodes[0].get("GPU", 0):  # a cluster may get such a node yet
            self.close()
            raise UserError(f"--gpus={gpus:g}: Ray finds {nodes[0].get('GPU', 0):g} on this machine")
        self._work: Any = ray.remote(_work).options(
            num_cpus=cpus_per_run([node.get("CPU", 0) for node in nodes], jobs),
            num_gpus=gpus,
            max_retries=RETRIES if retries is None else retries,
            scheduling_strategy="SPREAD",
        )
        self.nodes, self._retries = len(nodes), retries
        self._environment = share_of_memory(gpus) if gpus else {"JAX_PLATFORMS": "cpu"}

    def start(self, run: Run) -> _Task:
        """Hands a run to Ray, which starts it when there is room."""
        return _Task(self._work.remote(run.words, run.folder, self._retries, self._environment))

    def close(self) -> None:
        ray.shutdown()


def _require_reachable(address: str) -> None:
    """Ray itself tries an address where nobody listens for minutes."""
    host, colon, port = address.rpartition("://")[2].rpartition(":")
    if not (colon and port.isdecimal()):
        return
    try:
        socket.create_connection((host.strip("[]"), int(port)), TIMEOUT).close()
    except (OSError, OverflowError) as error:
        raise UserError(f"cannot use Ray at {address}: {error}") from error


def cpus_per_run(of_nodes: Sequence[float], jobs: int | None) -> float:
    """What one run asks for: no more than a node has, nor than its share where `jobs` go on at once."""
    cpus = min(CPUS_PER_RUN, max(of_nodes) or CPUS_PER_RUN)
    if jobs is None or not sum(of_nodes):
        return cpus
    share = sum(of_nodes) / jobs
    return min(cpus, math.floor(share) or share)


def compute_types(gpus: float) -> list[str]:
    """What "auto" means on the nodes, which this machine need not be like: settings of every run."""
    kind = "bfloat16" if gpus else "float32"
    return [f"{part}.compute_type={kind}" for part in ("policy", "world_model")]


class _Task:
    """A run that Ray has; a `suite.runs.sweep.Handle`."""

    def __init__(self, reference: Any):
        self._reference = reference
        self._told = False

    def poll(self) -> Outcome | None:
        if not ray.wait([self._reference], timeout=0)[0]:
            return None
        try:
            return ray.get(self._reference)
        except ray.exceptions.RayError as error:
            lines = str(error).strip().splitlines() or [type(error).__name__]
            # Of what our own code raised, Ray quotes the traceback.
            reason = lines[-1] if isinstance(error, ray.exceptions.RayTaskError) else lines[0]
            return Outcome("stopped") if self._told else Outcome("failed", reason)

    def stop(self) -> None:
        self._told = True
        ray.cancel(self._reference)

    def kill(self) -> None:
        self._told = True
        ray.cancel(self._reference, force=True)


def _work(words: Sequence[str], folder: Path, retries: int | None, environment: Environment) -> Outcome:
    """On a node, in the main thread of one of Ray's workers: `ray.cancel` comes as a KeyboardInterrupt."""
    process = Process(words, folder, retries, environment)
    while True:
        try:
            while (outcome := process.poll()) is None:
                time.sleep(PAUSE)
            return outcome
        except KeyboardInterrupt:
            process.stop()
