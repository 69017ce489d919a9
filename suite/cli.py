"""The `suite` command: parsing and printing only.

Results go to stdout, progress and errors to stderr. Bad input is one line and exit code 2; a run that cannot go on
is one line and exit code 1; a run that was told to stop exits with 130. Nothing that imports JAX is imported
before the words of the command are known to be right.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import numbers
import os
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from suite.compilation import quiet_xla
from suite.errors import RunError, UserError, did_you_mean, host_errors

if TYPE_CHECKING:
    from suite.reporting import Reporter
    from suite.run import Result

COMMANDS = ("run", "list", "describe", "evaluate", "inspect", "compare", "bench")
LISTS = ("tasks", "agents", "presets")
BAD_INPUT, FAILED, STOPPED = 2, 1, 130


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command; returns the exit code."""
    quiet_xla()
    try:
        with host_errors():
            return _dispatch(sys.argv[1:] if argv is None else list(argv))
    except (UserError, RunError) as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return BAD_INPUT if isinstance(error, UserError) else FAILED
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return STOPPED
    except BrokenPipeError:  # whoever read our output has enough of it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        """One line, without the usage."""
        raise UserError(message)


def _dispatch(argv: list[str]) -> int:
    if argv and not argv[0].startswith("-") and argv[0] not in COMMANDS:
        raise UserError(f"unknown command {argv[0]!r}; {did_you_mean(argv[0], COMMANDS)}")
    parser, commands = _parsers()
    args, rest = parser.parse_known_args(argv)
    # argparse takes positional arguments in one go only: settings after an option are left over.
    options = [word.partition("=")[0] for word in rest if word.startswith("-")]
    if options:
        known = re.findall(r"--[a-z]+", commands[args.command].format_help())
        raise UserError(f"unknown option {options[0]!r}; {did_you_mean(options[0], known)}")
    if rest and "overrides" not in args:
        raise UserError(f"unexpected argument {rest[0]!r}")
    if rest:
        args.overrides = [*args.overrides, *rest]
    functions = (_run, _list, _describe, _evaluate, _inspect, _compare, _bench)
    return dict(zip(COMMANDS, functions, strict=True))[args.command](args)


def _parsers() -> tuple[_Parser, dict[str, _Parser]]:
    parser = _Parser(
        prog="suite", description="Sample-efficient reinforcement learning with a transformer world model."
    )
    sub = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    summaries = {
        "run": "train an agent on a task, or go on where the same command stopped",
        "list": "tasks, agents or presets, one line each",
        "describe": "the whole configuration, layers and parameter counts, without running anything",
        "evaluate": "play whole episodes with a run's newest checkpoint",
        "inspect": "how good world models are: rollouts beside reality; of games, whether they keep the rules",
        "compare": "finished runs: scores and curves, mean and standard error over seeds, as Markdown tables",
        "bench": "time, share and speed of each phase",
    }
    commands = {
        name: sub.add_parser(name, help=summary, description=summary, allow_abbrev=False)
        for name, summary in summaries.items()
    }
    for name in ("run", "describe", "bench"):
        _add_configuration(commands[name])
    run = commands["run"]
    seeds = run.add_mutually_exclusive_group()
    seeds.add_argument("--seed", type=int, default=0, metavar="N", help="of all randomness (default 0)")
    seeds.add_argument("--seeds", type=_seeds, metavar="N-M", help="several, one after another: 0-2 or 0,3,5")
    run.add_argument("--out", type=Path, default=Path("runs"), metavar="DIR", help="where records go (default runs)")
    run.add_argument("--resume", action="store_true", help="fail if there is no run to go on with")
    commands["list"].add_argument("what", metavar="tasks|agents|presets")
    commands["evaluate"].add_argument("what", metavar="RUN_DIR|TASK", help="a run's folder, or with --policy a task")
    commands["evaluate"].add_argument("--policy", metavar="module:Class", help="somebody else's policy")
    commands["evaluate"].add_argument("--episodes", type=int, metavar="N", help="at least so many")
    commands["inspect"].add_argument("folders", nargs="+", type=Path, metavar="RUN_DIR", help="a run's folder")
    inspect = commands["inspect"]
    inspect.add_argument("--games", type=int, default=1000, metavar="N", help="games to imagine (default 1000)")
    inspect.add_argument("--out", type=Path, metavar="DIR", help="where to (default: inspect, where the runs are)")
    compare = commands["compare"]
    compare.add_argument("folders", nargs="+", type=Path, metavar="DIR", help="runs in or below it are compared")
    compare.add_argument("--parts", type=int, default=5, metavar="N", help="points of a curve (default 5)")
    compare.add_argument("--score", metavar="S", help="what curves are of (default: return, or the first score)")
    for name in ("run", "evaluate", "inspect", "bench"):
        commands[name].add_argument("--quiet", action="store_true", help="no progress")
    for command in commands.values():
        command.add_argument("--json", action="store_true", help="the last line of stdout is one JSON object")
    return parser, commands


