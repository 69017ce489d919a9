"""The user's cache folder: what may be deleted at any time and is then made again."""

from __future__ import annotations

import contextlib
import os
import zipfile
import zlib
from pathlib import Path
from typing import TYPE_CHECKING

import platformdirs

if TYPE_CHECKING:
    import numpy as np


def cache_dir() -> Path:
    """The environment variable SUITE_CACHE_DIR if set, else the platform's cache folder; it may not exist yet."""
    return Path(os.environ.get("SUITE_CACHE_DIR") or platformdirs.user_cache_dir("suite"))


def read_arrays(path: Path) -> dict[str, np.ndarray] | None:
    """The arrays of an .npz file; None if there is none, or it is broken and must be made again."""
    import numpy as np

    broken = OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error
    with contextlib.suppress(*broken), path.open("rb") as file, np.load(file) as stored:
        return dict(stored)
    return None
