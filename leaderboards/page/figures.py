"""Figures as the page has them: a picture, what it says, and what it is filtered by."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterable, Mapping

import markupsafe

from leaderboards.boards import sees
from suite.interface.environment import EnvironmentSpec


@dataclasses.dataclass
class PageFigure:
    """Of a section.

    Attributes:
      picture: an `<svg>` or `<img>` element.
      caption: stands below.
      facts: of the runs that it shows, by which it is filtered; none for those of several budgets and sources.
    """

    picture: str
    caption: str
    facts: Mapping[str, str | int] = dataclasses.field(default_factory=dict)

    @property
    def markup(self) -> markupsafe.Markup:
        """The picture, for a template."""
        return markupsafe.Markup(self.picture)


def facts_of(spec: EnvironmentSpec, steps: int) -> dict[str, str | int]:
    """Of runs measured here, of a task and a budget of real steps."""
    return {"origin": "ours", "observation": sees(spec), "steps": steps}


def write_once(figures: Iterable[PageFigure]) -> None:
    """Where figures show the same picture, a family of one game and this game, all but the first refer to the first."""
    figures = list(figures)
    shown = Counter(figure.picture for figure in figures)
    ids: dict[str, str] = {}
    for figure in figures:
        if shown[picture := figure.picture] > 1:
            head, drawn = picture.removesuffix("</svg>").split(">", 1)
            if picture in ids:
                figure.picture = f'{head}><use href="#{ids[picture]}"/></svg>'
            else:
                ids[picture] = f"picture-{len(ids) + 1}"
                figure.picture = f'{head}><g id="{ids[picture]}">{drawn}</g></svg>'
