"""PPO: its arithmetic against plain NumPy."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import nnx

from suite.configuration.schema import PolicyConfig, PPOConfig
from suite.interface.environment import ObservationSpec
from suite.interface.turns import Turn
from suite.policy import ppo
from suite.policy.actor_critic import log_probability, make_policy, mask_logits

SYMBOLS = ObservationSpec((3,), 2, "symbols")
TINY = PolicyConfig(hidden_size=8, rnn_size=4)
ACTIONS = 3


def random_trajectory(seed: int, steps: int = 6, batch: int = 4, *, turns: bool = False) -> ppo.Trajectory:
    """Numbers with the right shapes; truncation and termination as they come, sometimes both."""
    rng = np.random.default_rng(seed)

    def normal(*shape):
        return jnp.asarray(rng.normal(size=shape), jnp.float32)

    terminated_TB, truncated_TB = jnp.asarray(rng.random((2, steps, batch)) < 0.2)
    first_TB = jnp.concatenate([jnp.asarray(rng.random((1, batch)) < 0.5), (terminated_TB | truncated_TB)[:-1]])
    legal_TBA = jnp.asarray(rng.random((steps, batch, ACTIONS)) < 0.7).at[..., 0].set(True)
    return ppo.Trajectory(
        observation_TB=jnp.asarray(rng.integers(0, 3, (steps, batch, 3)), jnp.uint8),
        action_TB=jnp.zeros((steps, batch), jnp.int32) if turns else jnp.asarray(rng.integers(0, 3, (steps, batch))),
        reward_TB=normal(steps, batch),
        terminated_TB=terminated_TB,
        truncated_TB=truncated_TB,
        first_TB=first_TB,
        log_probability_TB=-jnp.abs(normal(steps, batch)),
        value_TB=normal(steps, batch),
        hidden_BH=normal(batch, TINY.rnn_size),
        last_value_B=normal(batch),
        truncation_value_TB=jnp.where(truncated_TB, normal(steps, batch), 0.0),
        turn_TB=turn_of(jnp.asarray(rng.random((steps, batch)) < 0.6), legal_TBA) if turns else None,
        last_ours_B=jnp.asarray(rng.random(batch) < 0.5) if turns else None,
    )


def turn_of(acting_TB, legal_TBA) -> Turn:
    """Turns of our player, 1, where `acting_TB`, and of the other elsewhere."""
    return Turn(
        player=jnp.where(acting_TB, 1, 2),
        seat=jnp.ones(acting_TB.shape, jnp.int32),
        legal_A=legal_TBA,
        chance_C=jnp.zeros((*acting_TB.shape, 0), jnp.float32),
        opponent_observation=jnp.zeros((*acting_TB.shape, 3), jnp.uint8),
    )


def reference_advantages(t: ppo.Trajectory, discount: float, gae_lambda: float) -> tuple[np.ndarray, np.ndarray]:
    """The definition, forwards: each decision looks for the next one of ours in its episode; and where there is one."""
    reward, value, truncation_value = map(np.asarray, (t.reward_TB, t.value_TB, t.truncation_value_TB))
    terminated, truncated = np.asarray(t.terminated_TB), np.asarray(t.truncated_TB)
    steps, batch = reward.shape
    acting = np.ones((steps, batch), bool) if t.acting_TB is None else np.asarray(t.acting_TB)
    advantage, known = np.zeros((steps, batch)), np.zeros((steps, batch), bool)
    last_ours = np.ones(batch, bool) if t.last_ours_B is None else np.asarray(t.last_ours_B)

    def advantage_at(i, b):
        total = 0.0
        for j in range(i, steps):
            if j > i and acting[j, b]:  # the next decision; everything in between was someone else's
                error = total + discount * value[j, b] - value[i, b]
                beyond = advantage_at(j, b)
                return error + (0.0 if beyond is None else discount * gae_lambda * beyond)
            total += reward[j, b]
            if terminated[j, b]:
                return total - value[i, b]
            if truncated[j, b]:
                return total + discount * truncation_value[j, b] - value[i, b]
        return total + discount * float(t.last_value_B[b]) - value[i, b] if last_ours[b] else None

    for i, b in np.argwhere(acting):
        value_at = advantage_at(i, b)
        known[i, b] = value_at is not None
        advantage[i, b] = value_at or 0.0
    return advantage, known


@pytest.mark.parametrize("turns", [False, True])
def test_generalized_advantages_against_the_definition(turns):
    advantages = jax.jit(ppo.generalized_advantages)
    for seed in range(60):
        t = random_trajectory(seed, turns=turns)
        discount, gae_lambda = np.random.default_rng(seed).uniform(0, 1, 2)
        advantage_TB, known_TB = advantages(t, discount, gae_lambda)
        expected, known = reference_advantages(t, discount, gae_lambda)
        np.testing.assert_allclose(advantage_TB, expected, rtol=1e-4, atol=1e-5)
        if turns:
            np.testing.assert_array_equal(known_TB, known)
        else:
            assert known_TB is None and known.all()


def test_advantage_by_hand():
    """gamma 0.5, lambda 0.5: A_1 = 3 + 0.5 * 2 - 1 = 3; A_0 = 1 + 0.5 * 1 - 4 + 0.25 * 3 = -1.75."""
    t = random_trajectory(0, steps=2, batch=1)
    no = jnp.zeros((2, 1), bool)
    t = t.replace(
        reward_TB=jnp.array([[1.0], [3.0]]),
        value_TB=jnp.array([[4.0], [1.0]]),
        last_value_B=jnp.array([2.0]),
        terminated_TB=no,
        truncated_TB=no,
    )
    np.testing.assert_allclose(ppo.generalized_advantages(t, 0.5, 0.5)[0][:, 0], [-1.75, 3.0])


def test_target_statistics_against_numpy():
    rng = np.random.default_rng(0)
    statistics, mean, std = ppo.TargetStatistics.create(min_std=0.1), 0.0, 0.0
    assert [float(x) for x in statistics.corrected()] == [0.0, 1.0]
    for n in range(1, 6):
        targets, mask = rng.normal(3.0, 2.0, (4, 3)).astype(np.float32), rng.random((4, 3)) < 0.6
        masked = n % 2 == 0
        seen = targets[mask] if masked else targets
        mean, std = 0.9 * mean + 0.1 * seen.mean(), 0.9 * std + 0.1 * seen.std()
        statistics = statistics.update(jnp.asarray(targets), jnp.asarray(mask) if masked else None, 0.9)
        expected = mean / (1 - 0.9**n), std / (1 - 0.9**n)  # as Adam corrects its moments
        np.testing.assert_allclose(statistics.corrected(), expected, rtol=1e-4)
        standardized = statistics.standardize(jnp.asarray(targets))
        np.testing.assert_allclose(standardized, (targets - expected[0]) / expected[1], rtol=1e-3, atol=1e-4)
        np.testing.assert_allclose(statistics.denormalize(standardized), targets, rtol=1e-4, atol=1e-4)


def test_one_update_of_target_statistics_is_exactly_what_was_seen():
    statistics = ppo.TargetStatistics.create().update(jnp.array([1.0, 3.0]), None, 0.95)
    np.testing.assert_allclose(statistics.corrected(), (2.0, 1.0), rtol=1e-5)


def test_the_spread_of_targets_may_be_averaged_as_mean_squares():
    """Fidelity note 36: the variance is the averaged mean square less the square of the averaged mean."""
    statistics, mean, square = ppo.TargetStatistics.create(of_squares=True), 0.0, 0.0
    assert [float(x) for x in statistics.corrected()] == [0.0, 1.0]
    for n, batch in enumerate([[1.0, 3.0], [5.0, 5.0], [0.0, 2.0]], start=1):
        statistics = statistics.update(jnp.array(batch), None, 0.99)
        mean = 0.99 * mean + 0.01 * np.mean(batch)
        square = 0.99 * square + 0.01 * np.mean(np.square(batch))
        weight = 1 - 0.99**n
        expected = mean / weight, np.sqrt(square / weight - (mean / weight) ** 2)
        np.testing.assert_allclose(statistics.corrected(), expected, rtol=1e-4)
    settled = ppo.TargetStatistics.create(of_squares=True).update(jnp.full(4, 7.0), None, 0.99)
    np.testing.assert_allclose(settled.corrected(), (7.0, 0.1), rtol=1e-4)


def test_deviation_of_targets_has_a_floor():
    statistics = ppo.TargetStatistics.create(min_std=0.25).update(jnp.full(4, 7.0), None, 0.95)
    np.testing.assert_allclose(statistics.corrected(), (7.0, 0.25), rtol=1e-5)


def test_targets_of_nothing_change_nothing():
    statistics = ppo.TargetStatistics.create().update(jnp.array([1.0, 3.0]), None, 0.5)
    after = statistics.update(jnp.array([100.0, 5.0]), jnp.zeros(2, bool), 0.5)
    np.testing.assert_array_equal(after.corrected(), statistics.corrected())


@functools.cache
def setup(config: PPOConfig, seed: int = 0):
    """graphdef, optimizer and a fresh policy_state on `SYMBOLS`."""
    network = nnx.jit(lambda: make_policy(TINY, SYMBOLS, ACTIONS, nnx.Rngs(seed)))()
    network.policy_head.kernel[...] = 30.0 * network.policy_head.kernel[...]  # something to disagree with
    graphdef, params = nnx.split(network)
    optimizer = ppo.make_optimizer(config)
    return graphdef, optimizer, ppo.PolicyTrainState.create(config, optimizer, params)


@functools.partial(jax.jit, static_argnums=0)
def as_played(graphdef, policy_state, t: ppo.Trajectory) -> ppo.Trajectory:
    """`t` with the log-probabilities and values that the policy_state's policy gives it."""
    output, _ = nnx.merge(graphdef, policy_state.params)(t.observation_TB, t.first_TB, t.hidden_BH, t.acting_TB)
    logits_TBA = mask_logits(output.logits_TBA, t.legal_TBA)
    return t.replace(
        log_probability_TB=log_probability(logits_TBA, t.action_TB),
        value_TB=policy_state.targets.denormalize(output.value_TB),
    )


