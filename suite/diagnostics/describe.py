"""What a configuration amounts to: every field and its source, layers and parameter counts, derived numbers.

Networks are traced in shape only: nothing is compiled or allocated.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence
from typing import Any

import jax
from flax import nnx

from suite.agent.replay import Replay
from suite.configuration.overrides import dotted
from suite.configuration.schema import Config
from suite.interface.environment import EnvironmentSpec, State
from suite.policy.actor_critic import make_policy
from suite.registry import Source
from suite.tokenizers.stream import build_tokenizer
from suite.tokenizers.vq_vae import VQState
from suite.world_model.transformer import WorldModel

MORE = "; more, as chance's events do not count"


@dataclasses.dataclass(frozen=True)
class Setting:
    """A field of the configuration; `source` is whoever changed it last."""

    name: str
    value: Any
    source: Source


@dataclasses.dataclass(frozen=True)
class Layer:
    """A layer's arrays, by name, and how many numbers they hold."""

    name: str
    shapes: dict[str, tuple[int, ...]]

    @property
    def parameters(self) -> int:
        return sum(map(math.prod, self.shapes.values()))


@dataclasses.dataclass(frozen=True)
class Description:
    """See `describe`.

    Attributes:
      settings: every field.
      modules: layers by module: "policy", "world_model", "tokenizer" (networks of a VQ-VAE), "codebook".
      derived: what follows from the settings: name, value, how.
    """

    settings: list[Setting]
    modules: dict[str, list[Layer]]
    derived: list[tuple[str, int, str]]

    def parameters(self, module: str) -> int:
        """How many parameters a module has, 0 if there is none."""
        return sum(layer.parameters for layer in self.modules.get(module, []))

    @property
    def total(self) -> int:
        """Of all networks and, as the paper counts it, twice the codebook (fidelity notes, first table)."""
        return sum(map(self.parameters, self.modules)) + self.parameters("codebook")

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return {
            "settings": {s.name: {"value": s.value, "source": s.source} for s in self.settings},
            "parameters": {module: self.parameters(module) for module in self.modules} | {"total": self.total},
            "layers": {
                module: {layer.name: layer.shapes for layer in layers} for module, layers in self.modules.items()
            },
            "derived": {name: value for name, value, _ in self.derived},
        }


def describe(
    layers: Sequence[tuple[Source, Config]], spec: EnvironmentSpec, state: State = None, devices: int = 1
) -> Description:
    """Describes the configuration that `suite.registry.layers` made for a task of this specification.

    Args:
      layers: the configuration after each source's changes.
      spec: the task's.
      state: the shapes of one environment's state, where the replay buffer keeps states.
      devices: between how many the replay buffer is split.
    """
    config = layers[-1][1]
    policy = nnx.eval_shape(
        lambda: make_policy(config.policy, spec.observation, spec.num_actions, nnx.Rngs(0)),
    )
    modules = {"policy": _layers(policy)}
    if config.world_model.enabled:
        tokenizer, tokens, grid = build_tokenizer(config, spec)
        world_model = nnx.eval_shape(lambda: WorldModel(config.world_model, tokens, grid, nnx.Rngs(0)))
        modules["world_model"] = _layers(world_model)
        modules |= _tokenizer_modules(jax.eval_shape(tokenizer.init, jax.random.key(0)))
    return Description(_settings(layers), modules, _derived(config, spec) + _memory(config, spec, state, devices))


def _settings(layers: Sequence[tuple[Source, Config]]) -> list[Setting]:
    fields = [(source, dotted(config)) for source, config in layers]
    origin = dict.fromkeys(fields[0][1], fields[0][0])
    for (_, before), (source, after) in itertools.pairwise(fields):
        origin |= {name: source for name in after if after[name] != before[name]}
    return [Setting(name, value, origin[name]) for name, value in fields[-1][1].items()]


def _tokenizer_modules(state: Any) -> dict[str, list[Layer]]:
    """The networks, if it has any, and the codebook, if there is one; an optimizer's state is no parameter."""
    if isinstance(state, VQState):
        networks = nnx.to_pure_dict(state.params)
        state = {"codebook": networks.pop("codebook")}
        return {"tokenizer": _group(networks), "codebook": _group(state)}
    codebook = _group(state)
    return {"codebook": codebook} if codebook else {}


def _layers(module: nnx.Module) -> list[Layer]:
    return _group(nnx.to_pure_dict(nnx.state(module, nnx.Param)))


def _group(tree: Any) -> list[Layer]:
    """Arrays grouped by what holds them; counters are no parameters."""
    shapes: dict[str, dict[str, tuple[int, ...]]] = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        if leaf.shape:
            layer, name = (jax.tree_util.keystr(part, simple=True, separator=".") for part in (path[:-1], path[-1:]))
            shapes.setdefault(layer, {})[name] = leaf.shape
    return [Layer(name, arrays) for name, arrays in shapes.items()]


def _memory(config: Config, spec: EnvironmentSpec, state: State, devices: int) -> list[tuple[str, int, str]]:
    """What the replay buffer takes."""
    if not config.dreams:
        return []
    replay = Replay.of(config)
    arrays = jax.tree.leaves(jax.eval_shape(lambda: replay.init(spec, state)))
    held = sum(math.prod(array.shape) * array.dtype.itemsize for array in arrays)
    how = "frames, actions and the rest" + (" and the environments' own states" if state is not None else "")
    memory = [("replay memory (MiB)", held // 2**20, f"{how} of {replay.num_envs} x {replay.length} steps")]
    if devices > 1:
        shared = f"the steps of {replay.num_envs // devices} environments; networks are whole on each"
        memory.append(("replay memory of each device (MiB)", held // devices // 2**20, shared))
    return memory


def _derived(config: Config, spec: EnvironmentSpec) -> list[tuple[str, int, str]]:
    derived = [
        ("steps per iteration", config.steps_per_iteration, "environment.num_envs x environment.rollout_length"),
        ("iterations", config.iterations, "whole ones that fit protocol.steps" + MORE * bool(spec.chance_outcomes)),
        ("real steps", config.total_steps, "iterations x steps per iteration"),
    ]
    if config.dreams:
        steps = [(i + 1) * config.steps_per_iteration for i in range(config.iterations)]
        updates = {step: config.imagined_updates(step) for step in steps}
        dreaming = [step for step, count in updates.items() if count]
        total = sum(updates.values())
        imagined = total * config.imagination.num_envs * config.imagination.horizon
        derived += [
            ("first imagination", dreaming[0] if dreaming else 0, "real steps; 0: never"),
            ("iterations with imagination", len(dreaming), "from there to the end"),
            ("imagined policy updates", total, "over all iterations"),
            ("imagined steps", imagined, "updates x imagination.num_envs x imagination.horizon"),
        ]
    if config.world_model.enabled:
        derived += [
            (
                "world-model gradient steps",
                config.iterations * config.world_model.updates * config.world_model.minibatches,
                "iterations x world_model.updates x world_model.minibatches",
            ),
        ]
    return derived
