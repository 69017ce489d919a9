"""How much of a program's time its devices exchange numbers, and wait for each other to do so."""

from __future__ import annotations

import re
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import jax

COLLECTIVES = re.compile("(all-gather|all-reduce|all-to-all|collective-permute|reduce-scatter)", re.IGNORECASE)
KERNELS = re.compile(".*nccl", re.IGNORECASE)  # which they are on a GPU


def share_in_collectives(call: Callable[[], Any], devices: int) -> float:
    """The share of `devices` times the duration of a call, from 0 to 1, that its collective operations take.

    From a trace of JAX's profiler, of which only runs on CPUs have been seen. The call is slower for being traced.
    """
    options = jax.profiler.ProfileOptions()
    options.python_tracer_level = 0
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder, profiler_options=options):
            start = time.perf_counter()
            jax.block_until_ready(call())
            seconds = time.perf_counter() - start
        traces = [jax.profiler.ProfileData.from_file(str(path)) for path in Path(folder).rglob("*.xplane.pb")]
    spans = (_spans(line.events, name) for trace in traces for line, name in _lines(trace))
    return sum(map(_covered, spans)) / 1e9 / (devices * seconds)


def _lines(trace: Any) -> Iterator[tuple[Any, re.Pattern[str]]]:
    """Lines of what devices did, and the names of collective operations there."""
    for plane in trace.planes:
        if plane.name.startswith("/device"):
            yield from ((line, KERNELS) for line in plane.lines if line.name.startswith("Stream"))
        elif plane.name == "/host:CPU":
            yield from ((line, COLLECTIVES) for line in plane.lines)


def _spans(events: Iterable[Any], name: re.Pattern[str]) -> list[tuple[float, float]]:
    return sorted((event.start_ns, event.start_ns + event.duration_ns) for event in events if name.match(event.name))


def _covered(spans: Iterable[tuple[float, float]]) -> float:
    """How much these cover, where they overlap only once."""
    total, until = 0.0, float("-inf")
    for start, end in spans:
        total += max(0.0, end - max(start, until))
        until = max(until, end)
    return total
