"""`suite sweep`: tasks x agents x seeds, side by side on this machine or on a Ray cluster."""

from __future__ import annotations

import argparse
import contextlib
import io
import re
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from suite.commands.configuration import add_devices, add_wandb, parse_seeds, require_wandb_of, whole
from suite.commands.printing import print_json, print_table, score_line
from suite.runtime.errors import UserError

if TYPE_CHECKING:
    from rich.console import Console, Group

    from suite.runs.places import Environment
    from suite.runs.sweep import Handle, Run

SUMMARY = "tasks x agents x seeds, side by side; the same command again does what is missing"
FAILED, STOPPED = 1, 130
# As they are listed where not all find room: what is going on and what went wrong first.
ORDER = ("running", "failed", "stopped", "waiting", "finished", "already finished")
STOPPING = "stopping: each run ends after its iteration, with a checkpoint (again: stop now)"
COLUMNS = ("task", "agent", "seed", "status", "steps", "minutes", "score")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--tasks", required=True, metavar="T,...", help="ids and patterns of them: 'minatar/*'")
    parser.add_argument("--agents", required=True, metavar="A,...", help="ids and patterns of them: mfrl,m5")
    parser.add_argument("--seeds", type=parse_seeds, default=[0], metavar="N-M", help="0-9 or 0,3,5 (default 0)")
    parser.add_argument("--preset", metavar="P", help="see `suite list presets` (default: fit for this machine)")
    parser.add_argument("--steps", type=int, metavar="N", help="real environment steps (default: the preset's)")
    parser.add_argument("--out", type=Path, default=Path("runs"), metavar="DIR", help="where records go (default runs)")
    parser.add_argument(
        "--jobs",
        type=whole(1),
        metavar="N",
        help="runs at once (default: 1 for two CPU cores; 1 for each GPU; Ray: what fits)",
    )
    parser.add_argument("--engine", choices=("local", "ray"), default="local", help="this machine (default), or Ray")
    parser.add_argument("--address", metavar="A", help="Ray's (default: RAY_ADDRESS, or Ray is started here)")
    parser.add_argument("--gpus", type=float, metavar="X", help="Ray: GPUs for each run (default 0: CPUs only)")
    parser.add_argument(
        "--retries", type=whole(0), metavar="N", help="of a run that failed or died (default: 2 if it died, else 0)"
    )
    add_devices(parser)
    add_wandb(parser)
    parser.add_argument("--quiet", action="store_true", help="no progress")
    parser.add_argument(
        "overrides", nargs="*", default=[], metavar="dotted.name=value", help="any field that `suite describe` shows"
    )


def execute(args: argparse.Namespace) -> int:
    if args.gpus is not None and not args.gpus >= 0:
        raise UserError(f"--gpus={args.gpus:g}: must be at least 0")
    if args.gpus and args.gpus > 1 and args.gpus % 1:
        raise UserError(f"--gpus={args.gpus:g}: Ray gives a part of one, or whole ones")
    on_ray = args.engine == "ray"
    if not on_ray and (args.address or args.gpus is not None):
        raise UserError(f"{'--address' if args.address else '--gpus'} is Ray's: add --engine ray")
    if on_ray:
        _require_ray()
    require_wandb_of(args)

    from suite.runs import sweep

    overrides, out = args.overrides, args.out
    if on_ray:  # whose workers are in other folders, and maybe on other kinds of machines
        from suite.runs.sweep_ray import compute_types

        overrides, out = [*compute_types(args.gpus or 0), *overrides], out.absolute()
    runs = sweep.plan(
        args.tasks, args.agents, args.seeds, args.preset, overrides, args.steps, out, args.wandb, args.devices
    )
    _require_devices(runs, args.devices, on_ray)
    if any(run.status == "waiting" for run in runs):
        with _engine(args, runs) as (start, places, where):
            if not args.quiet:
                print(f"{_plan_line(runs)}; {where}; records in {out}", flush=True)
            with _display(args.quiet) as show, contextlib.redirect_stdout(_RayNews()):
                sweep.sweep(runs, start, places, show)
    _print_results(runs)
    if args.json:
        print_json({"runs": [_fields(run) for run in runs]})
    statuses = {run.status for run in runs}
    return STOPPED if statuses & {"waiting", "stopped"} else FAILED if "failed" in statuses else 0


def _require_devices(runs: Sequence[Run], asked: Any, on_ray: bool) -> None:
    """Raises a UserError if a run cannot use so many devices; how many nodes of Ray have only they know."""
    from suite.runs.devices import chosen, require_equal_shares

    for run in runs:
        try:
            if not on_ray:
                chosen(run.config, asked)
            elif isinstance(asked, int):
                require_equal_shares(run.config, asked)
        except UserError as error:
            raise UserError(f"{run.config.task}, agent {run.config.agent}: {error}") from error


def _require_ray() -> None:
    try:
        import ray  # noqa: F401
    except ImportError as error:
        raise UserError("--engine ray needs Ray: pip install 'world-model-suite[ray]'") from error


