"""Documents hold what others refer to in them."""

from __future__ import annotations

import itertools
import json
import os
import re
import shlex
import subprocess
import sys
import tomllib

import pandas as pd
import pytest

from suite import cli, registry
from tests.documents import REPOSITORY, code, command_lines

DOCUMENTS = [REPOSITORY / "README.md", REPOSITORY / "CONTRIBUTING.md", *sorted((REPOSITORY / "docs").glob("*.md"))]
FOLDERS = ("suite", "adapters", "baselines", "leaderboards", "tests")


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)
def test_links_lead_somewhere(path):
    links = re.findall(r"\]\(([^)#]+)[^)]*\)", path.read_text())
    missing = [link for link in links if "://" not in link and not (path.parent / link).exists()]
    assert not missing


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)
def test_files_that_are_named_are_there(path):
    """In the style of code; `runs/` and what users write themselves are theirs."""
    named = re.findall(rf"`((?:{'|'.join(FOLDERS)})/[\w/.-]+)`", path.read_text())
    assert not [name for name in named if not (REPOSITORY / name).exists()]


def test_every_fidelity_note_that_is_cited_is_written_down():
    written = set(re.findall(r"^([0-9]+)\. \*\*", (REPOSITORY / "docs" / "fidelity.md").read_text(), re.MULTILINE))
    assert written == {str(number) for number in range(1, 41)}
    cited = {}
    for path in (path for folder in FOLDERS for path in (REPOSITORY / folder).rglob("*.py")):
        for numbers in re.findall(r"\b[Nn]otes? ([0-9]+(?:(?:, | and )[0-9]+)*)", path.read_text()):
            cited |= dict.fromkeys(re.findall("[0-9]+", numbers), path.name)
    assert len(cited) > 20 and not {number: name for number, name in cited.items() if number not in written}


def board(task, metric, preset="small"):
    """Our rows of a preset by agent: mean and standard error, as documents write them; one run has no error."""
    rows = pd.read_csv(REPOSITORY / "leaderboards" / f"{task.replace('/', '_')}.csv", keep_default_na=False)
    rows = rows[(rows.metric == metric) & (rows.overrides == "")]
    rows = rows[(rows.preset == preset) & ((rows["rank"] != "") | (rows.method == "oracle"))]
    return {
        row.agent: f"{float(row.value):.2f}" + (f" +- {float(row.error):.2f}" if row.error else " (one seed)")
        for row in rows.itertuples()
    }


def table(document, begins):
    """The cells of the first table whose heading begins so, by the name in the first column."""
    lines = (REPOSITORY / document).read_text().splitlines()
    start = next(index for index, line in enumerate(lines) if line.startswith(begins))
    heading = [cell.replace("`", "").strip() for cell in lines[start].split("|")[1:-1]]
    rows = itertools.takewhile(lambda line: line.startswith("|"), lines[start + 2 :])
    cells = [[cell.replace("`", "").strip() for cell in row.split("|")[1:-1]] for row in rows]
    return {first: dict(zip(heading[1:], rest, strict=True)) for first, *rest in cells}


def test_what_readme_says_was_measured_is_on_the_boards():
    found = table("README.md", "| agent | what it is |")
    boards = {
        "measured: Craftax-classic, medium": board("craftax_classic", "reward_percent", "medium"),
        "Breakout, medium": board("minatar/breakout", "return", "medium"),
        "tic-tac-toe, small": board("openspiel/tic_tac_toe", "return"),
    }
    shown = {(agent, name): row[name] for agent, row in found.items() for name in boards if row[name]}
    assert len(shown) >= 13
    assert shown == {(agent, name): boards[name][agent] for agent, name in shown}


def test_what_readme_says_was_published_is_in_the_table_of_that():
    rows = pd.read_csv(REPOSITORY / "leaderboards" / "published.csv", keep_default_na=False)
    rows = rows[(rows.task == "craftax_classic") & (rows.metric == "reward_percent") & (rows.agent != "")]
    published = {row.agent: f"{float(row.value):.2f} +- {float(row.error):.2f}" for row in rows.itertuples()}
    shown = {
        agent: row["published: Craftax-classic, 1M steps"]
        for agent, row in table("README.md", "| agent | what").items()
    }
    shown = {agent: value for agent, value in shown.items() if value}
    assert len(shown) >= 6
    assert shown == {agent: published[agent] for agent in shown}


def test_the_table_of_measured_performance_is_the_boards():
    shown = table("docs/performance.md", "| task | `random` |")
    assert len(shown) == 8
    for task, row in shown.items():
        rows = board(task, "reward_percent" if task.startswith("craftax") else "return")
        assert {agent: value for agent, value in row.items() if value} == {
            agent: rows[agent] for agent in row if row[agent]
        }
        assert sum(map(bool, row.values())) >= 4


def test_the_example_of_a_task_and_an_agent_runs(tmp_path):
    """As a distribution of its own, in a process of its own, as a reader would try it."""
    (tmp_path / "corridor.py").write_text(code("docs/extending.md", "python", "# corridor.py"))
    project = tomllib.loads(code("docs/extending.md", "toml", "entry-points"))["project"]
    installed = tmp_path / f"{project['name']}-{project['version']}.dist-info"  # what installing it would leave
    installed.mkdir()
    named = f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    (installed / "METADATA").write_text(named)
    groups = {group: "\n".join(map(" = ".join, entries.items())) for group, entries in project["entry-points"].items()}
    (installed / "entry_points.txt").write_text("".join(f"[{group}]\n{lines}\n" for group, lines in groups.items()))
    (line,) = (line for line in command_lines("docs/extending.md") if "corridor" in line)
    _, *words = shlex.split(line)
    done = subprocess.run(
        [sys.executable, "-m", "suite.cli", *words, "--quiet", "--json", "--out", "runs"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": f"{tmp_path}{os.pathsep}{REPOSITORY}"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1])["status"] == "finished"
    record = json.loads((tmp_path / "runs/corridor/mfrl_curious/smoke/seed_0/record.json").read_text())
    assert record["protocol"]["package_version"] == project["version"]


@pytest.mark.parametrize("line", sorted({line for path in DOCUMENTS for line in command_lines(str(path))}))
def test_commands_in_documents_are_understood(line):
    """Their words and options, and the task, agent, preset and settings that they name; TASK is the reader's own."""
    args = cli.parse(shlex.split(line)[1:])
    if "task" in args and args.task not in ("TASK", "corridor"):
        registry.resolve(args.task, args.agent, args.preset, args.overrides)


def test_evidence_that_readme_compares_is_there():
    (line,) = (line for line in command_lines("README.md") if line.startswith("suite compare"))
    before, agents, behind = re.fullmatch(r"suite compare (.*)\{(.*)\}(.*)", line).groups()
    assert all((REPOSITORY / f"{before}{agent}{behind}" / "seed_0").is_dir() for agent in agents.split(","))