@functools.partial(jax.jit, static_argnums=(0, 1, 2), static_argnames=("epochs", "minibatches", "entropy_coefficient"))
def run(config, graphdef, optimizer, policy_state, t, *, epochs=1, minibatches=1, entropy_coefficient=0.01):
    plan = {"epochs": epochs, "minibatches": minibatches, "entropy_coefficient": entropy_coefficient}
    return ppo.update(config, optimizer, graphdef, policy_state, t, **plan)


def test_metrics_are_named():
    config = PPOConfig()
    graphdef, optimizer, policy_state = setup(config)
    _, metrics = run(config, graphdef, optimizer, policy_state, random_trajectory(0), epochs=2, minibatches=2)
    assert sorted(metrics) == sorted(ppo.METRICS)
    assert all(value.shape == () and value.dtype == jnp.float32 for value in metrics.values())


@pytest.mark.parametrize("turns", [False, True])
def test_first_minibatch_has_ratio_one(turns):
    config = PPOConfig()
    graphdef, optimizer, policy_state = setup(config)
    t = as_played(graphdef, policy_state, random_trajectory(0, turns=turns))
    _, metrics = run(config, graphdef, optimizer, policy_state, t)
    assert metrics["clip_fraction"] == 0.0
    assert metrics["approx_kl"] == pytest.approx(0.0, abs=1e-6)
    assert metrics["policy_loss"] == pytest.approx(0.0, abs=1e-5)  # minus the mean of standardized advantages
    fast = PPOConfig(learning_rate=0.1)
    _, later = run(fast, graphdef, ppo.make_optimizer(fast), policy_state, t, epochs=4)
    assert later["approx_kl"] > 1e-3 and later["clip_fraction"] > 0.0


