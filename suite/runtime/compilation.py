"""JAX's persistent compilation cache: the second start of a command compiles nothing that the first one compiled."""

from __future__ import annotations

import concurrent.futures
import hashlib
import logging
import os
import platform
import sys
import threading
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from suite.runtime.cache import cache_dir
from suite.runtime.errors import UserError

if TYPE_CHECKING:
    import jax

# Programs compiled beside the main thread. XLA compiles one with several threads already: with two of them a first
# policy update came five seconds later on two cores.
AT_ONCE = 1

TRANSFERS = ("", "_HOST_TO_DEVICE", "_DEVICE_TO_DEVICE", "_DEVICE_TO_HOST")

OFF = ("", "none", "0", "false", "f", "no", "n", "off")
# Switches of JAX's that change what is computed, or that the compiled phases do not survive, and what they may be.
ARITHMETIC: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("JAX_ENABLE_X64", "JAX_DISABLE_JIT", "JAX_NO_EXECUTION", "JAX_NO_TRACING"), OFF),
    **dict.fromkeys(("JAX_DEBUG_NANS", "JAX_DEBUG_INFS", "JAX_DEBUG_KEY_REUSE", "JAX_HIGH_DYNAMIC_RANGE_GUMBEL"), OFF),
    **dict.fromkeys((f"JAX_TRANSFER_GUARD{way}" for way in TRANSFERS), ("", "none", "allow", "log")),
    "JAX_DEFAULT_DTYPE_BITS": ("", "64"),
    "JAX_DEFAULT_MATMUL_PRECISION": ("", "none", "default", "high", "highest", "float32"),  # or more than that
    "JAX_DEFAULT_PRNG_IMPL": ("", "threefry2x32"),
    "JAX_RANDOM_SEED_OFFSET": ("", "0"),
    "JAX_THREEFRY_PARTITIONABLE": ("", "1", "true", "t", "yes", "y", "on"),
}
CPU_INFO = Path("/proc/cpuinfo")


def quiet_xla() -> None:
    """Silences XLA's own log, unless the user set its level: call it before JAX is imported.

    Each program that XLA loads from the cache otherwise prints a page about features that no CPU has. So does JAX of
    an error on the host, which reaches us as an exception besides (`suite.runtime.errors.host_errors`).
    """
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    logging.getLogger("jax._src.callback").setLevel(logging.CRITICAL)


def refuse_other_arithmetic() -> None:
    """Looks for switches of JAX's that change what is computed, or that its compiled phases do not survive.

    Raises:
      UserError: one is set in the environment, or by a program that has imported JAX.
    """
    jax = sys.modules.get("jax")  # not imported for this: a typo does not wait for it
    for name, allowed in ARITHMETIC.items():
        if (value := os.environ.get(name, "")).lower() not in allowed:
            raise UserError(
                f"{name}={value} is set in the environment, and would change results or end the run: unset it"
            )
        if jax is not None and (held := str(getattr(jax.config, name.lower(), ""))).lower() not in allowed:
            raise UserError(f"jax.config.{name.lower()} is {held}, which would change results or end the run")


def device_kind() -> str:
    """The kind of device that JAX computes on: "cpu", "gpu" or "tpu".

    Raises:
      UserError: there is none of the kind that is asked for.
    """
    import jax

    try:
        return jax.default_backend()
    except (RuntimeError, AssertionError) as error:  # which one depends on what is wrong
        variables = ("JAX_PLATFORMS", "JAX_PLATFORM_NAME")
        asked = " and ".join(f"{name}={os.environ[name]}" for name in variables if os.environ.get(name))
        raise UserError(
            f"JAX finds no device for {asked or jax.config.jax_platforms}; this machine has: "  # type: ignore[attr-defined]
            f"{', '.join(_platforms())}; without the variable JAX takes the fastest"
        ) from error


def _platforms() -> list[str]:
    """Kinds of devices that JAX finds here if it is not asked for one."""
    import jax
    from jax.extend.backend import backends, clear_backends

    asked = {"jax_platforms": jax.config.jax_platforms, "jax_platform_name": os.environ.get("JAX_PLATFORM_NAME", "")}  # type: ignore[attr-defined]
    try:
        for name in asked:
            jax.config.update(name, "")
        return sorted(backends())
    finally:
        for name, value in asked.items():
            jax.config.update(name, value)
        clear_backends()


def enable_compilation_cache() -> None:
    """Keeps compiled programs in the user's cache folder (`SUITE_CACHE_DIR`), unless JAX was told of another."""
    import jax

    if jax.config.jax_compilation_cache_dir is None:  # type: ignore[attr-defined]
        jax.config.update("jax_compilation_cache_dir", str(cache_dir() / "xla" / cpu_digest()))
    # Small programs too: reading one takes 6 ms, and compiling it 15 and more.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)


def cpu_digest() -> str:
    """Tells kinds of CPU apart: a program compiled for one may hold instructions that another lacks."""
    try:
        lines = CPU_INFO.read_text().splitlines()
    except OSError:  # not Linux
        lines = []
    flags = next((line for line in lines if line.lower().startswith(("flags", "features"))), "")
    features = " ".join(sorted(flags.partition(":")[2].split()))
    return hashlib.sha256(f"{platform.machine()} {features}".encode()).hexdigest()[:8]


class Ahead:
    """Programs that are compiled beside each other, before they are called and while others run.

    JAX keeps what it compiled for a function and the shapes of its arguments: a call after `wait` compiles nothing.
    """

    def __init__(self) -> None:
        self._pool = concurrent.futures.ThreadPoolExecutor(1 + AT_ONCE)
        self._compiled: dict[str, concurrent.futures.Future] = {}
        self._traced: concurrent.futures.Future | None = None
        self._changed = threading.Condition()

    def begin(self, programs: Iterable[tuple[str, jax.stages.Lowered]]) -> None:
        """Compiles them in threads of its own: programs by name, in the order in which they are needed."""
        from suite.runtime import layout

        self._traced = self._pool.submit(self._trace, programs, layout.mesh())
        self._traced.add_done_callback(lambda _: self._notify())

    def wait(self, name: str) -> None:
        """Returns when the program of that name is compiled, if there is one; raises what was raised of it."""
        traced = self._traced
        if traced is None:
            return
        with self._changed:
            self._changed.wait_for(lambda: name in self._compiled or traced.done())
        self._compiled.get(name, traced).result()

    def close(self) -> None:
        """Begins no more of them; those that are being compiled are not interrupted."""
        self._pool.shutdown(wait=False, cancel_futures=True)

    def _trace(self, programs: Iterable[tuple[str, jax.stages.Lowered]], mesh: jax.sharding.Mesh | None) -> None:
        from suite.runtime import layout

        with layout.same(mesh):
            for name, lowered in programs:
                self._compiled[name] = self._pool.submit(lowered.compile)
                self._notify()

    def _notify(self) -> None:
        with self._changed:
            self._changed.notify_all()
