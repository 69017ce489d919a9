from __future__ import annotations

from pathlib import Path

import pytest

from suite import cli


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """Commands run in an empty folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(Path(cli.__file__).parents[1]))
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
