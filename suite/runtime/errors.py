"""The ways a command can fail that are not bugs. `suite.cli` turns each into one line on stderr."""

from __future__ import annotations

import contextlib
import difflib
import errno
import os
import re
from collections.abc import Iterable, Iterator


class UserError(Exception):
    """Bad input: one line that says what was wrong and what would be right."""

    exit_code = 2


class FolderInUseError(UserError):
    """Another process has the run's folder open: the same command may do later."""

    exit_code = 75  # "temporary failure" in BSD's sysexits.h


class RunError(Exception):
    """A run that cannot go on (diverged loss, full disk): one line. The last checkpoint stays."""

    exit_code = 1


def did_you_mean(word: str, valid: Iterable[str]) -> str:
    """A clause that names the nearest valid word, or one that begins so, or lists the valid ones when none is near."""
    choices = sorted(valid)
    near = difflib.get_close_matches(word, choices, n=1, cutoff=0.6)
    near = near or [choice for choice in choices if len(word) > 2 and choice.startswith(word)]
    if near:
        return f"did you mean {near[0]!r}?"
    return f"valid: {', '.join(choices)}"


@contextlib.contextmanager
def host_errors() -> Iterator[None]:
    """Brings out a `UserError` or `RunError` that the host raised inside a compiled program: JAX only quotes it."""
    try:
        yield
    except (UserError, RunError):
        raise
    except Exception as error:
        quoted = re.search(r"^(?:[\w.]+\.)?(UserError|RunError): (.*)$", str(error), re.MULTILINE)
        if quoted is None:
            raise
        raise {"UserError": UserError, "RunError": RunError}[quoted[1]](quoted[2]) from error


FULL, BROKEN = (errno.ENOSPC, errno.EDQUOT), (errno.EROFS, errno.EIO, errno.EFBIG, errno.ESTALE)


@contextlib.contextmanager
def refusals_are_errors() -> Iterator[None]:
    """Turns what a full, broken or read-only disk, or the memory, refuses into a `RunError`, wherever it is noticed."""
    try:
        yield
    except (UserError, RunError, BrokenPipeError):
        raise
    except Exception as error:
        if problem := _refused(error):
            raise RunError(f"{problem}; what was saved is intact") from error
        raise


def _refused(error: BaseException | None) -> str:
    """What the system refused and what to do, also where a library wraps its error or only quotes it; "" if nothing."""
    while error is not None:
        if any(getattr(error, "errno", None) == number or os.strerror(number) in str(error) for number in FULL):
            return "disk full: free some space, and run the same command again"
        for number in BROKEN:
            if getattr(error, "errno", None) == number or os.strerror(number) in str(error):
                return f"{os.strerror(number)}: see to the disk"
        if isinstance(error, PermissionError):
            return f"{error.strerror}, {error.filename}: see to its permissions"
        if isinstance(error, MemoryError) or "Out of memory" in str(error):
            return "out of memory: sizes, buffers or numbers of environments must be smaller on this machine"
        error = error.__cause__ or error.__context__
    return ""
