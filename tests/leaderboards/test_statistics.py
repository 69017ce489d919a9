"""Estimates against rliable's own, numbers computed by hand, and what must hold of all scores.

Rliable's numbers were made in an environment of its own, since it wants older packages than ours:

    python3.11 -m venv rliable_env
    rliable_env/bin/pip install rliable==1.2.0 arch==7.2.0 numpy==1.26.4 pandas==2.3.3 scipy==1.17.1

by this Python, after the definitions of the constants A, B, MFRL and M5 below (18 minutes on two busy cores):

    from rliable import library, metrics
    both = lambda s: np.array([metrics.aggregate_iqm(s), metrics.aggregate_mean(s)])
    improvement = lambda x, y: np.array([metrics.probability_of_improvement(x, y)])
    for s in (A, B, B[:, :3], MFRL, M5):
        print(metrics.aggregate_iqm(s), metrics.aggregate_mean(s))
    for x, y in ((A, B), (B, A), (MFRL, M5), (A, A)):
        print(metrics.probability_of_improvement(x, y))
    for s, thresholds in ((A, [-2, -1.5, 0, 0.27, 1, 10, 30]), (MFRL, [0, 2.2, 10, 25, 40])):
        print(library.score_distributions(s, np.array(thresholds, float)))  # `run_score_deviation` at each
    np.random.seed(0)  # its argument `random_state` does nothing
    for s in (A, B, MFRL, M5):
        print(library.get_interval_estimates({"": s}, both, reps=100_000)[1][""].T)
    for x, y in ((A, B), (MFRL, M5)):
        print(library.get_interval_estimates({"": [x, y]}, improvement, reps=20_000)[1][""].T)
"""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from leaderboards.statistics import (
    aggregate_mean,
    interquartile_mean,
    mean_and_standard_error,
    performance_profile,
    probability_of_improvement,
    sample_efficiency_curve,
    stratified_bootstrap_interval,
)

# [seeds, tasks], with ties.
A = np.array(
    [[0.31, 12, -1.5, 0], [0.27, 15.5, -0.25, 3], [0.44, 9.75, 2, 0], [0.27, 11, 0.125, 1], [0.9, 30, -1.5, 2]]
)
B = np.array(
    [
        *([0.27, 14, -2, 0], [0.5, 9.75, -1.5, 1], [0.12, 8, -0.5, 0], [0.33, 15.5, -3, 0]),
        *([0.2, 10, 0, 0], [0.31, 13.25, -1.75, 2], [0.05, 7.5, -2.5, 0]),
    ]
)
# Mean returns of the last quarter's episodes of MinAtar's Asterix, Breakout, Freeway and Space Invaders, seeds 0 to 2,
# in runs of 102,400 steps.
MFRL = np.array(
    [
        [2.3629893238434163, 12.987878787878788, 33.125, 25.603448275862068],
        [2.107142857142857, 19.563106796116504, 1.0, 35.1123595505618],
        [2.212355212355212, 14.79861111111111, 1.25, 32.3469387755102],
    ]
)
M5 = np.array(
    [
        [2.014388489208633, 13.700680272108844, 27.125, 25.682926829268293],
        [1.8316831683168318, 7.896428571428571, 29.0625, 23.762589928057555],
        [2.202749140893471, 13.756578947368421, 27.75, 22.08695652173913],
    ]
)
exactly = {"rel": 0, "abs": 1e-9}