@contextlib.contextmanager
def _engine(
    args: argparse.Namespace, runs: Sequence[Run]
) -> Iterator[tuple[Callable[[Run, Environment], Handle], Sequence[Environment] | None, str]]:
    """How to start a run, where those that go on at once are, and that in words."""
    if args.engine == "local":
        from suite.runs.places import places
        from suite.runs.sweep import Process

        local = places(sum(run.status == "waiting" for run in runs), args.jobs, args.devices)
        yield lambda run, place: Process(run.words, run.folder, args.retries, place), local, f"{len(local)} at once"
        return

    from suite.runs.sweep_ray import Cluster

    cluster = Cluster(args.address, args.gpus or 0, args.jobs, args.retries)
    anywhere: list[Environment] | None = [{}] * args.jobs if args.jobs else None
    try:
        yield lambda run, place: cluster.start(run), anywhere, f"on Ray (nodes: {cluster.nodes})"
    finally:
        cluster.close()


@contextlib.contextmanager
def _display(quiet: bool) -> Iterator[Callable[[Sequence[Run], bool], None]]:
    """Shows runs as they go: one live table on a terminal; elsewhere a line whenever a status changes."""
    from rich.live import Live

    from suite.runtime.reporting import stderr_console

    console = stderr_console()
    if quiet:
        yield lambda runs, stopping: None
    elif console.is_terminal:
        with Live(console=console, auto_refresh=False, transient=True) as live:
            yield lambda runs, stopping: live.update(status_table(runs, stopping, console.height), refresh=True)
    else:
        yield _Lines(console)


class _RayNews(io.TextIOBase):
    """Takes what Ray prints when a node dies, pages of its state, and shows what is news of it, on stderr."""

    def write(self, text: str) -> int:
        for name in re.findall(r"node name: (\S+) has been marked dead", text):
            print(f"Ray lost the node {name}: its runs go on elsewhere from their checkpoints", file=sys.stderr)
        return len(text)


class _Lines:
    """A line whenever a run's status changes."""

    def __init__(self, console: Console):
        self._console = console
        self._seen: dict[Path, str] = {}
        self._stopping = False

    def __call__(self, runs: Sequence[Run], stopping: bool) -> None:
        ended = sum(run.status not in ("waiting", "running") for run in runs)
        for run in runs:
            before = self._seen.setdefault(run.folder, run.status if run.status == "already finished" else "waiting")
            if run.status == before:
                continue
            self._seen[run.folder] = run.status
            *_, steps, minutes, score = _row(run)
            details = [] if run.status == "running" else [f"{steps} steps", f"{minutes} min", score, run.reason]
            texts = [f"[{ended}/{len(runs)}] {_name(run)}: {run.status}", *filter(None, details)]
            self._console.print(", ".join(texts), markup=False)
        if stopping and not self._stopping:
            self._console.print(STOPPING)
        self._stopping = stopping


def status_table(runs: Sequence[Run], stopping: bool, height: int) -> Group:
    """As many runs as fit into `height` lines, those first that matter most, and how many there are of each kind."""
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    room = max(height - 4, 1)  # beside the head, two lines below, and the cursor's
    chosen = set(sorted(runs, key=lambda run: ORDER.index(run.status))[:room])
    table = Table(box=None)
    for name in COLUMNS:
        table.add_column(name, no_wrap=True, justify="right" if name in ("seed", "steps", "minutes") else "left")
    for run in runs:
        if run in chosen:
            table.add_row(*map(Text, _row(run)))
    hidden = f"; {len(runs) - room} not shown" if len(runs) > room else ""
    lines = [f"{_counts(runs)}{hidden}", *([STOPPING] if stopping else [])]
    return Group(table, *(Text(line, no_wrap=True, overflow="ellipsis") for line in lines))


def _row(run: Run) -> list[str]:
    """A run's cells, in the order of COLUMNS."""
    from leaderboards.scoring import main_score

    config, total = run.config, run.config.protocol.steps
    # A run is finished when no whole iteration fits its budget any more.
    share = "" if "finished" in run.status else f" {run.steps / total:4.0%}"
    steps, minutes = f"{run.steps:,}/{total:,}{share}", f"{run.seconds / 60:.1f}"
    score = ""
    if run.scores:
        name = main_score(run.scores)
        score = score_line(name, run.scores[name])
    return [config.task, config.agent, str(config.seed), run.status, steps, minutes, score]


def _name(run: Run) -> str:
    return f"{run.config.task}, agent {run.config.agent}, seed {run.config.seed}"


def _plan_line(runs: Sequence[Run]) -> str:
    presets = ", ".join(dict.fromkeys(run.config.preset for run in runs))
    before = sum(run.status == "already finished" for run in runs)
    return f"{len(runs)} runs, preset {presets}" + (f", {before} already finished" if before else "")


def _counts(runs: Sequence[Run]) -> str:
    """How many have which status: "7 finished, 1 failed, 2 already finished"."""
    counts = Counter(run.status for run in runs)
    order = ("finished", "failed", "already finished", "running", "stopped", "waiting")
    return ", ".join(f"{counts[status]} {status}" for status in order if counts[status])


def _print_results(runs: Sequence[Run]) -> None:
    from suite.runs.sweep import log_of

    print_table([COLUMNS, *map(_row, runs)])
    for run in runs:
        if run.status == "failed":
            print(f"{_name(run)}: {run.reason}; see {log_of(run.folder)}")
    left = any(run.status in ("waiting", "stopped") for run in runs)
    print(_counts(runs) + ("; the same command goes on from there" if left else ""), flush=True)


def _fields(run: Run) -> dict[str, Any]:
    fields = {name: getattr(run.config, name) for name in ("task", "agent", "preset", "seed")}
    fields |= {"status": run.status, "steps": run.steps, "seconds": run.seconds, "folder": str(run.folder)}
    return fields | {"scores": run.scores} | ({"reason": run.reason} if run.reason else {})
