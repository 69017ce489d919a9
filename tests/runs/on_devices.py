"""A process whose CPU is eight devices: trains an agent on one of them and on all, and prints what came of it as JSON.

python -m tests.runs.on_devices FOLDER TASK AGENT
"""

from __future__ import annotations

import json
import os
import re
import sys
from pathlib import Path
from typing import Any

DEVICES = 8
SIZES = {
    "environment.num_envs": 16,
    "environment.rollout_length": 12,
    "ppo.minibatches": 2,
    "replay.capacity": 512,
    "world_model.sequences": 16,
    "world_model.minibatches": 2,
    "imagination.num_envs": 8,
    "imagination.start_step": 150,
    "evaluation.episodes": 1,
    "evaluation.every_steps": 0,
    "checkpoint.every_steps": 1_000_000,
}
CERTAIN_DREAMS = {"imagination.trust": 0, "imagination.trust_window": 0}  # m6 dreams however little it knows
# A VQ-VAE of whole frames learns chaotically (docs/scoring.md): its updates make what sums are rounded by larger. Its
# frames are whole gray levels: of 50,000 pixels one gets another level, and that moves a value by up to 1e-3. So its
# updates are small, and the policy sees few of its pixels; with 16 x 16 none is in the way on our processors, on others
# one may be.
STEADY = {"tokenizer.learning_rate": 1e-6, "policy.max_pixels": 16}
STEPS = 384  # two iterations of 16 x 12
SHARED = 2
WHERE = {"one": (1, 1), "all, then one": (DEVICES, 1), "one, then all": (1, DEVICES)}  # the first iteration, the others


def train(out: Path, task: str, agent: str) -> dict[str, Any]:
    """Folders of the same run, by `WHERE` its iterations were; and what programs of many devices `moved`, by phase.

    And folders of it and of two others that went on `together`, on `SHARED` devices.
    """
    from suite import api
    from suite.runs import training
    from suite.runtime import layout

    moved: dict[str, Any] = {}
    settings = {**SIZES, **(CERTAIN_DREAMS if agent == "m6" else STEADY if agent == "m1" else {})}

    class Watched(training.Ahead):
        def close(self) -> None:
            if layout.devices() == DEVICES:
                moved.update({name: transfers(program.result()) for name, program in self._compiled.items()})
            super().close()

    training.Ahead = Watched  # type: ignore[misc]

    def part(name: str, devices: int, stop: bool) -> str:
        run = api.train(
            task,
            agent,
            "smoke",
            steps=STEPS,
            settings=settings,
            out=out / name,
            callbacks=[lambda iteration: stop],
            devices=devices,
        )
        assert run.status == ("stopped" if stop else "finished")
        return str(run.folder)

    folders = {}
    for name, (first, others) in WHERE.items():
        if first != others:
            part(name, first, stop=True)
        folders[name] = part(name, others, stop=False)
    if (imagine := dreams(task, agent, settings)) is not None:
        moved["imagine"] = transfers(imagine)
    options: dict[str, Any] = {"steps": STEPS, "settings": settings, "out": out / "together", "devices": SHARED}
    together = api.train_together(task, agent, "smoke", seeds=range(SHARED + 1), **options)
    return {"folders": folders, "moved": moved, "together": [str(run.folder) for run in together]}


def dreams(task: str, agent_id: str, settings: dict[str, Any]) -> Any:
    """The compiled program of dreams on all devices, which no run compiles ahead; None of agents that do not dream."""
    import jax
    import jax.numpy as jnp

    from suite import registry
    from suite.agent.algorithm import start_key
    from suite.agent.phases import Agent
    from suite.agent.state import laid_out
    from suite.runs.saved_model import agent_for
    from suite.runtime import layout
    from suite.runtime.reporting import QuietReporter

    config = registry.resolve(task, agent_id, "smoke", settings, steps=STEPS)
    if not config.dreams:
        return None
    agent = agent_for(config, QuietReporter())
    with layout.over(jax.devices()):
        state = laid_out(jax.eval_shape(agent.init, start_key(0)))
        key, updates, steps = map(laid_out, (jax.eval_shape(start_key, 0), jnp.int32(1), jnp.float32(1)))
        model = state.world_model and state.world_model.dreaming
        lowered = Agent.imagine.lower(agent, state.policy, model, state.tokenizer, state.replay, key, updates, steps)
        return lowered.compile()


def transfers(program: Any) -> list[list[str]]:
    """What a compiled program moves between devices: each operation, and the shapes of what it gives a device."""
    kinds = "all-gather|all-reduce|all-to-all|collective-permute|reduce-scatter"
    found = re.findall(rf"= (\S+|\([^=]*?\)) ({kinds})\(", program.as_text())
    return [[kind, re.sub(r"\{[^}]*\}", "", shapes)] for shapes, kind in found]


def kernel_difference() -> float:
    """How much the fused kernel's output and gradients, dropout included, differ between all devices and one."""
    import jax
    import jax.numpy as jnp

    from suite.nn.fused_attention import fused_attention
    from suite.runtime import layout

    keys = jax.random.split(jax.random.key(0), 3)
    inputs = [jax.random.normal(key, (DEVICES, 12, 2, 16)) for key in keys]

    def both(*inputs: jax.Array) -> tuple[jax.Array, Any]:
        def total(inputs: tuple[jax.Array, ...]) -> tuple[jax.Array, jax.Array]:
            mixed = fused_attention(*inputs, unit=4, dropout_rate=0.5, dropout_key=jax.random.key(1))
            return jnp.square(mixed).sum(), mixed

        return jax.grad(total, has_aux=True)(inputs)

    alone = jax.jit(both)(*inputs)
    with layout.over(jax.devices()):
        together = jax.jit(both)(*map(layout.split, inputs))
    differences = jax.tree.map(lambda a, b: abs(jax.device_get(a) - jax.device_get(b)).max(), alone, together)
    return float(max(jax.tree.leaves(differences)))


def counted_flops() -> list[int]:
    """Of a product of 8 x 3 with 3 x 5 numbers: on one device, and divided between all of them."""
    import jax
    import jax.numpy as jnp

    from suite.benchmarks.flops import count_flops
    from suite.runtime import layout

    left, right = jnp.ones((DEVICES, 3)), jnp.ones((3, 5))
    with layout.over(jax.devices()):
        product = layout.per_device(jnp.dot, (0, None), 0)
        return [count_flops(jnp.dot, left, right), count_flops(product, left, right)]


def collective_shares() -> list[float]:
    """Of the time of a program that adds up what all devices have, and of one that does not."""
    import jax
    import jax.numpy as jnp

    from suite.benchmarks.collectives import share_in_collectives
    from suite.runtime import layout

    with layout.over(jax.devices()):
        rows = layout.split(jnp.ones((64 * DEVICES, 128)))
        programs = [jax.jit(lambda x: layout.replicated(x.sum(0))), jax.jit(lambda x: layout.split(x * 2))]
        for program in programs:
            jax.block_until_ready(program(rows))
        return [share_in_collectives(lambda: program(rows), DEVICES) for program in programs]  # noqa: B023 -- at once


def main(folder: str, task: str, agent: str) -> None:
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={DEVICES}"

    from suite import registry
    from tests.tiny import CORRIDOR, PENNIES

    registry.TASKS = (*registry.TASKS, CORRIDOR, PENNIES)
    result = train(Path(folder), task, agent)
    if task == CORRIDOR.id:
        result |= {"kernel_difference": kernel_difference(), "flops": counted_flops(), "shares": collective_shares()}
    print(json.dumps(result))


if __name__ == "__main__":
    main(*sys.argv[1:])
