"""Many runs: tasks x agents x seeds, each a `suite run` in a process of its own, some side by side.

Nothing starts before all of them are known to be right. Finished runs are left alone, and those that were stopped go
on where they were, so that the same sweep again does what is missing. Where processes start is a function's business:
`Process` is on this machine, in one of `suite.runs.places`; `suite.runs.sweep_ray` is on a cluster.
"""

from __future__ import annotations

import contextlib
import dataclasses
import fnmatch
import json
import math
import os
import platform
import shlex
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from suite import registry
from suite.configuration.schema import Config
from suite.records.record import RunRecord, require_writable, run_folder
from suite.runs.devices import Asked
from suite.runs.places import Environment
from suite.runtime.errors import FolderInUseError, UserError
from suite.runtime.signals import stop_signals

PAUSE = 0.25  # seconds between two looks at the runs
TAIL = 1 << 16  # bytes at the end of a file that are looked at
RETRIES = 2  # of a run that died, unless the user says otherwise
# The process of a sweep that was killed may still be at its last checkpoint when the same sweep starts again.
PATIENCE, AGAIN = 600.0, 3.0
STOPPED = (130, -signal.SIGINT, -signal.SIGTERM)

# What a process starts with: it asks Linux for a SIGTERM when its parent dies, and becomes `suite`. `preexec_fn` would
# ask in a fork of the parent, which may have threads; between the fork and the question the parent may have died.
LAUNCHER = """
import ctypes, os, signal, sys
if sys.platform == "linux":
    ctypes.CDLL(None).prctl(1, signal.SIGTERM)
    if os.getppid() != int(sys.argv[1]):
        sys.exit("whoever started this is gone")
os.execv(sys.executable, [sys.executable, "-m", "suite.cli", *sys.argv[2:]])
"""


@dataclasses.dataclass(eq=False)
class Run:
    """One run of a sweep, and how far it is.

    Attributes:
      config, folder: what it is, and where its record lies or will lie.
      words: the command, after `suite`.
      status: "waiting", "running", "finished", "already finished", "stopped" or "failed".
      steps, seconds, scores: so far; seconds are of this sweep while it runs, of the record once it has ended.
      reason: why it failed.
    """

    config: Config
    folder: Path
    words: list[str]
    status: str = "waiting"
    steps: int = 0
    seconds: float = 0.0
    scores: dict[str, float] = dataclasses.field(default_factory=dict)
    reason: str = ""

    def __post_init__(self) -> None:
        self._log_bytes = _size(log_of(self.folder))
        self._started = 0.0

    def watch(self) -> None:
        """Reads from the run's files, which may be of another machine, whether it has started and where it is."""
        if self.status == "waiting" and _size(log_of(self.folder)) > self._log_bytes:
            self.status, self._started = "running", time.monotonic()
        if self.status == "running":
            self.steps, self.seconds = last_step(self.folder), time.monotonic() - self._started

    def end(self, outcome: Outcome) -> None:
        self.watch()
        if outcome.status != "stopped" or self.status != "waiting":  # what was stopped before it began still waits
            self.status = outcome.status
        self.reason = outcome.reason
        if outcome.result:
            self.steps, self.seconds = outcome.result["steps"], outcome.result["seconds"]
            scores = outcome.result["scores"].items()
            self.scores = {name: math.nan if value is None else value for name, value in scores}


@dataclasses.dataclass(frozen=True)
class Outcome:
    """How a run ended: a status of `Run`, why it failed, and what `suite run --json` told of it."""

    status: str
    reason: str = ""
    result: Mapping[str, Any] | None = None


class Handle(Protocol):
    """A run that was started somewhere."""

    def poll(self) -> Outcome | None:
        """How it ended; None: not yet."""

    def stop(self) -> None:
        """Tells it to stop after its iteration, with a checkpoint."""

    def kill(self) -> None:
        """Ends it at once."""


