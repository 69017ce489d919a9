"""`suite bench`: time, share and speed of each phase."""

from __future__ import annotations

import argparse
from collections.abc import Mapping

from suite.commands.configuration import add_configuration, add_devices
from suite.commands.printing import device_name, format_value, make_reporter, print_json, print_table

SUMMARY = "time, share and speed of each phase"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_configuration(parser)
    add_devices(parser)
    parser.add_argument("--quiet", action="store_true", help="no progress")
    parser.add_argument(
        "--no-start-up", action="store_true", help="do not start the command twice, to measure how long that takes"
    )


def execute(args: argparse.Namespace) -> int:
    from suite import registry

    config = registry.resolve(args.task, args.agent, args.preset, args.overrides, 0, args.steps)

    from suite.benchmarks import phases
    from suite.runs.devices import used

    reporter = make_reporter(args.quiet)
    devices = len(used(config, args.devices, reporter))
    if not args.quiet:
        print(f"{config.task}, agent {config.agent}, preset {config.preset}, on {device_name(devices)}", flush=True)
    measured = phases.bench(config, reporter, not args.no_start_up, devices)
    parts = measured if isinstance(measured, Mapping) else {"phases": measured}
    for name, part in parts.items():
        if isinstance(part, list):
            columns = list(dict.fromkeys(column for row in part for column in row))
            print_table([columns, *([format_value(row.get(column, "")) for column in columns] for row in part)])
        else:
            print(f"{name}  {format_value(part)}")
    if args.json:
        print_json(parts)
    return 0
