"""`suite describe`: the whole configuration, layers and parameter counts, without running anything."""

from __future__ import annotations

import argparse

from suite.commands.configuration import add_configuration, add_devices
from suite.commands.list import published
from suite.commands.printing import make_reporter, print_json, print_table

SUMMARY = "the whole configuration, layers and parameter counts, without running anything"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_configuration(parser)
    add_devices(parser)


def execute(args: argparse.Namespace) -> int:
    from suite import registry

    layers = registry.layers(args.task, args.agent, args.preset, args.overrides, 0, args.steps)

    from suite.diagnostics.describe import describe
    from suite.runs.devices import chosen, require_equal_shares
    from suite.runs.saved_model import agent_for

    config, state = layers[-1][1], None
    if isinstance(args.devices, int):  # of whatever machine
        require_equal_shares(config, args.devices)
    devices = args.devices if isinstance(args.devices, int) else chosen(config, args.devices)
    if config.imagination.world == "game":  # only then is the game itself looked at
        state = agent_for(config, make_reporter(args.json)).kept_state
    description = describe(layers, registry.task(args.task).spec(), state, devices)
    if args.json:
        print_json(description.as_dict())
        return 0
    print("Configuration (value, source)")
    print_table([s.name, str(s.value), s.source] for s in description.settings)
    for module, modules_layers in description.modules.items():
        unit = "numbers" if module == "codebook" else "parameters"
        print(f"\n{module.replace('_', ' ').capitalize()}: {description.parameters(module):,} {unit}")
        print_table(
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
    if row := published(registry.agent(layers[-1][1].agent)):
        print(f"Published for craftax_classic: {row}")
    print("\nDerived")
    print_table([name, f"{value:,}", how] for name, value, how in description.derived)
    return 0