def reference_loss(config: PPOConfig, graphdef, policy_state, t: ppo.Trajectory, entropy_coefficient: float) -> dict:
    """The losses of one minibatch that is the whole batch, in NumPy."""
    output, _ = nnx.merge(graphdef, policy_state.params)(t.observation_TB, t.first_TB, t.hidden_BH, t.acting_TB)
    advantage, mask = reference_advantages(t, config.discount, config.gae_lambda)
    legal = np.ones((*mask.shape, ACTIONS), bool) if t.legal_TBA is None else np.asarray(t.legal_TBA)
    logits = np.where(legal, np.asarray(output.logits_TBA), -np.inf)
    policy = np.exp(logits - logits.max(-1, keepdims=True))
    policy /= policy.sum(-1, keepdims=True)
    advantage = advantage[mask]
    target = advantage + np.asarray(t.value_TB)[mask]
    target = (target - target.mean()) / max(target.std(), config.target_min_std)  # the first update: no history
    advantage = (advantage - advantage.mean()) / advantage.std()
    taken = np.take_along_axis(policy, np.asarray(t.action_TB)[..., None], -1)[..., 0][mask]
    ratio = taken / np.exp(np.asarray(t.log_probability_TB)[mask])
    gain = np.minimum(ratio * advantage, np.clip(ratio, 1 - config.clip, 1 + config.clip) * advantage)
    entropy = -(policy * np.log(np.where(policy > 0, policy, 1.0))).sum(-1)[mask]
    return {
        "policy_loss": -gain.mean(),
        "value_loss": np.square(np.asarray(output.value_TB)[mask] - target).mean(),
        "entropy": entropy.mean(),
        "clip_fraction": (np.abs(ratio - 1) > config.clip).mean(),
    }