def _add_configuration(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("task", metavar="TASK", help="see `suite list tasks`")
    parser.add_argument(
        "--agent", metavar="A", help="see `suite list agents` (default m5; craftax_full paper: m5_slow)"
    )
    parser.add_argument("--preset", metavar="P", help="see `suite list presets` (default: fit for this machine)")
    parser.add_argument("--steps", type=int, metavar="N", help="real environment steps (default: the preset's)")
    parser.add_argument(
        "overrides", nargs="*", default=[], metavar="dotted.name=value", help="any field that `suite describe` shows"
    )


def _seeds(text: str) -> list[int]:
    """Seeds of "0-2" or "0,3,5", or of both mixed."""
    seeds: list[int] = []
    for part in text.split(","):
        match = re.fullmatch(r"([0-9]+)(?:-([0-9]+))?", part)
        first, last = (int(match[1]), int(match[2] or match[1])) if match else (0, -1)
        if last < first:
            raise argparse.ArgumentTypeError(f"{text!r} is not of the form 0-2 or 0,3,5")
        seeds += range(first, last + 1)
    return list(dict.fromkeys(seeds))


def _run(args: argparse.Namespace) -> int:
    from suite import registry
    from suite.record import RunRecord, require_writable, run_folder

    seeds = args.seeds or [args.seed]
    configs = [registry.resolve(args.task, args.agent, args.preset, args.overrides, seed, args.steps) for seed in seeds]
    folders = [run_folder(args.out, config) for config in configs]
    begun = [(folder / "record.json").exists() for folder in folders]
    if args.resume and not any(begun):
        raise UserError(f"nothing to resume in {folders[0]}: run without --resume to start there")
    require_writable(args.out)
    for folder, config, exists in zip(folders, configs, begun, strict=True):
        if exists:  # so that the last seed's folder is known to be right before the first one's run starts
            RunRecord.open(folder, config, lock=False)

    from suite import run

    results: list[Result] = []
    for folder, config, exists in zip(folders, configs, begun, strict=True):
        if not args.quiet:
            what = f"{config.task}, agent {config.agent}, preset {config.preset}, seed {config.seed}"
            print(f"{what}, on {_device()}; files in {folder}", flush=True)
        result = run.run(config, args.out, _reporter(args.quiet), args.resume and exists)
        results.append(result)
        _print_result(result)
        if result.status == "stopped":
            break
    finished = [result for result in results if result.status != "stopped"]
    summary = _summary(finished)
    if len(finished) > 1:
        print(f"{len(finished)} seeds, mean +- standard error:")
        for name, (mean, error) in summary.items():
            print(_score_line(name, mean, error))
    if args.json:
        runs = [_result_fields(config.seed, result) for config, result in zip(configs, results, strict=False)]
        config = configs[0]
        fields: dict[str, Any] = {"task": config.task, "agent": config.agent, "preset": config.preset}
        if len(seeds) == 1:
            fields |= runs[0]
        else:
            fields["runs"] = runs
            fields["mean"] = {name: mean for name, (mean, _) in summary.items()}
            fields["standard_error"] = {name: error for name, (_, error) in summary.items()}
        _print_json(fields)
    return STOPPED if len(finished) < len(results) else 0


def _list(args: argparse.Namespace) -> int:
    from suite import registry

    if args.what not in LISTS:
        raise UserError(f"cannot list {args.what!r}; {did_you_mean(args.what, LISTS)}")
    entries: dict[str, Any] = getattr(registry, args.what)()
    rows = {
        id: [part for part in (entry.summary, getattr(entry, "cost", ""), _published(entry)) if part]
        for id, entry in entries.items()
    }
    if args.json:
        _print_json(rows)
    else:
        _print_table([id, "; ".join(parts)] for id, parts in rows.items())
    return 0


def _published(entry: Any) -> str:
    """What the paper reports of an agent, and where; "" if nothing."""
    millions = getattr(entry, "millions", None)
    parts = [getattr(entry, "row", ""), millions and f"{millions} M parameters", getattr(entry, "published", "")]
    return "; ".join(part for part in parts if part)


def _describe(args: argparse.Namespace) -> int:
    from suite import registry

    layers = registry.layers(args.task, args.agent, args.preset, args.overrides, 0, args.steps)

    from suite.describe import describe

    description = describe(layers, registry.task(args.task).spec())
    if args.json:
        _print_json(description.as_dict())
        return 0
    print("Configuration (value, source)")
    _print_table([s.name, str(s.value), s.source] for s in description.settings)
    for module, modules_layers in description.modules.items():
        unit = "numbers" if module == "codebook" else "parameters"
        print(f"\n{module.replace('_', ' ').capitalize()}: {description.parameters(module):,} {unit}")
        _print_table(
            [
                layer.name,
                " ".join(f"{name}{list(shape)}" for name, shape in layer.shapes.items()),
                f"{layer.parameters:,}",
            ]
            for layer in modules_layers
        )
    networks = [name for name in description.modules if name != "codebook"]
    counted = [f"{name.replace('_', ' ')} {description.parameters(name):,}" for name in networks]
    counted.append(f"2 x codebook {description.parameters('codebook'):,} (stored twice in the paper's bookkeeping)")
    print(f"\nTotal: {description.total:,}{' = ' + ' + '.join(counted) if 'codebook' in description.modules else ''}")
    if published := _published(registry.agent(layers[-1][1].agent)):
        print(f"Published for craftax_classic: {published}")
    print("\nDerived")
    _print_table([name, f"{value:,}", how] for name, value, how in description.derived)
    return 0


def _evaluate(args: argparse.Namespace) -> int:
    from suite import registry
    from suite.record import RunRecord

    if args.episodes is not None and args.episodes < 1:
        raise UserError(f"--episodes={args.episodes}: must be at least 1")
    if args.policy:
        from suite.external import evaluate_policy

        scores = evaluate_policy(args.what, args.policy, args.episodes, _reporter(args.quiet))
        _print_scores(scores)
        if args.json:
            _print_json({"task": args.what, "policy": args.policy, **scores})
        return 0
    folder = Path(args.what)
    if not folder.exists() and args.what in registry.tasks():
        raise UserError(f"{args.what} is a task: say whose policy to play it with, --policy module:Class")
    RunRecord.open(folder, lock=False)

    from suite import evaluation

    scores = evaluation.evaluate(folder, args.episodes, _reporter(args.quiet))
    _print_scores(scores)
    print(f"record {folder}")
    if args.json:
        _print_json({"folder": str(folder), **scores})
    return 0


def _inspect(args: argparse.Namespace) -> int:
    from suite.record import RunRecord

    if args.games < 1:
        raise UserError(f"--games={args.games}: must be at least 1")
    records = [RunRecord.open(folder, lock=False) for folder in args.folders]
    return _inspect_games(args) if all(record.spec.two_player for record in records) else _inspect_rollouts(args)


def _inspect_games(args: argparse.Namespace) -> int:
    from suite.diagnostics.rules import rules_of_run

    reporter = _reporter(args.quiet)
    found = {str(folder): rules_of_run(folder, args.games, reporter) for folder in args.folders}
    reporter.stop()
    for name, plays in found.items():
        print(name)
        columns = [[_value(kept[row]) for row in kept] for kept in plays.values()]
        rows = [row.replace("_percent", " %").replace("_", " ") for row in next(iter(plays.values()))]
        _print_table([["played by", *plays], *zip(rows, *columns, strict=True)])
    if args.json:
        _print_json(found)
    return 0


def _inspect_rollouts(args: argparse.Namespace) -> int:
    from suite.diagnostics.inspection import inspect

    reporter = _reporter(args.quiet)
    found = inspect(args.folders, args.out, reporter)
    reporter.stop()
    runs = found["runs"]
    names = list(dict.fromkeys(name for row in runs.values() for name in row))
    rows = [
        [name.replace("_percent", " %").replace("_", " "), *(_value(row.get(name, "")) for row in runs.values())]
        for name in names
    ]
    _print_table([["mean over rollout steps", *runs], *rows])
    print(f"tables, curves and filmstrips in {found['folder']}")
    if args.json:
        _print_json(found)
    return 0


def _compare(args: argparse.Namespace) -> int:
    if args.parts < 1:
        raise UserError(f"--parts={args.parts}: must be at least 1")

    from leaderboards.compare import compare, records_in, tables

    comparisons = compare(records_in(args.folders), args.parts, args.score)
    for found in comparisons:
        print(f"{found.task}, preset {found.preset}, {found.steps:,} steps\n")
        for table in tables(found):
            head = list(map(str, table.columns))
            for row in (head, ["---"] * len(head), *table.to_numpy().tolist()):
                print(f"| {' | '.join(row)} |")
            print()
    if args.json:
        _print_json([dataclasses.asdict(found) for found in comparisons])
    return 0


def _bench(args: argparse.Namespace) -> int:
    from suite import registry

    config = registry.resolve(args.task, args.agent, args.preset, args.overrides, 0, args.steps)

    from suite import bench

    if not args.quiet:
        print(f"{config.task}, agent {config.agent}, preset {config.preset}, on {_device()}", flush=True)
    measured = bench.bench(config, _reporter(args.quiet))
    parts = measured if isinstance(measured, Mapping) else {"phases": measured}
    for name, part in parts.items():
        if isinstance(part, list):
            columns = list(dict.fromkeys(column for row in part for column in row))
            _print_table([columns, *([_value(row.get(column, "")) for column in columns] for row in part)])
        else:
            print(f"{name}  {_value(part)}")
    if args.json:
        _print_json(parts)
    return 0


def _reporter(quiet: bool) -> Reporter:
    from suite.reporting import QuietReporter, RichReporter

    return QuietReporter() if quiet else RichReporter()


def _device() -> str:
    import jax

    device = jax.devices()[0]
    return f"{os.cpu_count()} CPU cores" if device.platform == "cpu" else device.device_kind


def _print_result(result: Result) -> None:
    if result.status == "stopped":
        print(f"stopped at step {result.steps:,}; the same command goes on from there")
    elif result.status == "already finished":
        print("already finished: nothing was run")
    _print_scores(result.scores)
    print(f"record {result.folder}", flush=True)


def _result_fields(seed: int, result: Result) -> dict[str, Any]:
    return {
        "seed": seed,
        "status": result.status,
        "steps": result.steps,
        "seconds": result.wall_seconds,
        "folder": str(result.folder),
        "scores": result.scores,
    }


def _summary(results: Sequence[Result]) -> dict[str, tuple[float, float]]:
    """Mean and standard error of each score; nan where they say nothing."""
    from leaderboards.compare import spread

    names = [name for name in (results[0].scores if results else ()) if "/" not in name]
    return {name: spread(result.scores[name] for result in results) for name in names}


def _print_scores(scores: Mapping[str, Any]) -> None:
    """One line each, but for the parts of a score ("success_percent/..."); nan is a mean over no episodes."""
    reason = "no episode ended in the part that counts" if scores.get("episodes") else "no episode ended yet"
    for name, value in scores.items():
        if "/" not in name:
            print(_score_line(name, value) + (f", {reason}" if value != value else ""))


def _score_line(name: str, value: float, error: float | None = None) -> str:
    """`("reward_percent", 12.34, 0.56)` as "reward 12.34 % +- 0.56 %"."""
    label, unit = name.replace("_percent", "").replace("_", " "), " %" if "_percent" in name else ""
    if math.isnan(value):
        return f"{label} n/a"
    spread = "" if error is None else f" +- {_value(error)}{unit}"
    return f"{label} {_value(value)}{unit}{spread}"


def _value(value: Any) -> str:
    """A cell: whole numbers whole, measured ones with two decimals or three digits."""
    if isinstance(value, bool) or not isinstance(value, float):
        return str(value)
    if not math.isfinite(value):
        return "n/a" if math.isnan(value) else f"{value:g}"
    if value == int(value):
        return f"{value:.0f}"
    return f"{value:.2f}" if abs(value) >= 1 else f"{value:.3g}"


def _print_table(rows: Iterable[Sequence[str]]) -> None:
    rows = [list(map(str, row)) for row in rows]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        print("  " + "  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip())


def _print_json(value: Any) -> None:
    """One line; nan becomes null, for JSON has none."""
    print(json.dumps(_finite(value), allow_nan=False, default=float), flush=True)


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _finite(inner) for name, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(inner) for inner in value]
    return None if isinstance(value, numbers.Real) and not math.isfinite(value) else value


if __name__ == "__main__":
    sys.exit(main())
