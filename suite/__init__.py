"""The suite: `suite.make`, `train`, `load` and `results` (`suite.api`); `cli` is the command of that name.

Each folder says in its first line what lives there.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from suite.api import Run, load, make, results, train, train_together

__all__ = ["Run", "load", "make", "results", "train", "train_together"]


def __getattr__(name: str) -> Any:
    """Imports the interface when it is first used: commands such as `suite --help` need none of it."""
    if name in __all__:
        from suite import api

        return getattr(api, name)
    raise AttributeError(f"module 'suite' has no attribute {name!r}")
