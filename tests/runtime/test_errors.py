"""Errors that the host raises inside compiled programs come out as what they are."""

from __future__ import annotations

import errno
import re

import jax
import jax.numpy as jnp
import pytest

from suite.runtime.compilation import quiet_xla
from suite.runtime.errors import RunError, UserError, host_errors, refusals_are_errors


def called_back(error):
    def fail(x):
        raise error

    quiet_xla()
    shape = jax.ShapeDtypeStruct((), jnp.float32)
    program = jax.jit(lambda x: jax.lax.fori_loop(0, 3, lambda i, x: jax.pure_callback(fail, shape, x), x))
    jax.block_until_ready(program(jnp.float32(0)))


@pytest.mark.parametrize("kind", [UserError, RunError])
def test_an_error_of_a_callback_is_brought_out(kind, capfd):
    with pytest.raises(kind, match=r"^the engine: no more moves$"), host_errors():
        called_back(kind("the engine: no more moves"))
    assert capfd.readouterr().err == ""


def test_other_errors_stay_what_they_are():
    with pytest.raises(Exception, match="ValueError: a bug") as caught, host_errors():
        called_back(ValueError("a bug"))
    assert not isinstance(caught.value, UserError | RunError)
    with pytest.raises(KeyError), host_errors():
        raise KeyError("x")
    with pytest.raises(UserError, match=r"^as it is$"), host_errors():
        raise UserError("as it is")


@pytest.mark.parametrize(
    ("cause", "told"),
    [
        (
            ValueError("RESOURCE_EXHAUSTED: write: No space left on device"),
            "disk full: free some space, and run the same command again; what was saved is intact",
        ),
        (OSError(errno.ENOSPC, "No space left on device"), "disk full"),
        (OSError(errno.EDQUOT, "quota"), "disk full"),
        (OSError(errno.EROFS, "Read-only file system"), "Read-only file system: see to the disk"),
        (ValueError("INTERNAL: Error writing x: Input/output error"), "Input/output error: see to the disk"),
        (
            RuntimeError("INTERNAL: Error dispatching computation: Out of memory allocating 8 bytes."),
            "out of memory: sizes",
        ),
        (MemoryError(), "out of memory"),
        (PermissionError(errno.EACCES, "Permission denied", "a/b"), "Permission denied, a/b: see to its permissions"),
    ],
)
def test_what_the_system_refuses_is_one_line_also_where_a_library_wraps_or_quotes_it(cause, told):
    with pytest.raises(RunError, match=told), refusals_are_errors():
        raise RuntimeError("wrapped") from cause


def test_other_errors_are_left_alone():
    for error in (OSError(errno.ENOENT, "nothing there"), BrokenPipeError(), UserError("Input/output error")):
        with pytest.raises(type(error), match=re.escape(str(error)) or None), refusals_are_errors():
            raise error
