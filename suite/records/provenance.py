"""What a result may depend on beside its configuration: software, hardware, and the memory that was used."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import resource
import subprocess
from pathlib import Path
from typing import Any

PACKAGES = ("jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "flashbax", "numpy", "world-model-suite")


def provenance(seeds: int = 1) -> dict[str, Any]:
    """Versions, commit and devices, as they stand in record.json; `seeds`: how many runs go on together."""
    import jax

    from suite.runtime import layout

    device = jax.devices()[0]
    return {
        "python": platform.python_version(),
        "packages": {name: package_version(name) for name in PACKAGES},
        "git_commit": _git_commit(),
        "device": {
            "platform": device.platform,
            "kind": device.device_kind,
            "cpu_cores": os.cpu_count(),
            "count": layout.devices(),
            "seeds": seeds,
        },
    }


def peak_memory() -> dict[str, int]:
    """Bytes: of this process, and of the device where it has memory of its own."""
    import jax

    peaks = {"process": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024}  # Linux counts in KiB
    statistics = jax.local_devices()[0].memory_stats() or {}
    if "peak_bytes_in_use" in statistics:
        peaks["device"] = statistics["peak_bytes_in_use"]
    return peaks


def package_version(package: str) -> str | None:
    """Of an installed package, None if it is not installed."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _git_commit() -> str | None:
    """The commit of the code that runs, "-dirty" if it was changed since; None if it is no checkout."""
    here = Path(__file__)

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(here.parent), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()

    try:
        git("ls-files", "--error-unmatch", here.name)  # or an installed copy inside someone else's checkout
        return git("describe", "--always", "--abbrev=40", "--exclude=*", "--dirty")
    except (OSError, subprocess.SubprocessError):
        return None
