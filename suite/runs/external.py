"""Somebody else's policy, played and scored as ours are: `suite evaluate TASK --policy module:Class`."""

from __future__ import annotations

import contextlib
import functools
import importlib
import inspect
import sys
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import io_callback

from suite import registry
from suite.agent import rollout as play
from suite.interface.batching import Batched
from suite.interface.environment import EnvironmentSpec
from suite.policy.actor_critic import PolicyOutput
from suite.policy.ppo import TargetStatistics, Trajectory
from suite.runs.evaluation import play_episodes
from suite.runtime.compilation import device_kind, enable_compilation_cache
from suite.runtime.errors import UserError, did_you_mean
from suite.runtime.reporting import Reporter

NUM_ENVS, EVENTS = 48, 32  # side by side, and between two looks at who is done
METHOD = "preferences(observation, first, acting)"
GAMES = 1_000  # episodes of a two-player game, which are short and whose returns scatter


class ExternalPolicy:
    """What a rollout calls; asks the user's object on the host, once for every event of all environments."""

    def __init__(self, policy: Any, spec: EnvironmentSpec):
        self.policy, self.spec = policy, spec

    def ask(self, observation_B: np.ndarray, first_B: np.ndarray, acting_B: np.ndarray) -> np.ndarray:
        """The user's preferences, float32 [B, A]; raises UserError if they are none."""
        with _raised(f"{METHOD} of {type(self.policy).__name__}"):
            given = np.asarray(self.policy.preferences(observation_B, first_B, acting_B))
        expected = (len(observation_B), self.spec.num_actions)
        gave = ""
        if given.shape != expected:
            gave = f"shape {list(given.shape)}"
        elif given.dtype.kind in "USOMmc":
            gave = f"values of type {given.dtype}"
        else:
            with np.errstate(over="ignore"):
                given = given.astype(np.float32)
            if np.isnan(given).any():
                gave = "nan"
            elif (given == np.inf).any():
                gave = "inf"
            elif (given == -np.inf).all(-1)[acting_B].any():
                gave = "-inf for every action"
        if gave:
            raise UserError(
                f"{METHOD} of {type(self.policy).__name__} gave {gave}, expected numbers of shape {list(expected)}, "
                "-inf for an action that is never to be taken"
            )
        return np.maximum(given, -1e8)  # an action's -inf; what is illegal is further below

    def initial_hidden(self, batch: int) -> jax.Array:
        """float32 [batch, 0]: what it remembers is its own affair."""
        return jnp.zeros((batch, 0), jnp.float32)

    def __call__(
        self,
        observation_TB: jax.Array,
        first_TB: jax.Array,
        hidden_BH: jax.Array,
        acting_TB: jax.Array | None = None,
    ) -> tuple[PolicyOutput, jax.Array]:
        """One step; values are zero. A rollout's last look, which is for the value alone, is not asked for."""
        _, batch = observation_TB.shape[:2]
        none_1B = jnp.zeros((1, batch), jnp.float32)
        logits = jax.ShapeDtypeStruct((batch, self.spec.num_actions), jnp.float32)
        if self.spec.two_player and acting_TB is None:
            return PolicyOutput(jnp.zeros((1, *logits.shape), jnp.float32), none_1B), hidden_BH
        acting_B = jnp.ones(batch, bool) if acting_TB is None else acting_TB[0]
        logits_BA = io_callback(self.ask, logits, observation_TB[0], first_TB[0], acting_B, ordered=True)
        return PolicyOutput(logits_BA[None], none_1B), hidden_BH


