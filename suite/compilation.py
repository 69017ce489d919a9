"""JAX's persistent compilation cache: the second start of a command compiles nothing that the first one compiled."""

from __future__ import annotations

from suite.cache import cache_dir

MIN_COMPILE_SECONDS = 0.5  # below this, reading the cache costs as much as compiling


def enable_compilation_cache() -> None:
    """Keeps compiled programs in the user's cache folder (`SUITE_CACHE_DIR`), unless JAX was told of another."""
    import jax

    if jax.config.jax_compilation_cache_dir is None:
        jax.config.update("jax_compilation_cache_dir", str(cache_dir() / "xla"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", MIN_COMPILE_SECONDS)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
