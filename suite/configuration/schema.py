"""Every hyperparameter, typed and frozen. The defaults are the paper's for Craftax-classic (its Appendix A).

A run's configuration is built by `suite.registry.resolve`: these defaults, then the preset's changes for the task,
then the agent's, then the user's `dotted.name=value`. Nothing else sets a hyperparameter.

N_env, T_env and the like in the comments are the paper's names; "note n" is a row of the fidelity notes.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Iterator
from typing import Annotated, Any, Literal, TypeVar, dataclass_transform

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

# The paper's tau: patches at most so far apart (squared distance of pixels from 0 to 1) count as the same.
PATCH_THRESHOLD = 0.75

T = TypeVar("T")
Positive = Annotated[int, Field(gt=0, lt=2**31)]  # what is counted, JAX counts in 32 bits
NotNegative = Annotated[int, Field(ge=0, lt=2**31)]
PositiveFloat = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegativeFloat = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Rate = Annotated[float, Field(ge=0, lt=1)]
ComputeType = Literal["auto", "float32", "bfloat16"]  # auto: bfloat16 on an accelerator, float32 on a CPU


@dataclass_transform(frozen_default=True)
def config_class(cls: type[T]) -> type[T]:
    """A frozen, validated dataclass; defaults too, so that a wrong one fails at import and not in a run."""
    return dataclass(frozen=True, config=ConfigDict(extra="forbid", validate_default=True))(cls)  # type: ignore[return-value]


@config_class
class ProtocolConfig:
    """What makes two results comparable: budget and scoring window. Hashed into every record."""

    steps: Positive = 1_000_000  # T_total: real environment steps
    final_fraction: Fraction = 0.1  # reward is the mean over episodes that end in this last part (note 29)


@config_class
class EnvironmentConfig:
    """Collecting real experience (Algorithm 1, step 1)."""

    num_envs: Positive = 48  # N_env
    rollout_length: Positive = 96  # T_env
    burn_in: NotNegative = 5  # M: frames that refresh the GRU before a rollout
    # Where burn-in starts from in the real environment: the state carried over from M frames ago, or zero (note 12).
    burn_in_start: Literal["carried", "zero"] = "carried"


@config_class
class PolicyConfig:
    """Actor-critic network (Appendix A.1.1; sizes as the fidelity notes' parameter table)."""

    kind: Literal["actor_critic", "moon", "uniform"] = "actor_critic"  # moon: that of Moon et al. (note 36)
    cnn_channels: tuple[Positive, ...] = (64, 128, 128)  # one Impala stack each; the literal text: (64, 64, 128)
    blocks_per_stack: Positive = 2
    convs_per_block: Positive = 2  # the literal text: 1
    max_pixels: Positive = 63  # larger frames are resized to this height and width, nearest pixel (note 4)
    cnn_norm: Literal["instance", "batch", "layer"] = "instance"  # note 1
    activation: Literal["relu", "swish"] = "relu"  # inside the CNN
    embedding_size: NotNegative = 0  # the CNN's output is mapped to so many numbers; 0: it stays as it is
    rnn_size: NotNegative = 256  # 0: no memory
    hidden_size: Positive = 2048
    dense_blocks: NotNegative = 2
    shared_trunk: bool = False  # actor and critic share everything up to their last linear layers
    compute_type: ComputeType = "auto"


@config_class
class PPOConfig:
    """PPO on real and imagined play (Appendix A.1.2, Algorithm 3)."""

    discount: Rate = 0.925  # gamma
    gae_lambda: Fraction = 0.625
    clip: PositiveFloat = 0.2  # epsilon
    value_coefficient: NotNegativeFloat = 1.0  # lambda_TD (note 7)
    entropy_coefficient: NotNegativeFloat = 0.01  # lambda_ent, on real play
    target_decay: Rate = 0.95  # alpha: moving averages that standardise the value targets (note 8)
    target_min_std: PositiveFloat = 0.1
    # What is averaged for their spread: each minibatch's deviation, or the mean square (Moon et al., note 36).
    target_spread: Literal["deviation", "mean_square"] = "deviation"
    learning_rate: PositiveFloat = 4.5e-4
    anneal_learning_rate: bool = False  # linear to 0 over the budget, in dreams too; in the paper MFRL alone (note 11)
    adam_eps: PositiveFloat = 1e-5
    max_grad_norm: PositiveFloat = 0.5
    learn_from_real: bool = True  # Algorithm 1, step 2
    epochs: Positive = 4  # on real play
    minibatches: Positive = 8  # on real play: contiguous groups of environments


@config_class
class ReplayConfig:
    """Buffer of real frames."""

    capacity: Positive = 128_000  # frames over all environments


@config_class
class TokenizerConfig:
    """From observations to tokens (Section 3.5, Appendix A.2.1)."""

    # Learned: vq_vae (whole frames; M1, M2), patch_vq_vae (M3). continuous: patches are not quantized but regressed.
    kind: Literal["nearest_neighbor", "vq_vae", "patch_vq_vae", "continuous"] = "nearest_neighbor"
    codebook_size: Positive = 4096  # K
    threshold: NotNegativeFloat = PATCH_THRESHOLD  # tau, on the squared distance of patches in [0, 1] (note 13)
    patch: tuple[Positive, Positive] | None = None  # None: the task's natural patch; the frame is padded to fill (37)
    updates: NotNegative = 25  # N_tok, each of `world_model.minibatches` minibatches
    # The rest belongs to the VQ-VAEs (note 15).
    embed_dim: Positive = 128  # of codes and latents, both of unit norm
    channels: Annotated[tuple[Positive, ...], Field(min_length=5, max_length=5)] = (64, 64, 128, 128, 256)
    # lambda 1 to 4 of Eq. 3: absolute error, squared error, codebook, commitment
    loss_weights: tuple[NotNegativeFloat, NotNegativeFloat, NotNegativeFloat, NotNegativeFloat] = (1.0, 0.0, 1.0, 0.25)
    learning_rate: PositiveFloat = 1e-3


@config_class
class WorldModelConfig:
    """Transformer world model (Section 3.6, Appendix A.2.2)."""

    enabled: bool = True
    block_teacher_forcing: bool = True  # BTF; false: token by token, as M1 to M4 (note 19)
    sequence_length: Positive = 20  # T_WM: blocks per training sequence, and keys kept in imagination
    embed_dim: Positive = 128
    layers: Positive = 3
    heads: Positive = 8
    dropout: Rate = 0.1  # embedding, attention and residual
    initial_std: PositiveFloat = 0.02  # of every kernel and embedding, GPT-2's; narrow models learn faster from more
    positions: Literal["flat", "grid"] = "flat"  # RoPE over the token index, or over (time, row, column): note 20
    # How attention is computed: plain operations, or one kernel for GPUs (suite/nn/fused_attention.py).
    attention: Literal["plain", "fused"] = "plain"
    # This and the next seven are not the paper's (docs/agents.md): copy tokens from near their place, or make them new.
    correspondence: bool = False
    correspondence_radius: NotNegative = 1  # of the square that is copied from; symbols: their own place alone
    # Numbers in a further embedding of the 3x3 tokens around each, of which its own embedding gets a sum; 0: none.
    local_embedding: NotNegative = 0
    action_in_tokens: bool = False  # an embedding of the action is added to every token of its block
    # Reward and termination are read off a frame's tokens too: off every patch by itself, off all symbols together.
    place_heads: bool = False
    # The model is told every token's age, for how many steps its place has shown it, up to so many. 0: it is not told.
    # Only where tokens are patches: symbols of games that people play have no timers.
    ages: NotNegative = 0
    # The model is told how often each action has earned a reward in the episode, counted up to so many. 0: it is not
    # told. Where tokens are patches, as with ages.
    paid: NotNegative = 0
    # Embeddings and logits of a code are its own and a linear map of the patch that it stands for.
    patch_contents: bool = False
    # Symbols are embedded by value and place, since the same value means different things in different places; the
    # paper does not say. false: by value alone, as patches are.
    symbol_places: bool = True
    reward_classes: tuple[float, ...] | None = None  # None: the task's levels
    mask_after_done: bool = False  # drop losses after an episode's end inside a sequence: note 21
    sequences: Positive = 48  # per update, over all minibatches (N_env in Algorithm 5)
    # This share of the training sequences is drawn among those in which a reward is paid or an episode ends. The losses
    # of rewards and ends are weighed so that they stay what they are on average. 0: all are drawn alike.
    event_share: Rate = 0.0
    # In training each token that is read is, with this probability, that of the same place in another sequence of the
    # minibatch (or, since their order is random, in its own): the model learns to go on from frames that are wrong, as
    # those of dreams are at times. 0: all are as they were.
    token_noise: Rate = 0.0
    updates: NotNegative = 500  # N_TWM
    minibatches: Positive = 3
    reward_weight: NotNegativeFloat = 1.0  # of the reward and termination losses (MinAtar: 10)
    learning_rate: PositiveFloat = 1e-3
    adam_eps: PositiveFloat = 1e-5
    # Muon (Jordan et al. 2024) for the matrices between hidden features, Adam for the rest; the paper has Adam alone.
    optimizer: Literal["adam", "muon"] = "adam"
    max_grad_norm: PositiveFloat = 0.5
    average: Rate = 0.0  # decay, per gradient step, of the moving average of parameters that dreams use; 0: the newest
    compute_type: ComputeType = "auto"


@config_class
class ImaginationConfig:
    """Policy updates on imagined play (Algorithm 1, step 4)."""

    # Where dreams happen: in the world model, or in the task's own game, started from replayed states (`oracle`).
    world: Literal["model", "game"] = "model"
    # Dreams start among the latest so many steps of each environment. 0: anywhere in the replay buffer.
    recent: NotNegative = 0
    # Real frames before the start frame that the world model sees too. The paper's dreams see none (note 24).
    context: NotNegative = 0
    # Codes less likely than this share of the likeliest one are not dreamt: what is left of a softmax that training
    # has not emptied. 0: all are drawn as the model says.
    min_p: Rate = 0.0
    # Dreams teach only in iterations in which the world model knows at least this share of what rewards hold
    # (`world_model/reward_known`): a policy that learns from rewards that do not come is worse than one that does not
    # dream. 0: always.
    trust: Rate = 0.0
    # The share is measured on each iteration's new steps, before the model learns from them, as a moving average over
    # so many iterations. 0: on the replayed steps that the model learns from, whose rare rewards it may know by heart.
    trust_window: NotNegative = 0
    start_step: NotNegative = 200_000  # T_BP: warmup
    horizon: Positive = 20  # T_WM
    num_envs: Positive = 48
    updates: NotNegative = 150  # N_AC, per iteration
    schedule: Literal["constant", "linear"] = "constant"  # linear: 0 at step 0 to `updates` at the budget (Appendix C)
    epochs: Positive = 1
    minibatches: Positive = 1
    entropy_coefficient: NotNegativeFloat = 0.01


@config_class
class EvaluationConfig:
    """Whole episodes beside training (Section 4.6, fidelity note 31). They change nothing of it: not hashed."""

    every_steps: NotNegative = 50_000  # and after the last one; 0: only then
    episodes: Positive = 32  # at least; the first one of each environment, in batches of `environment.num_envs`


@config_class
class CheckpointConfig:
    """How often a run saves itself. Not part of the protocol."""

    every_steps: Positive = 50_000
    keep: Annotated[int, Field(ge=2, lt=2**31)] = 2  # two, so that one may be found broken
    # A finished run keeps what more steps (`--steps`) would need, if it can take them (`Config.tied_to_budget`).
    keep_resume: bool = True


@config_class
class Config:
    """One run, completely."""

    task: str
    agent: str
    preset: str
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0  # JAX makes a key of 32 bits: others would be the same again
    protocol: ProtocolConfig = ProtocolConfig()
    environment: EnvironmentConfig = EnvironmentConfig()
    policy: PolicyConfig = PolicyConfig()
    ppo: PPOConfig = PPOConfig()
    replay: ReplayConfig = ReplayConfig()
    tokenizer: TokenizerConfig = TokenizerConfig()
    world_model: WorldModelConfig = WorldModelConfig()
    imagination: ImaginationConfig = ImaginationConfig()
    evaluation: EvaluationConfig = EvaluationConfig()
    checkpoint: CheckpointConfig = CheckpointConfig()

    def __post_init__(self) -> None:
        for problem in _problems(self):
            raise ValueError(problem)

    @property
    def dreams(self) -> bool:
        """Whether the policy learns from imagined play."""
        return self.world_model.enabled or self.imagination.world == "game"

    @property
    def learns_from_real(self) -> bool:
        """Whether real play teaches the policy."""
        return self.ppo.learn_from_real and self.policy.kind != "uniform"

    @property
    def steps_per_iteration(self) -> int:
        """Real environment steps of one iteration: N_env x T_env."""
        return self.environment.num_envs * self.environment.rollout_length

    @property
    def iterations(self) -> int:
        """Whole iterations that fit the budget: 1M / (48 x 96) = 217 (note 25)."""
        return self.protocol.steps // self.steps_per_iteration

    @property
    def total_steps(self) -> int:
        """Real steps actually taken: `iterations * steps_per_iteration`, at most the budget."""
        return self.iterations * self.steps_per_iteration

    @property
    def tied_to_budget(self) -> tuple[str, ...]:
        """Settings, as "name=value", by which the same step is another under a larger budget. None: it is the same."""
        learns = self.learns_from_real or self.dreams
        tied = {
            "ppo.anneal_learning_rate=true": learns and self.ppo.anneal_learning_rate,
            "imagination.schedule=linear": self.dreams and self.imagination.schedule == "linear",
        }
        return tuple(name for name, applies in tied.items() if applies)

    def imagined_updates(self, steps: int, known: float | None = None) -> int:
        """Imagined policy updates of the iteration that brings the run to `steps` real steps.

        `known`: the share of what rewards hold that the world model knew in it, if that was measured.
        """
        plan = self.imagination
        if not self.dreams or steps < plan.start_step or (known is not None and known < plan.trust):
            return 0
        if plan.schedule == "linear":
            return round(plan.updates * min(1.0, steps / self.protocol.steps))
        return plan.updates

    def as_dict(self) -> dict[str, Any]:
        """Plain nested values, as written to `config.json`."""
        return json.loads(json.dumps(dataclasses.asdict(self)))

    def digest(self) -> str:
        """Identifies a run up to what may change without changing its results (when it is evaluated and saved)."""
        fields = self.as_dict()
        del fields["checkpoint"], fields["evaluation"]
        return hash_of(fields)


def hash_of(fields: dict[str, Any]) -> str:
    """First 16 hex digits of the SHA-256 of sorted JSON."""
    return hashlib.sha256(json.dumps(fields, sort_keys=True).encode()).hexdigest()[:16]


def _problems(config: Config) -> Iterator[str]:
    """What no single field can say: sizes that must divide each other. Yields one line each."""
    env, ppo, model, dream = config.environment, config.ppo, config.world_model, config.imagination
    pairs = [
        ("ppo.minibatches", ppo.minibatches, "environment.num_envs", env.num_envs),
        ("imagination.minibatches", dream.minibatches, "imagination.num_envs", dream.num_envs),
        ("world_model.minibatches", model.minibatches, "world_model.sequences", model.sequences),
        ("world_model.heads", model.heads, "world_model.embed_dim", model.embed_dim),
    ]
    for name, value, of, total in pairs:
        if total % value:
            yield f"{name}={value} must divide {of}={total}"
    if list(model.reward_classes or ()) != sorted(set(model.reward_classes or ())):
        yield f"world_model.reward_classes={model.reward_classes} must ascend"
    if config.dreams and config.replay.capacity < 2 * config.steps_per_iteration:
        yield f"replay.capacity={config.replay.capacity} must hold two iterations ({2 * config.steps_per_iteration})"
    if model.enabled and env.rollout_length <= model.sequence_length + model.ages:
        ages = f" + world_model.ages={model.ages}" if model.ages else ""
        yield (
            f"environment.rollout_length={env.rollout_length} must exceed "
            f"world_model.sequence_length={model.sequence_length}{ages}"
        )
    if env.rollout_length < env.burn_in:
        yield f"environment.rollout_length={env.rollout_length} must be at least environment.burn_in={env.burn_in}"
    if dream.world == "game" and model.enabled:
        yield "imagination.world=game has no use for a world model: world_model.enabled=false"
    if dream.trust_window and not dream.trust:
        yield (
            f"imagination.trust_window={dream.trust_window} measures what imagination.trust=0 does not ask for, so it "
            "must be 0 too"
        )
    if model.event_share and dream.trust and not dream.trust_window:
        yield (
            f"world_model.event_share={model.event_share} replays more rewards than there are: imagination.trust must "
            "measure on new steps, with imagination.trust_window above 0"
        )
    if dream.world == "game" and dream.trust:
        yield "imagination.world=game needs no trust, for its rewards are the true ones: imagination.trust=0"
    if dream.world == "model" and dream.context >= model.sequence_length:
        yield (
            f"imagination.context={dream.context} must be less than world_model.sequence_length="
            f"{model.sequence_length}: the model reads so many frames, a dream's first one among them"
        )
    if (model.embed_dim // model.heads) % 2:
        yield f"world_model.embed_dim / world_model.heads = {model.embed_dim / model.heads:g} must be even (RoPE)"
    width = model.embed_dim // model.heads
    if model.attention == "fused" and (width < 16 or width & (width - 1)):
        yield f"world_model.attention=fused needs heads of width 16, 32, 64 ..., not embed_dim / heads = {width}"
    if config.policy.kind == "moon" and (config.policy.rnn_size or not config.policy.embedding_size):
        yield "policy.kind=moon has no memory and an embedding: policy.rnn_size=0, and policy.embedding_size above 0"
    if model.patch_contents and config.tokenizer.kind != "nearest_neighbor":
        yield "world_model.patch_contents=true needs codes that are patches: tokenizer.kind=nearest_neighbor"
    beyond = {"correspondence=true": model.correspondence, f"ages={model.ages}": model.ages}
    for name, used in (beyond | {f"paid={model.paid}": model.paid}).items():
        if used and (not model.block_teacher_forcing or config.tokenizer.kind == "continuous"):
            yield (
                f"world_model.{name} needs world_model.block_teacher_forcing=true and a tokenizer.kind whose "
                "tokens are codes"
            )
    if dream.min_p and not model.block_teacher_forcing:
        yield f"imagination.min_p={dream.min_p} needs world_model.block_teacher_forcing=true"
    if config.tokenizer.kind == "continuous" and not model.block_teacher_forcing:
        yield "tokenizer.kind=continuous needs world_model.block_teacher_forcing=true: its tokens are no codes"
    if config.protocol.steps < config.steps_per_iteration:
        yield (
            f"protocol.steps={config.protocol.steps} is less than one iteration of "
            f"{config.steps_per_iteration} steps ({env.num_envs} environments x {env.rollout_length})"
        )