def plan(
    tasks: str,
    agents: str,
    seeds: Sequence[int],
    preset: str | None = None,
    overrides: Sequence[str] = (),
    steps: int | None = None,
    out: Path = Path("runs"),
    wandb: str | None = None,
    devices: Asked = None,
) -> list[Run]:
    """All runs of a sweep, each once, finished ones marked; nothing but the folder `out` is made.

    Args:
      tasks: ids and shell-style patterns of ids, with commas between them.
      agents: likewise.
      seeds, preset, overrides, steps: as in `suite.registry.resolve`.
      out: the folder of all runs.
      wandb: the project at Weights & Biases that gets curves; None: it gets none.
      devices: of each run, wherever it goes on; see `suite.runs.devices.chosen`.

    Raises:
      UserError: an unknown id, field or value in any of them, a folder that holds another run or cannot be written.
    """
    runs: dict[Path, Run] = {}
    options = {"--steps": steps, "--wandb": wandb, "--devices": devices}
    more = [word for name, value in options.items() if value is not None for word in (name, str(value))]
    agent_ids = _select("--agents", agents, registry.agents())
    with _device_memory_left_alone():
        for task in _select("--tasks", tasks, registry.tasks()):
            entry = registry.task(task)
            for agent in map(registry.agent, agent_ids):
                for seed in seeds:
                    try:
                        config = registry.resolve(task, agent.id, preset, overrides, seed, steps)
                    except UserError as error:
                        raise UserError(f"{task}, agent {agent.id}: {error}") from error
                    words = ["run", task, "--agent", agent.id, "--preset", config.preset, "--seed", str(seed)]
                    words += ["--out", str(out), *more, *overrides, "--json"]
                    folder = run_folder(out, config)
                    runs[folder] = run = Run(config, folder, words)
                    if (folder / "record.json").exists():
                        record = RunRecord.open(folder, config, entry.spec(), lock=False)
                        run.steps, run.seconds = last_step(folder), record.wall_seconds
                        if record.finished:
                            run.status = "already finished"
                            run.scores = entry.scores()(record.episodes(), config, record.spec)
    require_writable(out)
    return list(runs.values())


def sweep(
    runs: Sequence[Run],
    start: Callable[[Run, Environment], Handle],
    places: Sequence[Environment] | None = None,
    show: Callable[[Sequence[Run], bool], None] = lambda runs, stopping: None,
) -> None:
    """Takes all runs that wait to their ends. Those that fail do not stop the others.

    The first SIGINT or SIGTERM stops the runs after their iterations, with checkpoints; the second ends them at once.

    Args:
      runs: their status and progress are kept up to date.
      start: starts one, with what is to be in its environment besides ours.
      places: the environments of those that go on at once; None: all do, for `start` has a queue of its own.
      show: called several times a second, with the runs and whether they were told to stop.
    """
    waiting = deque(run for run in runs if run.status == "waiting")
    free = deque([Environment()] * len(waiting) if places is None else places)
    going: dict[Run, tuple[Handle, Environment]] = {}
    told, signals = 0, list[int]()
    with stop_signals(signals.append):
        while going or (waiting and not signals):
            while waiting and free and not signals:
                run, place = waiting.popleft(), free.popleft()
                going[run] = start(run, place), place
            if told < len(signals):
                told = len(signals)
                for handle, _ in going.values():
                    if told == 1:
                        handle.stop()
                    else:
                        handle.kill()
            for run, (handle, place) in list(going.items()):
                if outcome := handle.poll():
                    run.end(outcome)
                    del going[run]
                    free.append(place)
                else:
                    run.watch()
            show(runs, bool(signals))
            time.sleep(PAUSE)


