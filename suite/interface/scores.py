"""How scores are named: in records, tables, JSON and on screen."""

from __future__ import annotations

PERCENT = "percent"


class ScoreName(str):
    """The name of a score. It is the text that tables and JSON hold, and this says how that is read.

    Words are joined by "_". "percent" is among them where the score goes from 0 to 100. What stands behind a "/" is the
    part that the score is of, such as an achievement in `success_percent/collect_wood`.
    """

    __slots__ = ()

    @classmethod
    def of_part(cls, score: str, part: str) -> ScoreName:
        """The name of a score of one part of a task."""
        return cls(f"{score}/{part}")

    @property
    def is_of_part(self) -> bool:
        """Whether it is a score of one part, of which a task may have dozens."""
        return "/" in self

    @property
    def unit(self) -> str:
        """What stands behind the number: " %", or nothing."""
        return " %" if PERCENT in self.split("_") else ""

    @property
    def words(self) -> str:
        """The name in words, without its unit: "reward", "success basic"."""
        return " ".join(word for word in self.split("_") if word != PERCENT)

    @property
    def heading(self) -> str:
        """The name in words, with its unit: "reward %", "reward % with health"."""
        return " ".join("%" if word == PERCENT else word for word in self.split("_"))
