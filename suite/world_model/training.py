"""One gradient step of the world model: teacher forcing, block by block or not (Section 3.6, Appendix A.2.2)."""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import nnx, struct
from optax.contrib import MuonDimensionNumbers

from suite.configuration.schema import PATCH_THRESHOLD, WorldModelConfig
from suite.interface.tokens import TokenSpec
from suite.interface.turns import CHANCE, Turn
from suite.nn.masked import masked_mean
from suite.nn.optimizer import clipped
from suite.nn.per_device import of_each_device
from suite.runtime import layout
from suite.world_model.correspondence import mixture_loss
from suite.world_model.heads import TurnLogits
from suite.world_model.sequences import Sequences
from suite.world_model.transformer import WorldModel

CHUNK_LOGITS = 2**25  # observation logits held at once: 128 MiB
METRICS: tuple[str, ...] = (
    "loss",
    "observation_loss",
    "token_accuracy",
    "changed_token_accuracy",
    "reward_loss",
    "reward_accuracy",
    "termination_loss",
    "gradient_norm",
)  # names of what `update` returns
TURN_METRICS: tuple[str, ...] = (
    "player_loss",
    "player_accuracy",
    "legal_loss",
    "legal_accuracy",
    "chance_loss",
    "chance_excess",
)  # in a two-player game besides


@struct.dataclass
class WorldModelTrainState:
    """What training changes.

    Attributes:
      params: the parameters, an `nnx.State`.
      optimizer: the optimizer's state.
      averaged: a moving average of the parameters, which dreams use; None: they use the parameters.
      measured: float32 [1 + R], moving averages over iterations, which begin with zeros: the loss of rewards on steps
        that the model had not learned from, and how often each of the R classes of reward came in them. None: they
        are not measured.
    """

    params: Any
    optimizer: optax.OptState
    averaged: Any = None
    measured: jax.Array | None = None

    @classmethod
    def create(
        cls, config: WorldModelConfig, optimizer: optax.GradientTransformation, params: Any
    ) -> WorldModelTrainState:
        """That of an untrained model."""
        return cls(params, optimizer.init(params), jax.tree.map(jnp.copy, params) if config.average else None)

    def with_contents(self, contents_KP: jax.Array) -> WorldModelTrainState:
        """The same, with models that know these `Tokenizer.contents`, which training leaves as they are."""

        def show(params: Any) -> Any:
            def leaf(path: Any, array: jax.Array) -> jax.Array:
                return contents_KP if path[0].key == "contents" else array

            return jax.tree_util.tree_map_with_path(leaf, params)

        averaged = None if self.averaged is None else show(self.averaged)
        return self.replace(params=show(self.params), averaged=averaged)  # type: ignore[attr-defined]

    @property
    def dreaming(self) -> Any:
        """The parameters that dreams use."""
        return self.params if self.averaged is None else self.averaged


def make_optimizer(config: WorldModelConfig) -> optax.GradientTransformation:
    """Adam after clipping the gradient's global norm (fidelity note 23), or Muon in its place."""
    optimizer = optax.adam(config.learning_rate, eps=config.adam_eps)
    if config.optimizer == "muon":
        optimizer = optax.contrib.muon(
            config.learning_rate,
            eps=config.adam_eps,
            consistent_rms=0.2,  # steps of Adam's size, so that one learning rate serves both
            muon_weight_dimension_numbers=_hidden_matrices,
        )
    return clipped(optimizer, config.max_grad_norm)


def _hidden_matrices(params: nnx.State) -> Any:
    """Which axes of which parameters Muon makes orthogonal; None: a parameter of Adam's.

    Those of the layers' matrices, which are stacked, and of the heads' first ones. Embeddings, what logits are read
    off, biases and norms are left to Adam, as is usual.
    """

    def axes(path: Any, array: jax.Array) -> MuonDimensionNumbers | None:
        name = jax.tree_util.keystr(path)
        if "layers" in name and array.ndim == 3:
            return MuonDimensionNumbers(reduction_axis=1, output_axis=2)
        if "hidden" in name and array.ndim == 2:
            return MuonDimensionNumbers(reduction_axis=0, output_axis=1)
        return None

    return jax.tree_util.tree_map_with_path(axes, params)


