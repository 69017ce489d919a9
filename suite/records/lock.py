"""The lock on a run's folder: at most one process writes into it."""

from __future__ import annotations

import contextlib
import fcntl
import os
import platform
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from suite.runtime.errors import FolderInUseError, UserError

LOCK = "run.lock"


def acquire(folder: Path) -> IO[str]:
    """The exclusive lock on a folder, held until the file is closed or its process ends, however it ends."""
    try:
        file = (folder / LOCK).open("a+")
    except OSError as error:
        raise UserError(f"cannot write to {folder}: {error.strerror}") from error
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.seek(0)
        owner = file.read().strip()
        file.close()
        raise FolderInUseError(f"{folder} is in use by another process ({owner or 'just started'})") from None
    with closed_on_error(file):
        file.truncate(0)
        file.write(f"pid {os.getpid()} on {platform.node()}")
        file.flush()
    return file


@contextlib.contextmanager
def closed_on_error(lock: IO[str] | None) -> Iterator[None]:
    """Lets others have the folder if what is done under its lock raises."""
    try:
        yield
    except BaseException:
        if lock is not None:
            with contextlib.suppress(OSError):  # of a full disk, which it was about
                lock.close()
        raise
