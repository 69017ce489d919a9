"""Documents hold what others refer to in them."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[1]
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