def improvement(tasks):
    """Of the agent whose tasks are the first half."""
    return probability_of_improvement(tasks[: len(tasks) // 2], tasks[len(tasks) // 2 :])


@pytest.mark.parametrize(
    ("scores", "iqm", "mean"),
    [
        (A, 1.0314999999999999, 4.265750000000001),
        (B, 0.34142857142857147, 2.554642857142857),
        (B[:, :3], 1.5254545454545456, 3.263333333333333),  # 21 scores: not whole quarters
        (MFRL, 12.921398251194516, 15.205819224198496),
        (M5, 17.814360178328467, 16.406040155699145),
    ],
)
def test_aggregates_are_rliables(scores, iqm, mean):
    assert interquartile_mean(scores) == pytest.approx(iqm, **exactly)
    assert aggregate_mean(scores) == pytest.approx(mean, **exactly)


@pytest.mark.parametrize(
    ("x", "y", "expected"),
    [(A, B, 0.7250000000000001), (B, A, 0.275), (MFRL, M5, 0.7222222222222221), (A, A, 0.5)],
)
def test_the_probability_of_improvement_is_rliables(x, y, expected):
    assert probability_of_improvement(x, y) == pytest.approx(expected, **exactly)


@pytest.mark.parametrize(
    ("scores", "thresholds", "expected"),
    [
        (A, [-2, -1.5, 0, 0.27, 1, 10, 30], [1.0, 0.9, 0.75, 0.6, 0.4, 0.2, 0.0]),
        (MFRL, [0, 2.2, 10, 25, 40], [1.0, 0.75, 0.5833333333333334, 0.3333333333333333, 0.0]),
    ],
)
def test_the_performance_profile_is_rliables(scores, thresholds, expected):
    assert performance_profile(scores, thresholds).tolist() == pytest.approx(expected, **exactly)


@pytest.mark.parametrize(
    ("scores", "statistic", "expected"),
    [
        (A, interquartile_mean, (0.44399999999999995, 1.637)),
        (A, aggregate_mean, (2.9325, 6.1345)),
        (B, interquartile_mean, (0.1092857142857143, 0.6471428571428571)),
        (B, aggregate_mean, (1.9860714285714285, 3.1421428571428573)),
        (MFRL, interquartile_mean, (7.909476013368362, 22.276748010245544)),
        (MFRL, aggregate_mean, (11.572879415080141, 20.15092078024763)),
        (M5, interquartile_mean, (15.95906783003056, 19.39038029223997)),
        (M5, aggregate_mean, (15.449232092721786, 17.226402635268723)),
        ([*A.T, *B.T], improvement, (0.5750000000000001, 0.8571428571428571)),
        ([*MFRL.T, *M5.T], improvement, (0.5277777777777777, 0.9166666666666666)),
    ],
)
def test_intervals_are_near_rliables(scores, statistic, expected):
    """Within 5 % of the width, as both draw at random: ours has a standard error of 0.7 % of it where seeds are many.

    With three the statistic has few values in its tails, and one step from one to the next is 2 % for MFRL's.
    """
    within = 0.05 * (expected[1] - expected[0])
    assert stratified_bootstrap_interval(scores, statistic) == pytest.approx(expected, abs=within)


@pytest.mark.parametrize("scores", [MFRL, M5])
@pytest.mark.parametrize("statistic", [interquartile_mean, aggregate_mean])
def test_intervals_of_three_seeds_are_those_of_all_resamples(scores, statistic):
    """All 27 of each of four tasks' are ten when their order is forgotten; within 4 standard errors of the shares."""
    of_a_task = list(itertools.combinations_with_replacement(range(3), 3))
    share = np.array([{1: 1, 2: 3, 3: 6}[len(set(seeds))] for seeds in of_a_task]) / 27
    every = np.array(list(itertools.product(range(10), repeat=4)))
    values = statistic([scores[np.array(of_a_task)[every[:, k]], k] for k in range(4)])
    shares = share[every].prod(1)
    assert shares.sum() == pytest.approx(1)
    slack = 4 * math.sqrt(0.025 * 0.975 / 10_000)
    low, high = stratified_bootstrap_interval(scores, statistic)
    assert shares[values < low - 1e-9].sum() <= 0.025 + slack
    assert shares[values <= low + 1e-9].sum() >= 0.025 - slack
    assert shares[values > high + 1e-9].sum() <= 0.025 + slack
    assert shares[values >= high - 1e-9].sum() >= 0.025 - slack


def test_intervals_over_different_numbers_of_seeds_are_near_scipys():
    tasks = [A[:, 0], B[:, 1], MFRL[:, 2]]
    theirs = stats.bootstrap(
        tasks,
        lambda *tasks, axis: interquartile_mean(tasks),
        method="percentile",
        vectorized=True,
        n_resamples=20_000,
        rng=np.random.default_rng(0),
    ).confidence_interval
    ours = stratified_bootstrap_interval(tasks, interquartile_mean)
    assert ours == pytest.approx(tuple(theirs), abs=0.03 * (theirs.high - theirs.low))


def test_mean_and_standard_error():
    assert mean_and_standard_error(x for x in (1, 2, 6)) == (3.0, pytest.approx(math.sqrt(7 / 3)))
    mean, error = mean_and_standard_error([5])
    assert mean == 5.0 and math.isnan(error)
    assert all(map(math.isnan, mean_and_standard_error([1.0, math.nan])))


def test_aggregates_by_hand():
    assert interquartile_mean(np.array([100.0, 0, 1, 2, 3, 4, 5, 6])) == 3.5
    assert interquartile_mean(np.array([1.0, 2, 9])) == 4.0
    assert interquartile_mean([np.array([0.0, 50]), np.array([1.0, 2])]) == 1.5
    assert aggregate_mean([np.array([0.0, 2]), np.array([10.0])]) == 5.5


def test_the_probability_of_improvement_by_hand():
    x, y = [np.array([1.0, 3]), np.array([700.0])], [np.array([2.0, 3]), np.array([100.0, 200, 800])]
    assert probability_of_improvement(x[0], y[0]) == 1.5 / 4
    assert probability_of_improvement(x, y) == pytest.approx((1.5 / 4 + 2 / 3) / 2)
    with pytest.raises(ValueError, match="shorter"):
        probability_of_improvement(x, y[:1])


def test_the_performance_profile_by_hand_weighs_tasks_alike():
    tasks = [np.array([1.0, 2, 3]), np.array([5.0])]
    expected = [1, (2 / 3 + 1) / 2, (1 / 3 + 1) / 2, 0]
    assert performance_profile(tasks, [0, 1, 2, 5]).tolist() == pytest.approx(expected)


# Quarters: exact in floating point, and equal ones are frequent.
numbers = st.integers(-40, 40).map(lambda x: x / 4)
one_task = st.lists(numbers, min_size=1, max_size=6).map(np.array)
some_tasks = st.lists(one_task, min_size=1, max_size=4)


@given(some_tasks, st.randoms(use_true_random=False))
@settings(max_examples=100, deadline=None)
def test_the_interquartile_mean_is_of_the_scores_in_the_middle(tasks, random):
    scores = np.concatenate(tasks).tolist()
    assert min(scores) - 1e-12 <= interquartile_mean(tasks) <= max(scores) + 1e-12
    cut = len(scores) // 4
    middle = sorted(scores)[cut : len(scores) - cut]
    assert interquartile_mean(tasks) == pytest.approx(sum(middle) / len(middle), abs=1e-12)
    random.shuffle(scores)
    assert interquartile_mean(np.array(scores)) == pytest.approx(interquartile_mean(tasks), abs=1e-12)


@given(st.lists(st.tuples(one_task, one_task), min_size=1, max_size=4))
@settings(max_examples=40, deadline=None)
def test_either_agent_is_better(pairs):
    x, y = zip(*pairs, strict=True)
    assert probability_of_improvement(x, y) + probability_of_improvement(y, x) == pytest.approx(1, abs=1e-12)
    assert probability_of_improvement(x, x) == 0.5
    count = [np.mean([(a > b) + (a == b) / 2 for a in task_x for b in task_y]) for task_x, task_y in pairs]
    assert probability_of_improvement(x, y) == pytest.approx(np.mean(count), abs=1e-12)


@given(some_tasks, st.lists(numbers, min_size=1, max_size=9))
@settings(max_examples=100, deadline=None)
def test_the_profile_falls_from_all_to_none(tasks, thresholds):
    low, high = min(map(np.min, tasks)), max(map(np.max, tasks))
    inner = np.clip(sorted(thresholds), low, high)
    profile = performance_profile(tasks, [low - 1, *inner, high])
    assert profile[0] == 1 and profile[-1] == 0
    assert (np.diff(profile) <= 0).all()


@pytest.mark.parametrize(
    "statistic",
    [
        aggregate_mean,
        interquartile_mean,
        lambda tasks: probability_of_improvement(tasks[:2], tasks[1:]),
        lambda tasks: performance_profile(tasks, [-1.0, 0.0, 0.5]),
    ],
)
def test_resamples_at_once_are_resamples_one_by_one(statistic):
    rng = np.random.default_rng(0)
    resamples = [rng.integers(-4, 5, (20, seeds)) / 4 for seeds in (3, 5, 4)]
    one_by_one = [statistic([task[i] for task in resamples]) for i in range(20)]
    np.testing.assert_allclose(statistic(resamples), one_by_one, rtol=0, atol=1e-12)


def test_seeds_are_resampled_within_their_task():
    """Whether tasks are columns or a list of different numbers of seeds."""
    for scores in (np.array([[0.0, 100.0]] * 5), [np.zeros(3), np.full(7, 100.0)]):
        assert stratified_bootstrap_interval(scores, aggregate_mean) == (50, 50)


def test_tasks_are_resampled_independently():
    """Of seeds drawn for both tasks at once the two always sum to the same."""
    low, high = stratified_bootstrap_interval(np.stack([np.arange(8.0), -np.arange(8.0)], 1), aggregate_mean)
    assert low < -0.5 and high > 0.5


def test_the_interval_of_three_seeds_is_from_the_lowest_to_the_highest():
    """One resample in 27 is three times the lowest: more than 2.5 %."""
    assert stratified_bootstrap_interval(np.array([3.0, 9, 0]), aggregate_mean) == (0, 9)


def test_coverage_of_the_mean_of_ten_seeds():
    """The percentile interval's is 90 %; 300 draws say it with a standard error of 1.7 points."""
    draws = np.random.default_rng(0).normal(3, 2, (300, 10))
    intervals = [stratified_bootstrap_interval(draw, aggregate_mean, resamples=2000) for draw in draws]
    assert 0.85 <= np.mean([low <= 3 <= high for low, high in intervals]) <= 0.99


def test_the_same_scores_have_the_same_interval():
    interval = stratified_bootstrap_interval(MFRL, aggregate_mean)
    assert stratified_bootstrap_interval(MFRL, aggregate_mean) == interval
    assert stratified_bootstrap_interval([task[::-1] for task in MFRL.T], aggregate_mean) == interval
    assert stratified_bootstrap_interval(MFRL, aggregate_mean, seed=1) != interval
    # What numpy 1.26 and 2.4 draw.
    few = stratified_bootstrap_interval(np.arange(9.0) ** 2, aggregate_mean, resamples=50)
    assert few == pytest.approx((9.322222222222221, 39.702777777777776), abs=1e-12)


def test_one_seed_has_no_interval_but_beside_others_counts_as_certain():
    for scores in (np.array([[1.0, 2.0]]), np.array([1.0]), [np.array([1.0]), np.array([2.0])]):
        assert all(map(math.isnan, stratified_bootstrap_interval(scores, aggregate_mean)))
    assert stratified_bootstrap_interval([np.array([3.0, 9, 0]), np.array([1.0])], aggregate_mean) == (0.5, 5)


def test_a_curve_is_of_the_seeds_that_have_a_score():
    nan = math.nan
    curve = sample_efficiency_curve(np.array([[1, 3, 5], [nan, 2, nan], [nan] * 3, [0, nan, 3]]))
    np.testing.assert_array_equal(curve, [[3, 2, nan, 1.5], [1, nan, nan, 0], [5, nan, nan, 3]])


def test_a_curves_interval_is_the_bootstraps():
    scores_PS = np.random.default_rng(0).normal(size=(3, 6))
    mean, low, high = sample_efficiency_curve(scores_PS)
    np.testing.assert_array_equal(mean, scores_PS.mean(1))
    bounds = [stratified_bootstrap_interval(scores, aggregate_mean) for scores in scores_PS]
    np.testing.assert_array_equal(np.stack([low, high], 1), bounds)


FUNCTIONS = [
    aggregate_mean,
    interquartile_mean,
    lambda scores: probability_of_improvement(scores, A),
    lambda scores: probability_of_improvement(A, scores),
    lambda scores: performance_profile(scores, [0.0]),
    lambda scores: stratified_bootstrap_interval(scores, aggregate_mean),
]


@pytest.mark.parametrize("function", FUNCTIONS)
@pytest.mark.parametrize(
    "scores",
    [
        *([], np.zeros(0), np.zeros((0, 4)), np.zeros((5, 0)), np.zeros((5, 4, 1)), np.array(1.0)),
        *([1.0, 2.0, 3.0, 4.0], [*A.T[:3], np.zeros(0)], np.where(A == 30, math.nan, A), np.where(A == 30, np.inf, A)),
    ],
)
def test_scores_that_are_none_are_errors(function, scores):
    with pytest.raises(ValueError, match="scores"):
        function(scores)


@pytest.mark.parametrize(
    ("function", "arguments", "says"),
    [
        (mean_and_standard_error, [[]], "no values"),
        (performance_profile, [A, []], "thresholds"),
        (performance_profile, [A, [0, math.nan]], "thresholds"),
        (sample_efficiency_curve, [np.zeros(3)], "shape"),
        (sample_efficiency_curve, [np.zeros((0, 3))], "shape"),
        (sample_efficiency_curve, [np.array([[np.inf, 1.0]])], "finite"),
        (stratified_bootstrap_interval, [A, np.mean], "resamples has shape"),
        (stratified_bootstrap_interval, [[np.ones((2, 3))], aggregate_mean], "seeds"),
    ],
)
def test_what_is_no_input_is_an_error(function, arguments, says):
    with pytest.raises(ValueError, match=says):
        function(*arguments)
