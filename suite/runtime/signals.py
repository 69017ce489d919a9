"""SIGINT (Ctrl-C) and SIGTERM while something runs that should come to a good end first."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Callable, Iterator


@contextlib.contextmanager
def stop_signals(heard: Callable[[int], None]) -> Iterator[None]:
    """Each of them calls `heard` with how many there have been, and does nothing else.

    Outside of the main thread, which alone may handle signals, they are left to whoever runs us there.
    """
    count = 0

    def handle(number: int, frame: object) -> None:
        nonlocal count
        count += 1
        heard(count)

    try:
        before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    except ValueError:
        before = {}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
