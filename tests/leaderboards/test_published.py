"""The published numbers against the catalogue, and against the paper's tables as read by hand."""

from __future__ import annotations

import csv
import re

import pandas as pd
import pytest

from leaderboards.published import COLUMNS, OF_FAMILY, PATH, published
from suite import registry
from suite.registry.catalog import AGENTS
from suite.runtime.errors import UserError

NUMBER = r"(?P<{0}>[\d.]+) \+- (?P<{0}_error>[\d.]+) %"
PUBLISHED = [agent for agent in AGENTS if agent.published]


@pytest.fixture(scope="module")
def table():
    return published()


def rows_of(table, agent):
    """What the catalogue's strings are of: Craftax-classic after 1M steps."""
    return table[(table["agent"] == agent) & (table["task"] == "craftax_classic")]


def test_the_catalogue_has_agents_to_compare_with():
    assert len(PUBLISHED) >= 19 and sum(agent.millions is not None for agent in AGENTS) >= 8


@pytest.mark.parametrize("agent", PUBLISHED, ids=lambda agent: agent.id)
def test_every_published_agent_has_its_numbers(table, agent):
    """Several rows of one agent, in two of the paper's tables, must say the same."""
    rows = rows_of(table, agent.id)
    expected = {}
    for metric in ("reward", "score"):
        if found := re.search(f"{metric} {NUMBER.format(metric)}", agent.published):
            expected[f"{metric}_percent"] = {(float(found[metric]), float(found[f"{metric}_error"]))}
    assert expected.keys() >= {"reward_percent"}
    ours = {
        metric: set(zip(part["value"], part["error"], strict=True))
        for metric, part in rows.groupby("metric", sort=False)
    }
    assert ours == expected
    assert set(rows["error_kind"]) == {"standard error"} and set(rows["seeds"]) == {10}
    assert set(rows["steps"]) == {1_000_000} and set(rows["environment"]) == {"craftax"}


@pytest.mark.parametrize("agent", AGENTS, ids=lambda agent: agent.id)
def test_parameters_are_the_catalogues(table, agent):
    ours = set(rows_of(table, agent.id)["parameters_millions"].dropna())
    assert ours == ({agent.millions} if agent.millions is not None else set())


@pytest.mark.parametrize("agent", PUBLISHED, ids=lambda agent: agent.id)
def test_the_row_that_the_catalogue_names_is_there(table, agent):
    """The source has the catalogue's table, and the method its row's name."""
    where, name = agent.row.split(", ", 1)
    where, name = {"Appendix C": ("Section 4.3", "Annealing")}.get(where, (where, name.split(" (")[0]))
    rows = rows_of(table, agent.id)
    assert any(
        where in source and name in method for source, method in zip(rows["source"], rows["method"], strict=True)
    )


# Task, method, metric, value, error, steps: read by hand in the paper and in what names the literature since.
SPOT = [
    ("craftax_classic", "Human Expert", "reward_percent", 65.0, 10.5, None),
    ("craftax_classic", "Human Expert", "score_percent", 50.5, 6.8, None),
    ("craftax_classic", "Previous best MFRL (Moon et al. 2024)", "score_percent", 15.60, 1.66, 1_000_000),
    ("craftax_classic", "DreamerV3 (Hafner et al. 2023)", "reward_percent", 53.2, 8.0, 1_000_000),
    ("craftax_classic", "Our DreamerV3", "reward_percent", 47.18, 3.88, 1_000_000),
    ("craftax_classic", "IRIS (Micheli et al. 2022)", "score_percent", 6.66, None, 1_000_000),
    ("craftax_classic", "Delta-IRIS (Micheli et al. 2024)", "reward_percent", 35.0, 3.2, 1_000_000),
    ("craftax_classic", "Curious Replay (Kauvar et al. 2023)", "score_percent", 19.4, 1.6, 1_000_000),
    ("craftax_classic", "Annealing the number of policy updates", "reward_percent", 65.71, 1.11, 1_000_000),
    ("craftax_classic", "M5 (fast), reproduced by ITC's authors", "reward_percent", 68.55, 0.72, 1_000_000),
    ("craftax_classic", "M5 (fast), reproduced by ITC's authors", "score_percent", 27.24, 0.86, 1_000_000),
    ("craftax_classic", "3-D RoPE alone", "reward_percent", 71.85, 0.63, 1_000_000),
    ("craftax_classic", "3-D RoPE alone", "score_percent", 33.94, 1.10, 1_000_000),
    ("craftax_classic", "ITC (Identifiable Token Correspondence)", "reward_percent", 72.46, 0.45, 1_000_000),
    ("craftax_classic", "ITC (Identifiable Token Correspondence)", "score_percent", 35.60, 0.92, 1_000_000),
    ("craftax_full", "Prev. SOTA MFRL (PPO-RNN)", "reward_percent", 2.3, None, 1_000_000),
    ("craftax_full", "Prev. SOTA MBRL (Simulus)", "reward_percent", 6.59, 0.22, 1_000_000),
    ("craftax_full", "EASimulus", "reward_percent", 7.23, None, 1_000_000),
    ("craftax_full", "Our best MFRL", "score_percent", 1.22, 0.07, 1_000_000),
    ("craftax_full", "Our best MBRL (slow)", "reward_percent", 7.20, 0.09, 1_000_000),
    ("minatar", "MBRL", "return_normalized_to_mfrl", 2.43, None, 1_000_000),
    ("minatar", "AD (Artificial Dopamine)", "return_normalized_to_mfrl", 0.64, None, 1_000_000),
    ("minatar/asterix", "MBRL", "return", 44.81, 3.54, 1_000_000),
    ("minatar/breakout", "MFRL", "return", 77.8, 2.28, 1_000_000),
    ("minatar/freeway", "MBRL", "return", 71.12, 0.13, 1_000_000),
    ("minatar/space_invaders", "AD (Artificial Dopamine)", "return", 140.36, 1.70, 5_000_000),
    ("minatar/breakout", "ITC (Identifiable Token Correspondence)", "return", 99.53, 2.31, 1_000_000),
    ("craftax_full", "ITC (Identifiable Token Correspondence)", "score_percent", 2.40, 0.04, 1_000_000),
    ("craftax_classic", "ITC (Identifiable Token Correspondence)", "reward_percent", 63.10, 1.24, 500_000),
]


