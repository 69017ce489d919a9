from __future__ import annotations

import errno
import io
import sys

import pytest
from rich.console import Console

from suite.runtime import reporting
from suite.runtime.reporting import QuietReporter, RichReporter


def console(terminal):
    return Console(file=io.StringIO(), force_terminal=terminal, width=120, soft_wrap=True, color_system=None)


@pytest.fixture
def clock(monkeypatch):
    """Sets the time that reporters see."""
    now = [100.0]
    monkeypatch.setattr(reporting.time, "monotonic", lambda: now[0])
    return now


def test_plain_lines_where_there_is_no_terminal(clock):
    reporter = RichReporter(console(False), interval=10)
    reporter.start(1000, 0)
    for step in range(5):
        clock[0] += 5
        reporter.update(100 * (step + 1), "collect", {"return": 1.5})
    reporter.stop()
    lines = reporter._console.file.getvalue().splitlines()
    assert lines[0] == "  0% 0/1,000 steps"
    assert lines[1] == " 20% 200/1,000 steps | collect | return 1.5 | 20 steps/s | 0:40 left"
    assert len(lines) == 3  # one each ten seconds


@pytest.mark.parametrize("terminal", [True, False])
def test_any_order_of_calls(terminal, clock):
    """Progress before `start` says how many steps there are must not stop a run."""
    reporter = RichReporter(console(terminal), interval=0)
    reporter.update(0, "start", {})
    reporter.update(10, "", {"return": float("nan")})
    clock[0] += 1
    reporter.update(30, "collect", {})
    reporter.texture("textures", 0.5)
    reporter.texture("textures", 1.0)
    reporter.start(0, 0)
    reporter.start(100, 50)
    reporter.update(100, "evaluate", {})
    reporter.message("a [bold]line[/] of news")
    reporter.stop()
    reporter.stop()
    text = reporter._console.file.getvalue()
    assert "nan" not in text and "textures" in text and "a [bold]line[/] of news" in text
    if not terminal:
        assert "\n30 steps | collect | 30 steps/s\n" in text
        assert "50% textures\n100% textures\n" in text


def test_a_bar_on_a_terminal(clock):
    reporter = RichReporter(console(True))
    reporter.start(1000, 500)
    clock[0] += 10
    reporter.update(600, "imagine", {"return": 2.0})
    reporter.stop()
    assert "600/1,000 steps | imagine | return 2 | 10 steps/s | 0:40 left" in reporter._console.file.getvalue()


def test_a_resumed_run_is_timed_from_where_it_resumed(clock):
    reporter = RichReporter(console(False), interval=0)
    reporter.start(1000, 0)
    reporter.start(1000, 900)
    clock[0] += 10
    reporter.update(910, "", {})
    assert reporter._console.file.getvalue().splitlines()[-1].endswith("1 steps/s | 1:30 left")


def test_quiet_is_quiet_but_for_warnings():
    reporter = QuietReporter(console(False))
    reporter.start(10, 0)
    reporter.update(5, "collect", {})
    reporter.message("news")
    reporter.texture("textures", 1.0)
    reporter.warning("checkpoint [2] is damaged")
    reporter.stop()
    assert reporter._console.file.getvalue() == "warning: checkpoint [2] is damaged\n"


class Gone(io.StringIO):
    """A terminal that was closed."""

    def __init__(self, terminal):
        super().__init__()
        self.terminal = terminal

    def isatty(self):
        return self.terminal

    def write(self, text=""):
        raise OSError(errno.EIO, "Input/output error")

    flush = write


@pytest.mark.parametrize("terminal", [True, False])
def test_a_closed_terminal_ends_no_run(monkeypatch, terminal):
    monkeypatch.setattr(sys, "stderr", Gone(terminal))
    reporter = RichReporter(interval=0)
    reporter.start(1000, 0)
    reporter.update(100, "collect", {"return": 1.5})
    reporter.message("stopping")
    reporter.warning("careful")
    reporter.stop()
