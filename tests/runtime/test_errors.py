"""Errors that the host raises inside compiled programs come out as what they are."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import pytest

from suite.runtime.compilation import quiet_xla
from suite.runtime.errors import RunError, UserError, host_errors


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
