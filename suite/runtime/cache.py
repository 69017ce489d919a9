"""The user's cache folder: what may be deleted at any time and is then made again."""

from __future__ import annotations

import os
from pathlib import Path

import platformdirs


def cache_dir() -> Path:
    """The environment variable SUITE_CACHE_DIR if set, else the platform's cache folder; it may not exist yet."""
    return Path(os.environ.get("SUITE_CACHE_DIR") or platformdirs.user_cache_dir("suite"))