def metrics_of(spec: TokenSpec, config: WorldModelConfig) -> tuple[str, ...]:
    """Names of the scalars that `update` returns for such a stream."""
    copied = ("copied_share",) if config.correspondence else ()
    return METRICS + copied + (TURN_METRICS if spec.two_player else ())


def losses(
    model: WorldModel,
    sequences: Sequences,
    config: WorldModelConfig,
    spec: TokenSpec,
    dropout_key: jax.Array | None = None,
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """The sum of three cross-entropies in nats, means over tokens or steps, and scalar metrics.

    Of tokens that are vectors the first is the squared Euclidean distance, and one within `PATCH_THRESHOLD` counts as
    accurate.

    Observation + `reward_weight` * (reward + termination); in a game + `turn_losses`. Sequences may cross episodes;
    with `mask_after_done` only what comes before an episode's end counts: all three losses up to it, but not the
    tokens, nor the turn, it leads to.
    """
    step_weight_BT, token_weight_BT = _weights(sequences, config.mask_after_done)
    lesson = model.factorization.lesson(sequences, token_weight_BT)
    if dropout_key is not None and config.token_noise:
        noisy_BFL = with_wrong_tokens(lesson.frame_BFL, config.token_noise, jax.random.fold_in(dropout_key, 1))
        lesson = lesson.replace(frame_BFL=noisy_BFL)  # type: ignore[attr-defined]
    hidden_BFSD = model(lesson.frame_BFL, lesson.action_BF, dropout_key, lesson.history_BF)
    token_loss_BFL, correct_BFL, copied_BFL = _token_losses(model, hidden_BFSD, lesson.target_BFL, lesson.frame_BFL)
    changed_BFL = (lesson.before_BFL != lesson.target_BFL).reshape(*lesson.weight_BFL.shape, -1).any(-1)
    hidden_BTSD = hidden_BFSD[:, : sequences.action_BT.shape[1]]

    reward_class_BT = spec.reward_to_class(sequences.reward_BT)
    turn_BT = sequences.turn_BT
    reward_logits_BTR = model.reward_logits(hidden_BTSD, None if turn_BT is None else turn_BT.seat[:, :-1])
    reward_loss_BT, reward_correct_BT = cross_entropy(reward_logits_BTR, reward_class_BT)
    termination_loss_BT, _ = cross_entropy(
        model.termination_logits(hidden_BTSD), sequences.terminated_BT.astype(jnp.int32)
    )

    def weighed(value_BT: jax.Array) -> jax.Array:
        """Not divided by the weights' sum: that would weigh the sequences of one minibatch against each other alone."""
        return value_BT if sequences.weight_B is None else value_BT * sequences.weight_B[:, None]

    metrics = {
        "observation_loss": masked_mean(token_loss_BFL, lesson.weight_BFL),
        "token_accuracy": masked_mean(correct_BFL, lesson.weight_BFL),
        "changed_token_accuracy": masked_mean(correct_BFL, lesson.weight_BFL * changed_BFL.astype(jnp.float32)),
        "reward_loss": masked_mean(weighed(reward_loss_BT), step_weight_BT),
        "reward_accuracy": masked_mean(weighed(reward_correct_BT), step_weight_BT),
        "termination_loss": masked_mean(weighed(termination_loss_BT), step_weight_BT),
    }
    if model.gate_head is not None:
        metrics["copied_share"] = masked_mean(copied_BFL, lesson.weight_BFL)
    other = metrics["reward_loss"] + metrics["termination_loss"]
    loss = metrics["observation_loss"] + config.reward_weight * other
    if turn_BT is not None:
        following_turn_BT = jax.tree.map(lambda x: x[:, 1:], turn_BT)
        turn_loss, turn_metrics = turn_losses(model.turn_logits(hidden_BTSD), following_turn_BT, token_weight_BT)
        loss, metrics = loss + turn_loss, metrics | turn_metrics
    return loss, metrics


def with_wrong_tokens(frame_BFL: jax.Array, share: float, key: jax.Array) -> jax.Array:
    """Frames of which a share of all tokens is that of the same place in a sequence of the batch, or its own by chance.

    A dreamt frame is wrong at times: its tokens are drawn at each place by itself, so that a ball may be drawn nowhere.
    A model that has read true frames alone does not know how to go on from there, and what it says of rewards and ends
    is arbitrary. What it has to predict stays true, so it learns to rely on the frames before.
    """
    order_key, which_key = jax.random.split(key)
    batch, frames = frame_BFL.shape[:2]
    order_B = jax.random.permutation(order_key, batch)
    other_BFL = layout.take(frame_BFL, order_B, jnp.broadcast_to(jnp.arange(frames), (batch, frames)))
    wrong_BFL = jax.random.bernoulli(which_key, share, frame_BFL.shape[:3])
    return jnp.where(wrong_BFL.reshape(*wrong_BFL.shape, *(1,) * (frame_BFL.ndim - 3)), other_BFL, frame_BFL)


def turn_losses(logits_BT: TurnLogits, turn_BT: Turn, weight_BT: jax.Array) -> tuple[jax.Array, dict[str, jax.Array]]:
    """The sum of a game's three further cross-entropies in nats (Appendix G, losses 4 to 6), and scalar metrics.

    Next player; its legal actions, a mean over one binary cross-entropy for each, where a player acts; and chance's
    probabilities where chance acts, of which `chance_excess` is what is above their entropy: 0 when they are known.
    """
    player_loss_BT, player_correct_BT = cross_entropy(logits_BT.player, turn_BT.player)
    chance_BT = (turn_BT.player == CHANCE).astype(jnp.float32) * weight_BT
    played_BT = weight_BT - chance_BT
    legal_loss_BT = optax.sigmoid_binary_cross_entropy(logits_BT.legal, turn_BT.legal_A.astype(jnp.float32)).mean(-1)
    legal_correct_BT = ((logits_BT.legal > 0) == turn_BT.legal_A).all(-1).astype(jnp.float32)
    metrics = {
        "player_loss": masked_mean(player_loss_BT, weight_BT),
        "player_accuracy": masked_mean(player_correct_BT, weight_BT),
        "legal_loss": masked_mean(legal_loss_BT, played_BT),
        "legal_accuracy": masked_mean(legal_correct_BT, played_BT),
    }
    none = jnp.zeros((), jnp.float32)
    metrics |= {"chance_loss": none, "chance_excess": none}
    if turn_BT.chance_C.shape[-1]:
        target_BTC = turn_BT.chance_C
        chance_loss_BT = -(target_BTC * jax.nn.log_softmax(logits_BT.chance)).sum(-1)
        entropy_BT = jax.scipy.special.entr(target_BTC).sum(-1)
        metrics["chance_loss"] = masked_mean(chance_loss_BT, chance_BT)
        metrics["chance_excess"] = masked_mean(chance_loss_BT - entropy_BT, chance_BT)
    return metrics["player_loss"] + metrics["legal_loss"] + metrics["chance_loss"], metrics


def update(
    config: WorldModelConfig,
    optimizer: optax.GradientTransformation,
    graphdef: nnx.GraphDef,
    spec: TokenSpec,
    model_state: WorldModelTrainState,
    sequences: Sequences,
    key: jax.Array,
) -> tuple[WorldModelTrainState, dict[str, jax.Array]]:
    """One gradient step; the metrics are `losses`', `loss` and `gradient_norm` (before clipping)."""

    def loss(params: Any) -> tuple[jax.Array, dict[str, jax.Array]]:
        return losses(nnx.merge(graphdef, params), sequences, config, spec, key)

    (value, metrics), grads = jax.value_and_grad(loss, has_aux=True)(model_state.params)
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):  # Optax mixes both
        updates, state = optimizer.update(grads, model_state.optimizer, model_state.params)
    metrics |= {"loss": value, "gradient_norm": optax.tree.norm(grads)}
    params, averaged = optax.apply_updates(model_state.params, updates), model_state.averaged
    if averaged is not None:
        averaged = optax.incremental_update(params, averaged, 1 - config.average)
    return model_state.replace(params=params, optimizer=state, averaged=averaged), metrics  # type: ignore[attr-defined]