@pytest.mark.parametrize(("task", "method", "metric", "value", "error", "steps"), SPOT)
def test_numbers_read_by_hand(table, task, method, metric, value, error, steps):
    same = (table["task"] == task) & (table["method"] == method) & (table["metric"] == metric)
    row = table[same & (table["steps"] == steps) if steps else same].squeeze(axis=0)
    assert row["value"] == value
    assert pd.isna(row["error"]) if error is None else row["error"] == error
    assert pd.isna(row["steps"]) if steps is None else row["steps"] == steps


def test_all_rows_of_all_tables_are_there(table):
    """The numbers that each table prints, counted by hand; without those in parentheses or of unknown rows."""
    counts = {"Table 1": 2 + 6 * 2 + 3 * 2 + 2 + 1 + 2 + 2 + 1, "Table 2": 12 * 2, "Table 3": 6, "Table 4": 4 * 3}
    paper = table[table["source"].str.contains("2502.01591v3")]["source"]
    assert {name: int(paper.str.contains(name).sum()) for name in counts} == counts


def test_time_and_hardware(table):
    minutes = table.dropna(subset="minutes").drop_duplicates("method").set_index("method")
    of_m5, of_mfrl = minutes.loc["M5: M4 + BTF. Our best MBRL (fast)"], minutes.loc["Our best MFRL"]
    assert (of_m5["minutes"], of_m5["hardware"]) == (759, "8 H100")
    assert (of_mfrl["minutes"], of_mfrl["hardware"]) == (15, "1 A100")
    itc = minutes.loc["ITC (Identifiable Token Correspondence)"]
    assert itc["minutes"] == pytest.approx(48.2 * 60) and (itc["hardware"], itc["seeds"]) == ("1 RTX 3090", 10)


def test_what_is_of_another_environment_or_observation_says_so(table):
    """Else it would be ranked against what it cannot be compared with."""
    paper = table["source"].str.startswith("Dedieu") & (table["method"] != "Human Expert")
    classic = table["task"] == "craftax_classic"
    assert set(table[classic & table["source"].str.contains("as quoted in")]["environment"]) == {"crafter"}
    assert set(table[classic & paper]["environment"]) == {"craftax"}
    assert table.loc[table["environment"] == "crafter", "note"].str.contains("Crafter").all()
    dopamine = table[table["method"].str.startswith("AD ")]
    assert len(dopamine) == 5 and set(dopamine["environment"]) == {"MinAtar (another implementation)"}
    symbolic = set(table[(table["observation"] == "symbolic") & (table["task"] == "craftax_full")]["method"])
    authors = {f"{name} (Craftax's authors)" for name in ("RND", "PPO", "ICM", "E3B")}
    assert symbolic == {"Prev. SOTA MFRL (PPO-RNN)", "Prev. SOTA MBRL (Simulus)", "EASimulus"} | authors


