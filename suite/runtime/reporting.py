"""How a run tells of itself while it runs. Results are printed by `suite.cli`; this is the way there, on stderr."""

from __future__ import annotations

import contextlib
import sys
import time
from collections import deque
from typing import IO, Protocol, TextIO, cast

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn

WINDOW = 10  # iterations over which speed is measured


class Reporter(Protocol):
    """What a long command tells its caller."""

    def message(self, text: str) -> None:
        """One line of news."""

    def warning(self, text: str) -> None:
        """One line that must be seen."""

    def start(self, total_steps: int, done_steps: int) -> None:
        """Real steps are about to be taken, from `done_steps` to `total_steps`."""

    def update(self, steps: int, phase: str, fields: dict[str, float]) -> None:
        """Steps taken so far, the phase that begins ("" if none does), and numbers to show; others stay."""

    def texture(self, message: str, fraction: float) -> None:
        """A preparation of which `fraction` is done."""

    def stop(self) -> None:
        """No more progress will come."""


class _Stderr:
    """The present stderr, which may go away: a terminal is closed, or whoever read the pipe has gone.

    What runs must then come to its good end, so that what cannot be shown is dropped.
    """

    @property
    def _file(self) -> TextIO:
        return getattr(sys.stderr, "rich_proxied_file", sys.stderr)  # a live bar stands in front of it

    @property
    def encoding(self) -> str:
        return self._file.encoding

    def write(self, text: str) -> int:
        with contextlib.suppress(OSError):
            self._file.write(text)
        return len(text)

    def flush(self) -> None:
        with contextlib.suppress(OSError):
            self._file.flush()

    def isatty(self) -> bool:
        return self._file.isatty()

    def fileno(self) -> int:
        return self._file.fileno()


def stderr_console() -> Console:
    """Where progress is shown."""
    return Console(file=cast(IO[str], _Stderr()), highlight=False, soft_wrap=True)


class QuietReporter:
    """Warnings only."""

    def __init__(self, console: Console | None = None):
        self._console = console or stderr_console()

    def message(self, text: str) -> None:
        pass

    def warning(self, text: str) -> None:
        self._console.print(f"warning: {escape(text)}")

    def start(self, total_steps: int, done_steps: int) -> None:
        pass

    def update(self, steps: int, phase: str, fields: dict[str, float]) -> None:
        pass

    def texture(self, message: str, fraction: float) -> None:
        pass

    def stop(self) -> None:
        pass


class RichReporter(QuietReporter):
    """A live bar on a terminal; elsewhere a plain line every `interval` seconds."""

    def __init__(self, console: Console | None = None, interval: float = 10.0):
        super().__init__(console)
        self._interval = interval
        self._next_line = 0.0
        self._bar: Progress | None = None
        self._total = self._steps = 0  # a total of 0: not known
        self._phase = ""
        self._fields: dict[str, float] = {}
        self._history: deque[tuple[float, int]] = deque(maxlen=WINDOW)

    def message(self, text: str) -> None:
        self._console.print(escape(text))

    def start(self, total_steps: int, done_steps: int) -> None:
        self.stop()
        self._total, self._steps = total_steps, done_steps
        self._history.clear()
        self._history.append((time.monotonic(), done_steps))
        self._show(done_steps, total_steps, self._line())

    def update(self, steps: int, phase: str, fields: dict[str, float]) -> None:
        if steps > self._steps or not self._history:
            self._history.append((time.monotonic(), steps))
        self._steps = steps
        self._phase = phase or self._phase
        self._fields |= {name: value for name, value in fields.items() if value == value}  # nan: nothing new
        self._show(steps, self._total, self._line())

    def texture(self, message: str, fraction: float) -> None:
        self._show(fraction, 1.0, message)
        if fraction >= 1:
            self.stop()

    def stop(self) -> None:
        if self._bar is not None:
            self._bar.stop()
        self._bar = None
        self._next_line = 0.0

    def _line(self) -> str:
        total = f"/{self._total:,}" if self._total else ""
        parts = [f"{self._steps:,}{total} steps", self._phase]
        parts += [f"{name} {value:.3g}" for name, value in self._fields.items()]
        (start_time, start_steps), (end_time, end_steps) = self._history[0], self._history[-1]
        if end_steps > start_steps and end_time > start_time:
            speed = (end_steps - start_steps) / (end_time - start_time)
            parts.append(f"{speed:,.0f} steps/s" if speed >= 10 else f"{speed:.2g} steps/s")
            if self._total > self._steps:
                parts.append(f"{_duration((self._total - self._steps) / speed)} left")
        return " | ".join(part for part in parts if part)

    def _show(self, done: float, total: float, text: str) -> None:
        if self._console.is_terminal:
            if self._bar is None:
                self._bar = Progress(BarColumn(bar_width=24), TextColumn("{task.description}"), console=self._console)
                self._bar.add_task("")
                self._bar.start()
            self._bar.update(self._bar.task_ids[0], completed=done, total=total or None, description=escape(text))
        elif (now := time.monotonic()) >= self._next_line:
            self._next_line = now + self._interval
            share = f"{done / total:4.0%} " if total else ""
            self._console.print(f"{share}{escape(text)}")


def _duration(seconds: float) -> str:
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}" if hours else f"{minutes}:{seconds:02d}"
