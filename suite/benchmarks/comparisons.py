"""Two ways of doing the same, timed side by side: what `suite bench` prints beside the phases."""

from __future__ import annotations

import dataclasses
import functools
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx

from suite import registry
from suite.agent.algorithm import first_programs, iterate, iteration_key, start_key
from suite.agent.phases import Agent
from suite.configuration.schema import Config
from suite.interface.batching import Batched
from suite.interface.environment import BatchedEnvironment, Environment
from suite.interface.host import HostEnvironment
from suite.interface.tokens import TokenSpec
from suite.interface.turns import choose_event
from suite.runtime.compilation import Ahead, enable_compilation_cache
from suite.world_model.attention import causal_attention
from suite.world_model.block_teacher_forcing import factorization
from suite.world_model.imagination import next_frame
from suite.world_model.transformer import WorldModel

Rows = list[dict[str, Any]]
NUM_ENVS, NUM_STEPS = 48, 96
NUM_FRAMES = 20  # the paper's T_WM, whatever the preset's: the longer the context, the more a cache saves


def seconds_of(function: Callable[[], Any], least: float = 1.0, repeats: int = 3) -> float:
    """Median seconds of a call that is already compiled; at least `repeats` calls and `least` seconds of them."""
    times: list[float] = []
    while len(times) < repeats or (sum(times) < least and len(times) < 100):
        start = time.perf_counter()
        jax.block_until_ready(function())
        times.append(time.perf_counter() - start)
    return sorted(times)[len(times) // 2]


def compare_resets(config: Config, environment: Environment) -> Rows:
    """Random play with exact auto-reset, against no reset at all (where that can be) and the package's own."""
    variants: dict[str, BatchedEnvironment] = {"exact auto-reset": Batched(environment, NUM_ENVS)}
    if not isinstance(environment, HostEnvironment):  # whose engines take no step after an end
        variants["no reset"] = NoReset(environment, NUM_ENVS)
    own = registry.task(config.task).own_auto_reset
    if own is not None:
        variants["the package's own auto-reset"] = own()(NUM_ENVS)
    played = {name: _player_of(contestant, environment.spec.num_actions) for name, contestant in variants.items()}
    times: dict[str, list[float]] = {name: [] for name in played}
    for _ in range(7):  # in turn, so that a drifting machine slows all of them
        for name, play in played.items():
            start = time.perf_counter()
            play()
            times[name].append(time.perf_counter() - start)
    speed = {name: NUM_ENVS * NUM_STEPS / sorted(values)[len(values) // 2] for name, values in times.items()}
    bound = speed.get("no reset", float("nan"))
    return [{"environment": n, "steps/s": s, "of no reset": s / bound} for n, s in speed.items()]


@dataclasses.dataclass(frozen=True)
class NoReset:
    """What a batch costs when episodes are never reset: the bound for any auto-reset."""

    environment: Environment
    num_envs: int

    @property
    def spec(self) -> Any:
        return self.environment.spec

    def reset(self, key: jax.Array) -> Any:
        return Batched(self.environment, self.num_envs).reset(key)

    def step(self, key: jax.Array, state: Any, action_B: jax.Array) -> Any:
        return jax.vmap(self.environment.step)(jax.random.split(key, self.num_envs), state, action_B)


def _player_of(environment: BatchedEnvironment, num_actions: int) -> Callable[[], None]:
    """A compiled and warmed-up call that plays `NUM_STEPS` random steps and goes on from there the next time."""

    def act(key, turn):
        if turn is None:
            return jax.random.randint(key, (environment.num_envs,), 0, num_actions)
        # In a game everybody is the opponent, who plays uniformly among what is legal; and chance.
        nobody = dataclasses.replace(turn, seat=jnp.zeros_like(turn.seat) - 1)
        return choose_event(key, nobody, jnp.zeros_like(turn.player))

    def step(carry, key):
        state, turn = carry
        action_key, step_key = jax.random.split(key)
        state, time_step = environment.step(step_key, state, act(action_key, turn))
        return (state, time_step.turn), (time_step.observation, time_step.reward, time_step.terminated)

    @jax.jit
    def play(carry, key):
        return jax.lax.scan(step, carry, jax.random.split(key, NUM_STEPS))

    state, time_step = jax.jit(environment.reset)(jax.random.key(0))
    holder: list[Any] = [(state, time_step.turn), jax.random.key(1)]

    def go_on() -> None:
        holder[1], key = jax.random.split(holder[1])
        holder[0] = jax.block_until_ready(play(holder[0], key))[0]

    for _ in range(3):  # past the first frames, where nothing has ended yet
        go_on()
    return go_on


def compare_caches(agent: Agent) -> Rows:
    """The last imagined step of a context of 20 frames, with the key-value cache and by recomputing all frames."""
    config, tokens = agent.config, agent.tokens
    batch, length = config.imagination.num_envs, NUM_FRAMES
    model = WorldModel(config.world_model, tokens, agent.grid, nnx.Rngs(0))
    graph, params = nnx.split(model)
    frames = _random_tokens(tokens, (batch, length))
    actions = jax.random.randint(jax.random.key(2), (batch, length), 0, tokens.num_actions)
    cache = model.init_cache(batch, length)
    cache = dataclasses.replace(cache, index=jnp.int32((length - 1) * model.block))

    @jax.jit
    def cached(params, cache):
        hidden = nnx.merge(graph, params).step(cache, frames[:, -1], actions[:, -1])[1]
        return nnx.merge(graph, params).observation_logits(hidden)

    @jax.jit
    def recomputed(params):
        hidden = nnx.merge(graph, params)(frames, actions)
        return nnx.merge(graph, params).observation_logits(hidden[:, -1])

    jax.block_until_ready((cached(params, cache), recomputed(params)))
    fast, slow = seconds_of(lambda: cached(params, cache)), seconds_of(lambda: recomputed(params))
    return [
        {"method": "key-value cache", "ms": 1e3 * fast, "times faster": slow / fast},
        {"method": f"recomputing {length} frames", "ms": 1e3 * slow, "times faster": 1.0},
    ]


def compare_samplers(agent: Agent) -> Rows:
    """The frame after 20 frames, imagined as a block and token by token, both with the key-value cache (Section 3.6).

    Models of the same size, fresh. No comparison where tokens are vectors: those cannot be imagined one by one.
    """
    tokens, batch = agent.tokens, agent.config.imagination.num_envs
    if tokens.token_size:
        return []
    frame_BL = _random_tokens(tokens, (batch,))
    action_B = jax.random.randint(jax.random.key(2), (batch,), 0, tokens.num_actions)
    valid_K = jnp.ones(tokens.num_codes, bool)
    times: dict[str, float] = {}
    for name, blocks in (("as a block", True), ("token by token", False)):
        config = dataclasses.replace(agent.config.world_model, block_teacher_forcing=blocks)
        model = WorldModel(config, tokens, agent.grid, nnx.Rngs(0))
        graph, params = nnx.split(model)
        cache = model.init_cache(batch, NUM_FRAMES)
        cache = dataclasses.replace(cache, index=jnp.int32((NUM_FRAMES - 1) * model.block))

        @jax.jit
        def imagine(params, cache, graph=graph):
            return next_frame(jax.random.key(3), nnx.merge(graph, params), cache, frame_BL, action_B, valid_K)[2]

        jax.block_until_ready(imagine(params, cache))
        times[name] = seconds_of(functools.partial(imagine, params, cache))
    slowest = max(times.values())
    return [{"tokens": name, "ms": 1e3 * time, "times faster": slowest / time} for name, time in times.items()]


def compare_attention(agent: Agent) -> Rows:
    """Attention of one layer over a minibatch of training, with its gradient: ours, JAX's own, and on a GPU the fused.

    Without dropout, in the type that the world model computes in.
    """
    config, block = agent.config.world_model, agent.tokens.tokens_per_frame + 1
    unit = factorization(config.block_teacher_forcing).unit(block)
    shape = (config.sequences // config.minibatches, config.sequence_length * block, config.heads)
    keys = jax.random.split(jax.random.key(1), 3)
    dtype = jnp.bfloat16 if config.compute_type == "bfloat16" else jnp.float32
    qkv = [jax.random.normal(key, (*shape, config.embed_dim // config.heads), dtype) for key in keys]
    index_S = jnp.arange(shape[1]) // unit
    visible_11QS = (index_S[:, None] >= index_S[None])[None, None]
    ways: dict[str, Callable[..., jax.Array]] = {
        "ours, plain operations": functools.partial(causal_attention, block=block, unit=unit),
        "jax.nn.dot_product_attention": functools.partial(jax.nn.dot_product_attention, mask=visible_11QS),
    }
    if jax.default_backend() == "gpu":
        from suite.nn.fused_attention import fused_attention

        ways["ours, fused kernel"] = functools.partial(fused_attention, unit=unit)
    times: dict[str, float] = {}
    for name, attend in ways.items():

        def total(query: jax.Array, key: jax.Array, value: jax.Array, attend: Any = attend) -> jax.Array:
            return attend(query, key, value).astype(jnp.float32).sum()

        step = jax.jit(jax.grad(total, (0, 1, 2)))
        jax.block_until_ready(step(*qkv))
        times[name] = seconds_of(functools.partial(step, *qkv))
    slowest = max(times.values())
    return [{"attention": name, "ms": 1e3 * time, "times faster": slowest / time} for name, time in times.items()]


def _random_tokens(tokens: TokenSpec, lead: tuple[int, ...]) -> jax.Array:
    shape = (*lead, tokens.tokens_per_frame)
    if tokens.token_size:
        return jax.random.uniform(jax.random.key(1), (*shape, tokens.token_size))
    return jax.random.randint(jax.random.key(1), shape, 0, tokens.num_codes)


def compare_starts(config: Config) -> Rows:
    """Starts the same command in two new processes that share a cache folder, empty before the first.

    The seconds are from a process's start until it has computed its first policy update; then it is killed.
    """
    rows: Rows = []
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "SUITE_CACHE_DIR": f"{folder}/cache"}
        for name in ("first start", "second start"):
            start = time.perf_counter()
            command = [sys.executable, "-m", "suite.benchmarks.comparisons", json.dumps(config.as_dict())]
            with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
                assert process.stdout is not None and process.stderr is not None
                if not process.stdout.readline():
                    raise RuntimeError(process.stderr.read().decode())
                rows.append({"start": name, "seconds": time.perf_counter() - start})
                process.kill()
    for row in rows:
        row["times faster"] = rows[0]["seconds"] / row["seconds"]
    return rows


def _first_policy_update(config: Config) -> None:
    """What `compare_starts` runs: the start of `suite.runs.training`. Prints a line after the first policy update."""
    enable_compilation_cache()
    agent, key = Agent(config, registry.task(config.task).make()(None)), start_key(config.seed)
    ahead, last = Ahead(), "learn" if agent.learns_from_real else "collect"
    ahead.begin(first_programs(agent, jax.eval_shape(agent.init, key)))

    def call(phase: str, function: Callable[..., Any], *arguments: Any) -> Any:
        ahead.wait(phase)
        result = jax.block_until_ready(function(*arguments))
        if phase == last:
            print(phase, flush=True)
        return result

    iterate(agent, agent.init(key), iteration_key(config.seed, 0), 0, call)


if __name__ == "__main__":
    _first_policy_update(Config(**json.loads(sys.argv[1])))