class Process:
    """A run as a process of this machine; it is told to stop when this one dies. Its output is in `log_of` its folder.

    A run whose folder is in use is tried again for a while. One that died of a signal, or failed otherwise than by bad
    input, is started again `retries` times; None: `RETRIES` times if it died, for an error would come again.
    """

    def __init__(
        self,
        words: Sequence[str],
        folder: Path,
        retries: int | None = None,
        environment: Environment | None = None,
    ):
        """`words` as in `Run`; `environment` is beside ours."""
        self._words, self._folder, self._retries = words, folder, retries
        self._environment = {**os.environ, **(environment or {})}
        self._process: subprocess.Popen[bytes] | None = None
        self._told = False
        self._failures = 0
        self._log_bytes = 0
        self._next = self._first = time.monotonic()  # when to start (again)

    def poll(self) -> Outcome | None:
        """How the run ended; None: not yet. It starts, and starts again, in here."""
        if self._process is None:
            if self._told:
                return Outcome("stopped")
            if time.monotonic() >= self._next:
                try:
                    self._start()
                except OSError as error:
                    return Outcome("failed", f"cannot be started: {error}")
            return None
        code = self._process.poll()
        if code is None:
            return None
        self._process = None
        return self._ended(code)

    def stop(self) -> None:
        # SIGTERM, for a shell may have made us ignore SIGINT, and our children with us.
        self._told = True
        if self._process is not None:
            self._process.terminate()

    def kill(self) -> None:
        self._told = True
        if self._process is not None:
            self._process.kill()

    def _start(self) -> None:
        self._folder.mkdir(parents=True, exist_ok=True)
        with log_of(self._folder).open("ab", buffering=0) as log:
            when = time.strftime("%Y-%m-%d %H:%M:%S")
            log.write(f"--- {when} on {platform.node()}: suite {shlex.join(self._words)}\n".encode())
            self._log_bytes = log.tell()
            self._process = subprocess.Popen(
                [sys.executable, "-c", LAUNCHER, str(os.getpid()), *self._words],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env=self._environment,
                process_group=0,  # a Ctrl-C is for us; twice, from the terminal and from us, would end it at once
            )

    def _ended(self, code: int) -> Outcome | None:
        lines = _last_lines(log_of(self._folder), self._log_bytes)
        if code == 0:
            result = next(filter(None, map(_result, reversed(lines))), None)
            return Outcome(result["status"], result=result) if result else Outcome("failed", "it told no result")
        died = code < 0
        if code in STOPPED or (self._told and died):
            return Outcome("stopped")
        errors = [line for line in lines if line.startswith("error: ")]
        reason = (errors or lines or [f"exit code {code}"])[-1]
        now = time.monotonic()
        if code == FolderInUseError.exit_code and now < self._first + PATIENCE:
            self._next = now + AGAIN
            return None
        self._failures += 1
        if code not in (UserError.exit_code, FolderInUseError.exit_code) and self._failures <= _allowed(
            self._retries, died
        ):
            self._next = now
            return None
        return Outcome("failed", f"died of {signal.Signals(-code).name}" if died else reason.removeprefix("error: "))


def log_of(folder: Path) -> Path:
    """Where the output of a sweep's run is kept."""
    return folder / "sweep.log"


def last_step(folder: Path) -> int:
    """At which step the newest iteration of a run ended, by the last whole row of its metrics."""
    try:
        with (folder / "metrics.csv").open("rb") as file:
            file.seek(max(file.seek(0, os.SEEK_END) - TAIL, 0))
            rows = file.read().rpartition(b"\n")[0].splitlines()
        return int(rows[-1].partition(b",")[0])
    except (OSError, IndexError, ValueError):  # no row yet
        return 0


def _select(option: str, words: str, known: Iterable[str]) -> list[str]:
    """The ids that these are or match. An id need not be known here: families have more tasks than are listed."""
    chosen: list[str] = []
    for word in _words(words):
        matching = fnmatch.filter(known, word) if set("*?[") & set(word) else [word]
        if not matching:
            raise UserError(f"{option}: nothing matches {word!r}; valid: {', '.join(sorted(known))}")
        chosen += matching
    return list(dict.fromkeys(chosen))


def _words(text: str) -> Iterator[str]:
    """What commas separate; those in brackets belong to an id, as in "openspiel/mnk(m=3,n=4,k=3)"."""
    word = None
    for part in text.split(","):
        word = part if word is None else f"{word},{part}"
        if word.count("(") <= word.count(")"):
            yield word
            word = None
    if word is not None:
        yield word


def _allowed(retries: int | None, died: bool) -> int:
    return (RETRIES if died else 0) if retries is None else retries


def _result(line: str) -> dict[str, Any] | None:
    """What `suite run --json` told, if this is that line."""
    try:
        value = json.loads(line)
    except ValueError:
        return None
    return value if isinstance(value, dict) and "status" in value else None


def _last_lines(path: Path, start: int) -> list[str]:
    """Those that are not empty, of the last part of what was written since the file had `start` bytes."""
    try:
        with path.open("rb") as file:
            file.seek(max(file.seek(0, os.SEEK_END) - TAIL, start))
            return [line for line in file.read().decode(errors="replace").splitlines() if line.strip()]
    except OSError:
        return []


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0


@contextlib.contextmanager
def _device_memory_left_alone() -> Iterator[None]:
    """To resolve a configuration is to ask JAX for the device, which by default may take most of its memory."""
    name = "XLA_PYTHON_CLIENT_PREALLOCATE"
    given = name in os.environ
    os.environ.setdefault(name, "false")
    try:
        yield
    finally:
        if not given:
            del os.environ[name]
