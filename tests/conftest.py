"""Every test runs under strict dtype and rank promotion; pyproject.toml turns warnings into errors."""

from __future__ import annotations

import functools
import os
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # pages of harmless notes on a warm compilation cache
os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")

import jax
import jax.numpy as jnp
import pytest
from jax._src import compiler

EMITTERS = "xla_cpu_use_fusion_emitters"
_compile_options = compiler.get_compile_options

jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")
# A GPU multiplies float32 with ten bits of mantissa unless told otherwise; tests compare such products with NumPy.
jax.config.update("jax_default_matmul_precision", "highest")


@pytest.fixture(autouse=True, scope="session")
def compilation_cache():
    """Compile each Craftax program once per machine, as users do."""
    from suite.runtime.compilation import enable_compilation_cache

    enable_compilation_cache()


@pytest.fixture(autouse=True, scope="module")
def drop_compiled_programs():
    """Hundreds of compiled programs in one process exhaust it."""
    yield
    jax.clear_caches()


# Files that take longest, which begin first, so that the last of them does not keep one process busy alone.
LONGEST = (
    "baselines/test_agents_run.py",
    "adapters/craftax/test_craftax_full.py",
    "runs/test_training.py",
    "test_contract.py",
    "runs/test_sweep.py",
    "runs/test_devices.py",
    "runs/test_together.py",
    "agent/test_seeds.py",
    "world_model/test_imagination.py",
    "test_gpu_script.py",
    "policy/test_ppo.py",
    "adapters/craftax/test_craftax.py",
    "runs/test_sweep_ray.py",
    "leaderboards/test_publish.py",
    "adapters/openspiel/test_openspiel.py",
    "diagnostics/test_rules.py",
    "diagnostics/test_inspection.py",
    "adapters/openspiel/test_host.py",
)


def pytest_collection_modifyitems(items):
    """The same order in every process: whole files, the longest first, the others as they were found."""
    here = Path(__file__).parent
    rank = {name: place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: rank.get(item.path.relative_to(here).as_posix(), len(LONGEST)))


# Tests of these run small programs for a moment, so that compiling them is most of the time. What is compiled as for
# users is tested by the rest: every game of ours, and the runs that `.ci/run` makes after the tests.
HASTY = (
    "adapters/gymnasium",
    "adapters/openspiel",
    "adapters/pettingzoo",
    "agent",
    "baselines",
    "benchmarks",
    "commands",
    "diagnostics",
    "interface",
    "leaderboards",
    "nn",
    "policy",
    "runs",
    "test_api.py",
    "test_docs.py",
    "test_gpu_script.py",
    "tokenizers",
    "world_model",
)
# But for these, which compare two programs to the last bit: without optimizations XLA rounds in another way in a loop.
EXACT = ("runs/test_together.py",)


@pytest.fixture(autouse=True, scope="module")
def hasty_compilation(request):
    """Compiles the programs of a module below `HASTY` without most optimizations, in a third of the time."""
    name = request.path.relative_to(Path(__file__).parent).as_posix()
    if name in EXACT or not name.startswith(HASTY):
        yield
        return
    jax.config.update("jax_disable_most_optimizations", True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")  # processes that the module starts
        if _has_switch():
            patch.setenv("XLA_FLAGS", f"{os.environ.get('XLA_FLAGS', '')} --{EMITTERS}=false")
            patch.setattr(compiler, "get_compile_options", _hasty_options)
        yield
    jax.config.update("jax_disable_most_optimizations", False)


@functools.cache
def _has_switch() -> bool:
    """Whether XLA can still make a CPU's loops in the old way: JAX 0.11's cannot."""
    try:
        jax.jit(jnp.negative, compiler_options={EMITTERS: False})(jnp.zeros(()))
    except jax.errors.JaxRuntimeError:
        return False
    return True


def _hasty_options(*arguments, **options):
    """JAX's compile options, and that XLA makes a CPU's loops in the old way, which takes half of the time.

    JAX has no public setting for the options of all programs. Other devices than a CPU do not read this one.
    """
    found = _compile_options(*arguments, **options)
    found.env_option_overrides = [*found.env_option_overrides, (EMITTERS, False)]
    return found


@pytest.fixture
def suite(capsys):
    """Runs a command: its exit code, stdout and stderr."""

    from suite import cli

    def command(*words):
        code = cli.main(list(map(str, words)))
        return code, *capsys.readouterr()

    return command
