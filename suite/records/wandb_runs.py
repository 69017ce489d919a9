"""Curves at Weights & Biases, beside TensorBoard's: one run there for each of ours, however often ours is stopped.

Its own environment variables say the rest: with WANDB_MODE=offline it needs neither a network nor an account, and
`wandb sync` uploads what it wrote.
"""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from suite.configuration.schema import Config
from suite.records.tables import write_whole
from suite.runtime.errors import UserError


def require_wandb() -> Any:
    """The package.

    Raises:
      UserError: it is not installed, or not whole.
    """
    try:
        import wandb
    except ImportError as error:
        raise UserError(f"Weights & Biases is not installed ({error}): pip install -e '.[wandb]'") from error
    return wandb


class WandbRun:
    """A run there. What it keeps here lies in the folder `wandb` of our run's, and with it its id."""

    def __init__(self, folder: Path, config: Config, project: str):
        """Begins it, or goes on with it.

        Args:
          folder: our run's.
          config: our run's.
          project: its name there.

        Raises:
          UserError: the package is not installed, or refuses: no account, or no such project.
        """
        wandb = require_wandb()
        seed = f"seed_{config.seed}"
        group = f"{config.task}/{config.agent}/{config.preset}"  # whose seeds it can average over
        try:
            self._run = wandb.init(
                project=project,
                id=_id(folder / "wandb"),
                resume="allow",
                reinit="create_new",  # of several that go on together each has its own
                name=f"{group}/{seed}",
                group=group,
                config=config.as_dict(),
                dir=folder,
                settings=wandb.Settings(silent=True, console="off", disable_git=True),
            )
        except wandb.Error as error:
            hint = "with WANDB_MODE=offline it needs neither account nor network"
            raise UserError(f"Weights & Biases: {error} ({hint})") from error

    @property
    def place(self) -> str:
        """Where its curves are."""
        return f"`wandb sync {Path(self._run.dir).parent}` uploads it" if self._run.offline else str(self._run.url)

    def append(self, step: int, values: Mapping[str, float]) -> None:
        """One point on each curve."""
        self._run.log(dict(values), step=step)

    def close(self) -> None:
        """Waits until everything is sent."""
        self._run.finish()


def _id(folder: Path) -> str:
    """That of our run, which is kept in its folder."""
    path = folder / "id.txt"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        write_whole(path, secrets.token_hex(4).encode())
    return path.read_text()
