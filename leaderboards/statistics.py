"""Estimates over seeds and tasks, and their uncertainty: pure functions of scores, in whatever unit these are.

After Agarwal et al. 2021, "Deep Reinforcement Learning at the Edge of the Statistical Precipice"; tests compare them
with its library, rliable 1.2. Estimates across tasks mean something only if all scores are on one scale (normalized),
but for `probability_of_improvement`. Scores that are missing or not finite are a ValueError where nothing else is said.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

# A matrix [seeds, tasks], or an array [seeds] (of one task); or, as tasks may have different numbers of seeds, a list
# with an array [seeds] for each task. In a list arrays may have leading axes, e.g. resamples: results then have them.
Scores = np.ndarray | Sequence[np.ndarray]

# An end of an interval then moves with the bootstrap's seed by some 1 % of the width (0 to 1.8 % seen).
RESAMPLES = 10_000


def mean_and_standard_error(values: Iterable[float]) -> tuple[float, float]:
    """Mean and standard error (ddof=1) over seeds; the error of one seed is nan, and both are if a value is."""
    array = np.array(list(values), float)
    if not array.size:
        raise ValueError("no values")
    error = array.std(ddof=1) / math.sqrt(len(array)) if len(array) > 1 else math.nan
    return float(array.mean()), float(error)


def aggregate_mean(scores: Scores) -> Any:
    """Mean over tasks of the means over seeds: rliable's `aggregate_mean`; a float."""
    return np.mean([task.mean(-1) for task in _tasks(scores)], axis=0)


def interquartile_mean(scores: Scores) -> Any:
    """Mean of the middle half of all tasks' and seeds' scores together: rliable's `aggregate_iqm`; a float.

    At each end it leaves out 25 % of the scores, rounded down to whole ones as in `scipy.stats.trim_mean`: none of
    fewer than four. A task with more seeds weighs more.
    """
    from scipy import stats  # here, as the import takes seconds

    return stats.trim_mean(np.concatenate(_tasks(scores), axis=-1), 0.25, axis=-1)


def probability_of_improvement(x: Scores, y: Scores) -> Any:
    """P(X > Y) + P(X = Y) / 2 for a run of X and one of Y on the same task, mean over tasks: 0 to 1, a float.

    Over all pairs of seeds, as rliable's: the Mann-Whitney statistic over their number.

    Args:
      x: of an agent.
      y: of another, on the same tasks in the same order; it may have more or fewer seeds.
    """
    from scipy import stats

    shares = []
    for a, b in zip(_tasks(x), _tasks(y), strict=True):
        wins = stats.mannwhitneyu(a, b, method="asymptotic", axis=-1).statistic  # the method is of the p-value only
        shares.append(wins / (a.shape[-1] * b.shape[-1]))
    return np.mean(shares, axis=0)


def performance_profile(scores: Scores, thresholds: np.ndarray | Sequence[float]) -> np.ndarray:
    """Share of runs, 0 to 1, above each threshold, mean over tasks: rliable's run-score distribution, [thresholds]."""
    limits = _finite(thresholds, "thresholds")
    return np.mean([(task[..., None] > limits).mean(-2) for task in _tasks(scores)], axis=0)


def stratified_bootstrap_interval(
    scores_by_task: Scores,
    statistic: Callable[[list[np.ndarray]], np.ndarray],
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> tuple[float, float]:
    """The 95 % percentile interval of a statistic, over resamples of the seeds within each task independently.

    As rliable's `get_interval_estimates`: tasks are taken as given, not as a sample of tasks. The same scores give the
    same interval, in whatever order the seeds of a task come.

    With few seeds it is too narrow: for one task's mean it never reaches beyond the lowest and the highest score, and
    covers the mean of a normal distribution in 75 % of cases with three seeds, 85 % with five, 90 % with ten. A task
    with one seed beside others with more counts as certain.

    Args:
      scores_by_task: of an agent; of two where the statistic compares them, the tasks of one and then of the other:
        `lambda tasks: probability_of_improvement(tasks[:4], tasks[4:])`.
      statistic: from an array [resamples, seeds] for each task to [resamples], like this module's functions of scores.
      resamples: how many.
      seed: the bootstrap's.

    Returns:
      The 2.5 and 97.5 percentiles, linearly interpolated; both nan if no task has more than one seed.
    """
    tasks = [np.sort(task) for task in _tasks(scores_by_task)]  # so that their order makes no difference
    if any(task.ndim != 1 for task in tasks):
        raise ValueError(f"scores of tasks have shapes {[task.shape for task in tasks]}, not [seeds]")
    if all(len(task) == 1 for task in tasks):
        return math.nan, math.nan
    # Of its bit generators numpy promises that later versions draw the same; of a Generator's integers it does not
    # (NEP 19). That 2**64 is no multiple of the number of seeds makes no difference above 1e-17.
    bits = np.random.PCG64(seed)
    drawn = [task[(bits.random_raw((resamples, len(task))) % len(task)).astype(np.intp)] for task in tasks]
    values = np.asarray(statistic(drawn))
    if values.shape != (resamples,):
        raise ValueError(f"the statistic of {resamples} resamples has shape {values.shape}")
    low, high = np.percentile(values, [2.5, 97.5])
    return float(low), float(high)


def sample_efficiency_curve(per_seed_PS: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A learning curve over equal parts of the budget of real steps: mean over seeds and its 95 % interval, by part.

    Args:
      per_seed_PS: [parts, seeds]; each seed's mean score over the episodes that end in a part, or nan where none does:
        that part is of the other seeds alone.

    Returns:
      mean, low and high: [parts] each; nan where no seed has a score, low and high also where just one has.
    """
    per_seed_PS = np.asarray(per_seed_PS, float)
    if per_seed_PS.ndim != 2 or not per_seed_PS.size:
        raise ValueError(f"scores have shape {per_seed_PS.shape}, not [parts, seeds]")
    curve_3P = np.full((3, len(per_seed_PS)), math.nan)
    for part, scores in enumerate(per_seed_PS):
        if (scores := scores[~np.isnan(scores)]).size:
            curve_3P[:, part] = scores.mean(), *stratified_bootstrap_interval(scores, aggregate_mean)
    return curve_3P[0], curve_3P[1], curve_3P[2]


def _tasks(scores: Scores) -> list[np.ndarray]:
    if isinstance(scores, np.ndarray) and scores.ndim not in (1, 2):
        raise ValueError(f"scores have shape {scores.shape}, not [seeds, tasks]")
    by_task = np.atleast_2d(scores.T) if isinstance(scores, np.ndarray) else scores
    if not len(by_task):
        raise ValueError("no scores")
    return [_finite(task, "scores of a task") for task in by_task]


def _finite(values: np.ndarray | Sequence[float], what: str) -> np.ndarray:
    array = np.asarray(values, float)
    if not array.ndim or not array.size or not np.isfinite(array).all():
        raise ValueError(f"{what} are not an array of finite numbers: {array}")
    return array