class Contest:
    """The part of an `Agent` that plays: an external policy in a task's real environments."""

    def __init__(self, policy: ExternalPolicy, batched: Batched):
        self.policy, self.batched, self.spec = policy, batched, batched.spec

    @functools.partial(jax.jit, static_argnums=0)
    def start(self, policy_state: None, key: jax.Array) -> play.RolloutState:
        """The start of a rollout in fresh environments."""
        return play.start(self.policy, self.batched, key, 0)

    @functools.partial(jax.jit, static_argnums=0)
    def collect(
        self, policy_state: None, rollout_state: play.RolloutState, key: jax.Array
    ) -> tuple[play.RolloutState, Trajectory, play.EpisodeLog]:
        """A rollout."""
        return play.rollout(key, self.policy, TargetStatistics.create(), self.batched, rollout_state, EVENTS)


def evaluate_policy(task: str, reference: str, episodes: int | None, reporter: Reporter) -> dict[str, Any]:
    """Plays whole episodes of a task with somebody's policy and scores them as an evaluation of ours.

    Args:
      task: its id.
      reference: "module:Class", importable from the working directory. `Class(spec)` is made once, and its method
        `preferences(observation, first, acting)` called for every event with NumPy arrays that lead with B
        environments: uint8 observations, and whether each opens an episode and is its to act on. It returns logits
        [B, A]; actions are sampled from them, illegal ones masked out.
      episodes: at least so many; None: 1,000 of a two-player game, 48 otherwise.
      reporter: where progress goes.

    Raises:
      UserError: an unknown task, or a policy that cannot be imported, made or asked.
    """
    entry = registry.task(task)
    spec = entry.spec()
    policy = ExternalPolicy(_load(reference, spec), spec)
    shape = (NUM_ENVS, *spec.observation.shape)
    flags = np.ones(NUM_ENVS, bool)
    policy.ask(np.zeros(shape, np.uint8), flags, flags)  # before anything is compiled
    device_kind()  # or one line that says that there is none
    enable_compilation_cache()
    contest = Contest(policy, Batched(entry.make()(progress=reporter.texture), NUM_ENVS))
    count = episodes or (GAMES if spec.two_player else NUM_ENVS)
    [rows] = play_episodes(contest, None, [jax.random.key(0)], count)
    return {"episodes": len(rows), **entry.scores()(rows, None, spec)}


def _load(reference: str, spec: EnvironmentSpec) -> Any:
    module, _, name = reference.partition(":")
    if not module or not name:
        raise UserError(f"--policy={reference}: expected module:Class")
    sys.path.insert(0, str(Path.cwd()))
    try:
        with _raised(f"--policy={reference}: importing {module!r}"):
            imported = importlib.import_module(module)
    finally:
        sys.path.pop(0)
    if not hasattr(imported, name):
        raise UserError(f"--policy={reference}: {module} has no {name!r}; {did_you_mean(name, vars(imported))}")
    made = getattr(imported, name)
    if not callable(made) or not _takes(made, 1):
        raise UserError(f"--policy={reference}: {name}{_signature(made)} cannot be called as {name}(spec)")
    with _raised(f"--policy={reference}: {name}(spec)"):
        policy = made(spec)
    method = getattr(policy, "preferences", None)
    if not callable(method):
        raise UserError(f"--policy={reference}: it has no method {METHOD}")
    if not _takes(method, 3):
        raise UserError(f"--policy={reference}: its method preferences{_signature(method)} is called as {METHOD}")
    return policy


def _takes(function: Callable[..., Any], arguments: int) -> bool:
    """Whether it can be called with so many arguments, as far as it tells."""
    try:
        inspect.signature(function).bind(*range(arguments))
    except TypeError:
        return False
    except ValueError:  # one of a compiled language
        return True
    return True


def _signature(function: Any) -> str:
    try:
        return str(inspect.signature(function))
    except (TypeError, ValueError):
        return ""


@contextlib.contextmanager
def _raised(what: str) -> Iterator[None]:
    """Says in one line what somebody else's code raised, and where."""
    try:
        yield
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        problem = " ".join(f"{type(error).__name__}: {error}".split())
        raise UserError(f"{what} raised {problem} ({Path(where.filename).name}, line {where.lineno})") from error
