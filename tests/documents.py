"""What tests read in documents."""

from __future__ import annotations

import json
import re
from pathlib import Path

REPOSITORY = Path(__file__).parents[1]


def code(document: str, language: str, word: str) -> str:
    """The one block of code of that language in a document that holds this word."""
    blocks = re.findall(rf"^```{language}\n(.*?)^```$", (REPOSITORY / document).read_text(), re.MULTILINE | re.DOTALL)
    (block,) = (block for block in blocks if word in block)
    return block


def cells(notebook: str) -> list[str]:
    """The code of a notebook, cell by cell."""
    found = json.loads((REPOSITORY / notebook).read_text())["cells"]
    return ["".join(cell["source"]) for cell in found if cell["cell_type"] == "code"]


def command_lines(document: str) -> list[str]:
    """The `suite ...` lines of a document's indented blocks, without their comments."""
    text = re.sub(r"\\\n +", "", (REPOSITORY / document).read_text())  # a line that goes on in the next one
    lines = re.findall(r"^    (suite .*)$", text, re.MULTILINE)
    return [line.partition("#")[0].strip() for line in lines]
