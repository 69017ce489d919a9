"""TensorBoard event files, written in this thread: an error in writing (a full disk) is the caller's to see.

tensorboardX's `SummaryWriter` writes from a thread of its own, whose death would block the next call for ever.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path

from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto.event_pb2 import Event, SessionLog
from tensorboardX.summary import scalar


class EventFile:
    """One event file in `folder`. Several may lie side by side; TensorBoard reads them in order of their names."""

    def __init__(self, folder: Path, purge_step: int | None = None):
        """Starts a new file; from `purge_step` on, what earlier files say is hidden."""
        folder.mkdir(parents=True, exist_ok=True)
        number = len(list(folder.iterdir()))
        self._writer = EventsWriter(str(folder / "events"), f".{number:04d}")
        if purge_step is not None:
            self._write(Event(step=purge_step, session_log=SessionLog(status=SessionLog.START)))
        self._writer.flush()

    def append(self, step: int, values: Mapping[str, float]) -> None:
        """One point on each curve."""
        for name, value in values.items():
            self._write(Event(step=step, summary=scalar(name, value)))
        self._writer.flush()

    def close(self) -> None:
        self._writer.close()

    def _write(self, event: Event) -> None:
        event.wall_time = time.time()
        self._writer.write_event(event)
