"""`suite run`: train an agent on a task, or go on where the same command stopped."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
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
from suite.runtime.errors import UserError

if TYPE_CHECKING:
    from suite.runs.training import Result

SUMMARY = "train an agent on a task, or go on where the same command stopped"
STOPPED = 130


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_configuration(parser)
    seeds = parser.add_mutually_exclusive_group()
    seeds.add_argument("--seed", type=int, default=0, metavar="N", help="of all randomness (default 0)")
    seeds.add_argument("--seeds", type=parse_seeds, metavar="N-M", help="several, one after another: 0-2 or 0,3,5")
    parser.add_argument("--out", type=Path, default=Path("runs"), metavar="DIR", help="where records go (default runs)")
    add_devices(parser)
    add_wandb(parser)
    add_processes(parser)
    parser.add_argument("--resume", action="store_true", help="fail if there is no run to go on with")
    parser.add_argument("--quiet", action="store_true", help="no progress")


def execute(args: argparse.Namespace) -> int:
    join_processes(args)

    from suite import registry
    from suite.records.record import RunRecord, require_writable, run_folder

    seeds = args.seeds or [args.seed]
    configs = [registry.resolve(args.task, args.agent, args.preset, args.overrides, seed, args.steps) for seed in seeds]
    folders = [run_folder(args.out, config) for config in configs]
    begun = [(folder / "record.json").exists() for folder in folders]
    if args.resume and not any(begun):
        raise UserError(f"nothing to resume in {folders[0]}: run without --resume to start there")
    require_wandb_of(args)

    from suite.runs.devices import used

    devices = len(used(configs[0], args.devices, make_reporter(args.quiet)))
    require_writable(args.out)
    for folder, config, exists in zip(folders, configs, begun, strict=True):
        if exists:  # so that the last seed's folder is known to be right before the first one's run starts
            RunRecord.open(folder, config, lock=False)

    from suite import api

    results: list[Result] = []
    for folder, config, exists in zip(folders, configs, begun, strict=True):
        if not args.quiet:
            what = f"{config.task}, agent {config.agent}, preset {config.preset}, seed {config.seed}"
            print(f"{what}, on {device_name(devices)}; files in {folder}", flush=True)
        result = api.train(
            args.task,
            args.agent,
            args.preset,
            seed=config.seed,
            steps=args.steps,
            settings=args.overrides,
            out=args.out,
            resume=args.resume and exists,
            wandb=args.wandb,
            devices=args.devices,
            progress=not args.quiet,
        ).result
        results.append(result)
        _print_result(result)
        if result.status == "stopped":
            break
    finished = [result for result in results if result.status != "stopped"]
    summary = _summary(finished)
    if len(finished) > 1:
        print(f"{len(finished)} seeds, mean +- standard error:")
        for name, (mean, error) in summary.items():
            print(score_line(name, mean, error))
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
        print_json(fields)
    return STOPPED if len(finished) < len(results) else 0


def _print_result(result: Result) -> None:
    if result.status == "stopped":
        print(f"stopped at step {result.steps:,}; the same command goes on from there")
    elif result.status == "already finished":
        print("already finished: nothing was run")
    print_scores(result.scores)
    if result.evaluation and not result.scores["episodes"]:
        print(f"its newest evaluation, of {result.evaluation['episodes']} whole episodes:")
        print_scores(result.evaluation)
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
    from leaderboards.statistics import mean_and_standard_error

    names = [name for name in (results[0].scores if results else ()) if not ScoreName(name).is_of_part]
    return {name: mean_and_standard_error(result.scores[name] for result in results) for name in names}
