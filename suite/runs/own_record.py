"""The record that each of the processes of a run works with."""

from __future__ import annotations

import contextlib
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from suite.configuration.schema import Config
from suite.interface.environment import EnvironmentSpec
from suite.records.record import RunRecord
from suite.runtime import processes
from suite.runtime.errors import UserError


@contextlib.contextmanager
def opened(folder: Path, config: Config, spec: EnvironmentSpec) -> Iterator[RunRecord]:
    """The run's record; in all but the first of several processes a copy, which is thrown away in the end.

    So that every process does what the record tells it to do, and one of them writes.
    """
    with contextlib.ExitStack() as stack:
        if processes.is_first():
            try:
                record = stack.enter_context(RunRecord.open_or_create(folder, config, spec))
            except BaseException:
                processes.votes(False)
                raise
            processes.votes(True)
        else:
            if not all(processes.votes(True)):
                raise UserError("the first process cannot begin, and says why")
            own = Path(stack.enter_context(tempfile.TemporaryDirectory())) / folder.name
            shutil.copytree(folder, own, ignore=shutil.ignore_patterns("checkpoints", "tensorboard", "wandb", "*.lock"))
            record = stack.enter_context(RunRecord.open(own, config, spec))
        processes.votes(True)  # the others have their copies
        yield record