@pytest.mark.parametrize("turns", [False, True])
def test_losses_against_numpy(turns):
    """With old log-probabilities that differ from the new, so that clipping is at work."""
    config = PPOConfig()
    graphdef, optimizer, policy_state = setup(config)
    t = random_trajectory(3, turns=turns)
    _, metrics = run(config, graphdef, optimizer, policy_state, t)
    expected = reference_loss(config, graphdef, policy_state, t, 0.01)
    assert 0 < expected["clip_fraction"] < 1
    for name, value in expected.items():
        assert metrics[name] == pytest.approx(value, rel=1e-3, abs=1e-4), name


def changed(before: nnx.State, after: nnx.State) -> float:
    return float(optax.tree.norm(jax.tree.map(jnp.subtract, before, after)))


def test_events_of_others_teach_nothing():
    """Their actions (even ones that we do not have), probabilities and values do not matter; the memory waits."""
    config = PPOConfig()
    graphdef, optimizer, policy_state = setup(config)
    t = random_trajectory(5, turns=True)
    theirs = ~t.acting_TB
    other = t.replace(
        action_TB=jnp.where(theirs, ACTIONS + 2, t.action_TB),
        log_probability_TB=jnp.where(theirs, -500.0, t.log_probability_TB),
        value_TB=jnp.where(theirs, 99.0, t.value_TB),
        turn_TB=t.turn_TB.replace(legal_A=t.legal_TBA & t.acting_TB[..., None]),
        observation_TB=jnp.where(theirs[..., None], jnp.uint8(0), t.observation_TB),
    )
    results = [run(config, graphdef, optimizer, policy_state, x, epochs=2, minibatches=2) for x in (t, other)]
    (a, metrics), (b, other_metrics) = results
    assert all(jnp.isfinite(value) for value in metrics.values())
    assert all(jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(b.params))
    assert changed(a.params, b.params) < 1e-5 < changed(a.params, policy_state.params)
    np.testing.assert_allclose(metrics["value_loss"], other_metrics["value_loss"], rtol=1e-4)


def test_a_batch_without_our_decisions_is_finite():
    config = PPOConfig()
    graphdef, optimizer, policy_state = setup(config)
    t = random_trajectory(5, turns=True)
    nobody = t.replace(turn_TB=t.turn_TB.replace(seat=jnp.zeros_like(t.turn_TB.seat)))
    after, metrics = run(config, graphdef, optimizer, policy_state, nobody)
    assert all(jnp.isfinite(value) for value in metrics.values())
    assert changed(after.params, policy_state.params) == 0.0


def test_minibatches_are_contiguous_groups_of_environments():
    """Fidelity note 9. Two minibatches are two updates of halves, in order, given the advantages of the whole."""
    config = PPOConfig(gae_lambda=0.0, discount=0.0)
    graphdef, optimizer, policy_state = setup(config)
    t = random_trajectory(1)
    no = jnp.zeros_like(t.terminated_TB)
    # Advantages are rewards here. Both halves have those of the whole, so that standardizing them apart is the same.
    reward_TB = jnp.tile(t.reward_TB[:, :2], (1, 2))
    t = t.replace(reward_TB=reward_TB, value_TB=jnp.zeros_like(reward_TB), terminated_TB=no, truncated_TB=no)
    together, _ = run(config, graphdef, optimizer, policy_state, t, epochs=2, minibatches=2)

    def part(start: int, stop: int) -> ppo.Trajectory:
        by_environment = {"hidden_BH": t.hidden_BH[start:stop], "last_value_B": t.last_value_B[start:stop]}
        steps = {
            name: value[:, start:stop]
            for name, value in vars(t).items()
            if name not in by_environment and value is not None
        }
        return ppo.Trajectory(**steps, **by_environment)

    in_order, swapped = policy_state, policy_state
    for _ in range(2):
        for start in (0, 2):
            in_order, _ = run(config, graphdef, optimizer, in_order, part(start, start + 2))
            swapped, _ = run(config, graphdef, optimizer, swapped, part(2 - start, 4 - start))
    assert changed(together.params, in_order.params) < 1e-5
    assert changed(together.params, swapped.params) > 1e-4
    np.testing.assert_allclose(together.targets.corrected(), in_order.targets.corrected(), rtol=1e-5)


