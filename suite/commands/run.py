"""`suite run`: train an agent on a task, or go on where the same command stopped."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from suite.commands.configuration import (
    add_configuration,
    add_devices,
    add_processes,
    add_wandb,
    join_processes,
    parse_seeds,
    require_wandb_of,
)
from suite.commands.printing import device_name, make_reporter, print_json, print_scores, score_line
from suite.interface.scores import ScoreName
from suite.runtime.errors import RunError, UserError

if TYPE_CHECKING:
    from suite.configuration.schema import Config
    from suite.runs.training import Result

SUMMARY = "train an agent on a task, or go on where the same command stopped"
STOPPED = 130


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_configuration(parser)
    seeds = parser.add_mutually_exclusive_group()
    seeds.add_argument("--seed", type=int, default=0, metavar="N", help="of all randomness (default 0)")
    seeds.add_argument("--seeds", type=parse_seeds, metavar="N-M", help="several, one after another: 0-2 or 0,3,5")
    parser.add_argument("--together", action="store_true", help="all seeds at once, as one program: --seeds 0-7")
    parser.add_argument("--out", type=Path, default=Path("runs"), metavar="DIR", help="where records go (default runs)")
    add_devices(parser)
    add_wandb(parser)
    add_processes(parser)
    parser.add_argument("--resume", action="store_true", help="fail if there is no run to go on with")
    parser.add_argument("--quiet", action="store_true", help="no progress")


def execute(args: argparse.Namespace) -> int:
    seeds = args.seeds or [args.seed]
    if args.together and (len(seeds) < 2 or args.coordinator):
        raise UserError("--together is for several seeds in one process: add --seeds 0-3, without --coordinator")
    join_processes(args)

    from suite import registry
    from suite.records.record import RunRecord, require_writable, run_folder

    configs = [registry.resolve(args.task, args.agent, args.preset, args.overrides, seed, args.steps) for seed in seeds]
    folders = [run_folder(args.out, config) for config in configs]
    begun = [(folder / "record.json").exists() for folder in folders]
    if args.resume and not any(begun):
        raise UserError(f"nothing to resume in {folders[0]}: run without --resume to start there")
    require_wandb_of(args)

    from suite.runs.devices import used, used_together

    reporter = make_reporter(args.quiet)
    if args.together:
        devices = len(used_together(configs[0], len(seeds), args.devices, reporter))
    else:
        devices = len(used(configs[0], args.devices, reporter))
    require_writable(args.out)
    for folder, config, exists in zip(folders, configs, begun, strict=True):
        if exists:  # so that the last seed's folder is known to be right before the first one's run starts
            RunRecord.open(folder, config, lock=False)

    results: list[Result] = []
    for result in _trained(args, configs, begun, devices):
        results.append(result)
        _print_result(result)
    finished = [result for result in results if "finished" in result.status]
    summary = _summary(finished)
    if len(finished) > 1:
        print(f"{len(finished)} seeds, mean +- standard error:")
        for name, (mean, error) in summary.items():
            print(score_line(name, mean, error))
    if args.json:
        runs = [_result_fields(config.seed, result) for config, result in zip(configs, results, strict=False)]
        fields: dict[str, Any] = {name: getattr(configs[0], name) for name in ("task", "agent", "preset")}
        if len(seeds) == 1:
            fields |= runs[0]
        else:
            fields["runs"] = runs
            fields["mean"] = {name: mean for name, (mean, _) in summary.items()}
            fields["standard_error"] = {name: error for name, (_, error) in summary.items()}
        print_json(fields)
    statuses = {result.status for result in results}
    return RunError.exit_code if "failed" in statuses else STOPPED if "stopped" in statuses else 0


def _trained(
    args: argparse.Namespace, configs: Sequence[Config], begun: Sequence[bool], devices: int
) -> Iterator[Result]:
    """Trains one seed after another, until one is stopped, or all of them together."""
    from suite import api
    from suite.records.record import run_folder

    common = {"steps": args.steps, "settings": args.overrides, "out": args.out, "wandb": args.wandb}
    common |= {"devices": args.devices, "progress": not args.quiet}
    config = configs[0]
    what = f"{config.task}, agent {config.agent}, preset {config.preset}"
    where = f"on {device_name(devices)}; files in"
    if args.together:
        if not args.quiet:
            seeds = ", ".join(str(config.seed) for config in configs)
            folder = run_folder(args.out, config).parent
            print(f"{what}, seeds {seeds} together, {where} {folder}", flush=True)
        chosen = [config.seed for config in configs]
        for run in api.train_together(args.task, args.agent, args.preset, seeds=chosen, **common):
            yield run.result
        return
    for config, exists in zip(configs, begun, strict=True):
        if not args.quiet:
            print(f"{what}, seed {config.seed}, {where} {run_folder(args.out, config)}", flush=True)
        resume = args.resume and exists
        result = api.train(args.task, args.agent, args.preset, seed=config.seed, resume=resume, **common).result
        yield result
        if result.status == "stopped":
            return


def _print_result(result: Result) -> None:
    if result.status == "stopped":
        print(f"stopped at step {result.steps:,}; the same command goes on from there")
    elif result.status == "already finished":
        print("already finished: nothing was run")
    elif result.status == "failed":
        print(f"failed: {result.reason}")
    print_scores(result.scores)
    if result.evaluation and not result.scores["episodes"]:
        print(f"its newest evaluation, of {result.evaluation['episodes']} whole episodes:")
        print_scores(result.evaluation)
    print(f"record {result.folder}", flush=True)


def _result_fields(seed: int, result: Result) -> dict[str, Any]:
    fields = {
        "seed": seed,
        "status": result.status,
        "steps": result.steps,
        "seconds": result.wall_seconds,
        "folder": str(result.folder),
        "scores": result.scores,
    }
    return fields | ({"reason": result.reason} if result.reason else {})


def _summary(results: Sequence[Result]) -> dict[str, tuple[float, float]]:
    """Mean and standard error of each score; nan where they say nothing."""
    from leaderboards.statistics import mean_and_standard_error

    names = [name for name in (results[0].scores if results else ()) if not ScoreName(name).is_of_part]
    return {name: mean_and_standard_error(result.scores[name] for result in results) for name in names}