def reward_frequency(spec: TokenSpec, reward_N: jax.Array) -> jax.Array:
    """Float32 [R]: how often each class of reward comes among rewards, float32 of any shape."""
    return jax.nn.one_hot(spec.reward_to_class(reward_N.reshape(-1)), len(spec.reward_classes)).mean(0)


def known_share(reward_loss: jax.Array, frequency_R: jax.Array) -> jax.Array:
    """The share of what rewards hold that a model knows: 1 - its loss / the entropy of how often each reward comes.

    1: it foresees every reward; 0: it knows no more than how often each comes; below 0: less than that.

    Args:
      reward_loss: nats a step, a mean over steps.
      frequency_R: how often each class of reward came in them. If all are alike there is nothing to know: 0.
    """
    entropy = jax.scipy.special.entr(frequency_R).sum()
    return jnp.where(entropy > 0, 1 - reward_loss / jnp.where(entropy > 0, entropy, 1.0), 0.0)


def cross_entropy(logits: jax.Array, target: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Nats of `target` [...] under `logits` [..., C], and whether no class is likelier than it (float32 0 or 1)."""
    # A masked sum instead of a gather: its gradient needs no scatter.
    index = jax.lax.broadcasted_iota(target.dtype, logits.shape, logits.ndim - 1)
    chosen = jnp.where(index == target[..., None], logits, 0).sum(-1)
    return jax.nn.logsumexp(logits, axis=-1) - chosen, (chosen >= logits.max(-1)).astype(jnp.float32)


def _token_losses(
    model: WorldModel, hidden_BTSD: jax.Array, target_BTL: jax.Array, frame_BTL: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Observation cross-entropy [B, T, L], correctness and the share that is copied, a few sequences at a time.

    The logits of a chunk are dropped and computed again for the backward pass, so that never are there B * T * L * K.
    """
    own = of_each_device(_own_token_losses, model, (0, 0, 0), 0)
    return own(hidden_BTSD, target_BTL, frame_BTL)


def _own_token_losses(
    model: WorldModel, hidden_BTSD: jax.Array, target_BTL: jax.Array, frame_BTL: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    @jax.checkpoint
    def chunk_losses(hidden: jax.Array, target: jax.Array, frame: jax.Array) -> tuple[jax.Array, ...]:
        predicted = model.observation_logits(hidden)
        if model.gate_head is not None:
            return mixture_loss(predicted, model.log_gate(hidden), model.sources(frame), target)
        none = jnp.zeros(target.shape[:3], jnp.float32)
        if not model.token_size:
            return *cross_entropy(predicted, target), none
        distance = jnp.square(predicted - target).sum(-1)
        return distance, (distance <= PATCH_THRESHOLD).astype(jnp.float32), none

    batch, tokens = target_BTL.shape[0], (*hidden_BTSD.shape[:2], model.block - 1)
    logits = math.prod(tokens[1:]) * model.observation_head.bias.shape[0]
    chunk = max(
        size for size in range(1, batch + 1) if batch % size == 0 and size * logits <= max(CHUNK_LOGITS, logits)
    )
    split = (hidden_BTSD, target_BTL, frame_BTL)
    chunked = jax.tree.map(lambda x: x.reshape(batch // chunk, chunk, *x.shape[1:]), split)
    loss, correct, copied = jax.lax.map(lambda parts: chunk_losses(*parts), chunked)
    return loss.reshape(tokens), correct.reshape(tokens), copied.reshape(tokens)


def _weights(sequences: Sequences, mask_after_done: bool) -> tuple[jax.Array, jax.Array]:
    """0 or 1 for each step's reward and termination, and for the frame it leads to (fidelity note 21)."""
    ended_BT = sequences.terminated_BT if sequences.ended_BT is None else sequences.ended_BT
    if not mask_after_done:
        ended_BT = jnp.zeros_like(ended_BT)
    ends_BT = jnp.cumsum(ended_BT.astype(jnp.int32), axis=1)
    before_BT = ends_BT - ended_BT.astype(jnp.int32)
    return (before_BT == 0).astype(jnp.float32), (ends_BT == 0).astype(jnp.float32)
