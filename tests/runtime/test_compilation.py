from __future__ import annotations

import os

import jax
import pytest

from suite.runtime import compilation


def digest(monkeypatch, tmp_path, text, machine="x86_64"):
    file = tmp_path / "cpuinfo"
    file.write_text(text)
    monkeypatch.setattr(compilation, "CPU_INFO", file)
    monkeypatch.setattr(compilation.platform, "machine", lambda: machine)
    return compilation.cpu_digest()


def test_kinds_of_cpu_are_told_apart(monkeypatch, tmp_path):
    """A program for a CPU with AVX-512 stops one without it by SIGILL."""
    old = digest(monkeypatch, tmp_path, "cpu MHz\t: 1\nflags\t\t: fpu avx2\n")
    assert old == digest(monkeypatch, tmp_path, "cpu MHz\t: 2\nflags\t\t: avx2 fpu\n")
    assert old != digest(monkeypatch, tmp_path, "flags\t\t: fpu avx2 avx512f\n")
    assert old != digest(monkeypatch, tmp_path, "flags\t\t: fpu avx2\n", machine="aarch64")
    arm = digest(monkeypatch, tmp_path, "Features\t: asimd\n", machine="aarch64")
    assert arm != digest(monkeypatch, tmp_path, "Features\t: asimd sve\n", machine="aarch64")


def test_without_cpuinfo(monkeypatch, tmp_path):
    monkeypatch.setattr(compilation, "CPU_INFO", tmp_path / "none")
    assert len(compilation.cpu_digest()) == 8


@pytest.fixture
def cache_setting():
    before = jax.config.jax_compilation_cache_dir
    yield
    jax.config.update("jax_compilation_cache_dir", before)


def test_the_cache_lies_in_the_users_folder(monkeypatch, tmp_path, cache_setting):
    monkeypatch.setenv("SUITE_CACHE_DIR", str(tmp_path))
    jax.config.update("jax_compilation_cache_dir", None)
    compilation.enable_compilation_cache()
    assert jax.config.jax_compilation_cache_dir == str(tmp_path / "xla" / compilation.cpu_digest())


def test_the_users_own_settings_stay(monkeypatch, tmp_path, cache_setting):
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    compilation.enable_compilation_cache()
    assert jax.config.jax_compilation_cache_dir == str(tmp_path)
    monkeypatch.setenv("TF_CPP_MIN_LOG_LEVEL", "0")
    compilation.quiet_xla()
    assert os.environ["TF_CPP_MIN_LOG_LEVEL"] == "0"


def test_programs_are_compiled_ahead_once_each_and_their_errors_are_raised_where_they_are_needed():
    class Program:
        def __init__(self, error=None):
            self.error, self.times = error, 0

        def compile(self):
            self.times += 1
            if self.error:
                raise self.error

    good, bad = Program(), Program(ValueError("too large"))

    def programs():
        yield "good", good
        yield "bad", bad
        raise TypeError("cannot be traced")

    ahead = compilation.Ahead()
    ahead.wait("good")  # nothing has begun, so there is nothing to wait for
    ahead.begin(programs())
    ahead.wait("good")
    ahead.wait("good")
    with pytest.raises(ValueError, match="too large"):
        ahead.wait("bad")
    with pytest.raises(TypeError, match="cannot be traced"):
        ahead.wait("later")
    ahead.close()
    assert (good.times, bad.times) == (1, 1)