def test_minibatches_must_divide_the_environments():
    config = PPOConfig()
    graphdef, optimizer, policy_state = setup(config)
    with pytest.raises(ValueError, match="3 minibatches do not divide 4 environments"):
        run(config, graphdef, optimizer, policy_state, random_trajectory(0), minibatches=3)


def test_gradients_are_clipped_by_their_global_norm():
    """Adam's first moment after one update is a tenth of the gradient that reached it."""
    for limit, clipped in ((1e-3, True), (1e6, False)):
        config = PPOConfig(max_grad_norm=limit)
        graphdef, optimizer, policy_state = setup(config)
        after, metrics = run(config, graphdef, optimizer, policy_state, random_trajectory(0))
        moment = optax.tree_utils.tree_get(after.optimizer, "mu")
        expected = limit if clipped else metrics["gradient_norm"]
        assert metrics["gradient_norm"] > 1e-3
        assert 10 * optax.tree.norm(moment) == pytest.approx(float(expected), rel=1e-3)


@pytest.mark.parametrize("anneal", [True, False])
def test_learning_rate_falls_linearly_to_zero(anneal):
    """Fidelity note 11. Adam on a constant gradient moves by the rate itself."""
    config = PPOConfig()
    graphdef, optimizer, policy_state = setup(config)
    t = random_trajectory(0)

    def moved(share: float) -> float:
        """How far one minibatch moves the parameters when `share` of the budget is left, none of it afterwards."""
        remaining = (jnp.float32(share), jnp.float32(0)) if anneal else None
        plan = {"epochs": 1, "minibatches": 1, "entropy_coefficient": 0.0, "remaining": remaining}
        after, _ = ppo.update(config, optimizer, graphdef, policy_state, t, **plan)
        return changed(after.params, policy_state.params)

    full = moved(1.0)
    shares = [0.75, 0.25, 0.0] if anneal else [1.0]
    np.testing.assert_allclose([moved(share) / full for share in shares], shares, rtol=1e-3, atol=1e-6)


def test_learning_rate_falls_between_minibatches():
    """Two minibatches of equal halves from a share of 1 to 0: rates 1 and 0.5, so the second adds half of its own."""
    config = PPOConfig()
    graphdef, optimizer, policy_state = setup(config)
    t = random_trajectory(0)

    def after(last: float, minibatches: int) -> ppo.PolicyTrainState:
        remaining = (jnp.float32(1), jnp.float32(last))
        plan = {"epochs": 1, "minibatches": minibatches, "entropy_coefficient": 0.0, "remaining": remaining}
        return ppo.update(config, optimizer, graphdef, policy_state, t, **plan)[0]

    steady, falling = after(1.0, 2), after(0.0, 2)
    first_only = after(-1.0, 2)  # rates 1 and 0
    halved = jax.tree.map(lambda a, b: (a + b) / 2, steady.params, first_only.params)
    assert changed(falling.params, halved) < 1e-5 < changed(steady.params, first_only.params)


def test_acting_needs_no_optimizer():
    _, _, policy_state = setup(PPOConfig())
    acting = policy_state.acting
    assert acting.optimizer is None and acting.params is policy_state.params and acting.targets is policy_state.targets


def test_several_seeds_learn_side_by_side():
    config = PPOConfig()
    graphdef, optimizer, _ = setup(config)
    learners = [setup(config, seed)[2] for seed in (0, 1)]
    trajectories = [random_trajectory(seed) for seed in (0, 1)]
    stacked, batch = (jax.tree.map(lambda *x: jnp.stack(x), *trees) for trees in (learners, trajectories))
    step = functools.partial(run, config, graphdef, optimizer, epochs=2, minibatches=2)
    together, _ = jax.jit(jax.vmap(step))(stacked, batch)
    for i in range(2):
        alone, _ = step(learners[i], trajectories[i])
        assert changed(jax.tree.map(lambda x, i=i: x[i], together.params), alone.params) < 1e-4
