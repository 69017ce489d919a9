"""World models beside reality: what `suite inspect` found, on the page and as a picture of its own."""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

from leaderboards.inspections import SYMBOLS, Filmstrip, InspectedRun, Inspection, comparisons
from leaderboards.page import plots
from leaderboards.page.figures import PageFigure, facts_of
from leaderboards.page.svg import as_file
from suite import registry
from suite.records.record import require_writable
from suite.records.tables import write_whole
from suite.runtime.errors import UserError

HERE = Path(__file__).parent
BEGINNING = "Each model imagines on from real frames, with the actions that followed them."
BOTH = (
    "Left, the share of symbols that a separate network reads rightly off its frames; off the real ones it reads the "
    "most that there can be. Right, squared distance from the real frame, pixels from 0 to 1. Below the first frame "
    "repeated on the left, or above it on the right, a copy of the first frame would have been the better prediction."
)
ERROR_ALONE = (
    "Squared distance from the real frame, pixels from 0 to 1. Above the first frame repeated, a copy of the first "
    "frame would have been the better prediction."
)
ENDING = (
    "Means over runs; shaded, their 95 % bootstrap interval. Runs in one figure begin with the same frames, after as "
    "much training."
)


def figures(inspections: Sequence[Inspection]) -> Iterator[PageFigure]:
    """Of one task: curves of the runs that may be compared, then the filmstrips."""
    for runs in comparisons(inspections):
        counts = Counter(run.agent for run in runs).items()
        caption = f"After {runs[0].trained:,} real steps; runs: {', '.join(f'{n} of {agent}' for agent, n in counts)}."
        yield PageFigure(plots.world_models([("", runs)]), caption, _facts(inspections[0], runs[0]))
    for inspection in inspections:
        if inspection.filmstrip is not None:
            run = max(inspection.runs, key=lambda run: run.trained)
            trained, said = f"after {run.trained:,} real steps", inspection.filmstrip.description
            yield PageFigure(
                _image(inspection.filmstrip), f"A dream beside reality, {trained}. {said}", _facts(inspection, run)
            )


def reading(inspections: Sequence[Inspection]) -> str:
    """How to read a task's curves."""
    symbols = any(SYMBOLS in run.steps for inspection in inspections for run in inspection.runs)
    return f"{BEGINNING} {BOTH if symbols else ERROR_ALONE} {ENDING}"


def _facts(inspection: Inspection, run: InspectedRun) -> dict[str, str | int]:
    return facts_of(registry.task(inspection.task).spec(), run.trained)


def _image(filmstrip: Filmstrip) -> str:
    """An element that holds the picture."""
    (width, height), data = filmstrip.size, base64.b64encode(filmstrip.png).decode()
    attributes = f'width="{width}" height="{height}" alt="Frames of rollouts, the real ones above"'
    return f'<img {attributes} src="data:image/png;base64,{data}">'


def require_picture(path: Path, inspections: Sequence[Inspection]) -> None:
    """Raises a UserError if no picture of these can be written there."""
    if path.suffix != ".svg":
        raise UserError(f"cannot draw {path}: its name must end in .svg")
    if not inspections:
        raise UserError("--plot has nothing to show: no steps.csv of suite inspect in evidence/<task>/inspect/")
    require_writable(path.parent, "--plot")


def write_picture(path: Path, inspections: Sequence[Inspection]) -> None:
    """All curves as an SVG file; see `require_picture`."""
    rows = []
    for task in dict.fromkeys(inspection.task for inspection in inspections):
        for runs in comparisons([inspection for inspection in inspections if inspection.task == task]):
            agents = ", ".join(dict.fromkeys(run.agent for run in runs))
            rows.append((f"{registry.task(task).title}, {runs[0].trained:,} real steps: {agents}", runs))
    colors = (HERE / "page.css").read_text().split("* {", 1)[0]
    write_whole(path, as_file(plots.world_models(rows), colors).encode())
