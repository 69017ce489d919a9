"""SIGINT (Ctrl-C), SIGTERM and SIGHUP (a closed terminal) while something runs that should come to a good end first."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Callable, Iterator


@contextlib.contextmanager
def stop_signals(heard: Callable[[int], None]) -> Iterator[None]:
    """Each of them calls `heard` with how many there have been, and does nothing else.

    Outside of the main thread, which alone may handle signals, they are left to whoever runs us there; and SIGHUP to
    `nohup`, which has us ignore it.
    """
    count = 0

    def handle(number: int, frame: object) -> None:
        nonlocal count
        count += 1
        heard(count)

    numbers = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    try:
        before = {number: signal.signal(number, handle) for number in numbers}
    except ValueError:
        before = {}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