def test_nothing_is_unsourced_or_ours(table):
    assert table["source"].str.contains(r"arXiv \d{4}\.\d{5}").all()
    assert not table["source"].str.contains("http").any()
    assert not table["measured_here"].any()
    by_itc = table[table["source"].str.contains("2605.16457")]
    assert len(by_itc) == 18 and by_itc["source"].str.contains("secondary transcription").all()
    assert by_itc.loc[by_itc["method"] == "3-D RoPE alone", "note"].str.contains("secondary transcription").all()
    # An error without its kind has a note that says why.
    unknown = table[table["error"].notna() & (table["error_kind"] == "")]
    assert unknown["note"].str.contains("kind of error").all()
    assert not table.loc[table["error"].isna(), "error_kind"].any()


def test_the_mean_over_minatar_is_of_its_games(table):
    games = table[(table["metric"] == "return") & (table["steps"] == 1_000_000)]
    ratio = (
        games[games["agent"] == "m5"].set_index("task")["value"]
        / games[games["agent"] == "mfrl"].set_index("task")["value"]
    )
    assert len(ratio) == 4 and round(ratio.mean(), 2) == 2.43


def test_metrics_are_scores_of_their_tasks(table):
    """As `suite compare` names them, so that both can stand in one table."""
    for name in table.loc[table["metric"] != OF_FAMILY, "task"].unique():
        task = registry.task(name)
        assert set(table[table["task"] == name]["metric"]) <= task.scores()([], None, task.spec()).keys()


def test_rows_are_sorted_by_task_and_lines_are_plain(table):
    assert list(table["task"]) == sorted(table["task"])
    text = PATH.read_bytes()
    assert b"\r" not in text and text.endswith(b"false\n")
    assert tuple(table.columns) == COLUMNS
    assert "53.2,8.,," in text.decode()  # numbers as printed
    assert table["note"].map(type).eq(str).all()  # no nan where a source says nothing


def change(column, value):
    """Changes a cell of the third line."""
    return lambda lines: lines[2].__setitem__(COLUMNS.index(column), value)


WRONG = {
    "missing column": (
        lambda lines: [line.pop() for line in lines],
        r"line 1: .*missing \['measured_here'\], extra \[\]",
    ),
    "extra column": (
        lambda lines: [line.append("rank") for line in lines],
        r"line 1: .*missing \[\], extra \['rank'\]",
    ),
    "another order": (lambda lines: lines[0].reverse(), r"line 1: .*in this order: task,method,agent"),
    "a cell too many": (lambda lines: lines[2].append("x"), r"line 3: 19 cells; right: 18"),
    "no value": (change("value", ""), r"line 3: value is empty"),
    "nan": (change("value", "nan"), r"line 3: value is 'nan'; right: a finite number"),
    "infinite": (change("error", "inf"), r"line 3: error is 'inf'; right: a finite number"),
    "no number": (change("minutes", "15 min"), r"line 3: minutes is '15 min'; right: a finite number"),
    "no whole number": (change("steps", "1e6"), r"line 3: steps is '1e6'; right: a whole number"),
    "task": (
        change("task", "craftax_clasic"),
        r"line 3: unknown task 'craftax_clasic'; did you mean 'craftax_classic'\?",
    ),
    "family": (change("task", "minatar"), r"line 3: unknown task 'minatar'"),  # only of a mean over its games
    "agent": (change("agent", "m55"), r"line 3: unknown agent 'm55'; did you mean 'm5'\?"),
    "metric": (change("metric", "reward"), r"line 3: unknown metric 'reward'"),
    "error kind": (
        change("error_kind", "standard eror"),
        r"line 3: unknown error_kind .* did you mean 'standard error'\?",
    ),
    "observation": (change("observation", "pixel"), r"line 3: unknown observation 'pixel'; did you mean 'pixels'\?"),
    "measured here": (change("measured_here", "true"), r"line 3: unknown measured_here 'true'; valid: false"),
    "no source": (change("source", " "), r"line 3: source is empty"),
    "twice": (lambda lines: lines.append(list(lines[2])), r"line \d+: the same .* as in line 3"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_one_line_that_says_where(name, tmp_path):
    with PATH.open(newline="") as file:
        lines = list(csv.reader(file))
    wrong, message = WRONG[name]
    wrong(lines)
    path = tmp_path / "published.csv"
    with path.open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(lines)
    with pytest.raises(UserError, match=message) as found:
        published(path)
    assert str(found.value).startswith(str(path)) and "\n" not in str(found.value)


def test_a_copy_is_read_as_the_file_is(table, tmp_path):
    path = tmp_path / "copy.csv"
    path.write_bytes(PATH.read_bytes())
    pd.testing.assert_frame_equal(published(path), table)
