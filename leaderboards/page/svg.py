"""matplotlib's SVG in a fraction of the bytes: the same picture, to a tenth of a point."""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Iterator, Mapping
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from matplotlib.figure import Figure

SVG, HREF = "{http://www.w3.org/2000/svg}", "{http://www.w3.org/1999/xlink}href"


def svg_of(figure: Figure, description: str, colors: Mapping[str, str]) -> str:
    """A figure as an `<svg>` element for an HTML page, which needs nothing besides the page's style.

    Nothing is clipped: a figure's axes must have room for all that is drawn in them.

    Args:
      figure: drawn on transparent ground.
      description: for those who do not see it.
      colors: what each colour is called on the page.
    """
    for artist in figure.findobj():
        artist.set_clip_on(False)
    for patch in (figure.patch, *(axes.patch for axes in figure.axes)):
        patch.set_visible(False)
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None, "Format": None})
    root = ElementTree.fromstring(buffer.getvalue())
    drawn = {element.get("id"): element for element in root.iter(f"{SVG}path")}
    whole = Element("svg", {"viewBox": root.get("viewBox", ""), "role": "img", "aria-label": description})
    whole.extend(_simplified(root, drawn))
    text = ElementTree.tostring(whole, encoding="unicode", short_empty_elements=True).replace(" />", "/>")
    for color, name in colors.items():
        text = text.replace(color, name)
    return text


def as_file(svg: str, style: str) -> str:
    """The same element as a file of its own, on the page's paper.

    Args:
      svg: of `svg_of`.
      style: CSS that says what the names of the page's colours mean.
    """
    text = "text { font-family: system-ui, sans-serif; } path { stroke-linejoin: round; }"
    paper = '<rect width="100%" height="100%" style="fill: var(--paper)"/>'
    head, drawn = svg.split(">", 1)
    return f'{head} xmlns="http://www.w3.org/2000/svg"><style>{style}{text}</style>{paper}{drawn}\n'


def _simplified(parent: Element, drawn: Mapping[str | None, Element]) -> Iterator[Element]:
    """What a part of the picture shows: groups opened, and paths that are referred to put where they are drawn."""
    for element in parent:
        tag = element.tag.removeprefix(SVG)
        if tag == "use":
            path, place = drawn[element.get(HREF, "#")[1:]], (float(element.get("x", 0)), float(element.get("y", 0)))
            style = f"{element.get('style', '')};{path.get('style', '')}"
            yield Element("path", {"d": _short_path(path.get("d", ""), place), "style": _style(style)})
        elif tag == "path":
            yield Element("path", {"d": _short_path(element.get("d", "")), "style": _style(element.get("style", ""))})
        elif tag == "text":
            names = ("style", "x", "y", "transform")
            found = {name: _rounded(value) for name in names if (value := element.get(name)) is not None}
            found["style"] = _style(found.get("style", ""))
            if found.get("transform", "").startswith("rotate(-0 "):
                del found["transform"]
            text = Element("text", found)
            text.text = element.text
            yield text
        elif tag == "g":  # definitions and metadata, the rest, are not drawn
            assert element.get("transform") is None, "a formula: these are not simplified"
            parts = _simplified(element, drawn)
            yield from _joined(parts) if element.get("id", "").startswith("matplotlib.axis") else parts


def _joined(elements: Iterable[Element]) -> list[Element]:
    """Of an axis: its lines of one style as one path."""
    paths: dict[str, Element] = {}
    others = []
    for element in elements:
        if element.tag != "path":
            others.append(element)
        elif (first := paths.setdefault(element.get("style", ""), element)) is not element:
            first.set("d", first.get("d", "") + element.get("d", ""))
    return [*paths.values(), *others]


def _style(style: str) -> str:
    """The last word on each property, but for the font: the page has its own."""
    pairs = (part.split(":", 1) for part in style.split(";") if part.strip())
    words = {name.strip(): value.strip() for name, value in pairs}
    return "; ".join(f"{name}: {value}" for name, value in words.items() if name != "font-family")


def _rounded(text: str) -> str:
    return re.sub(r"-?[0-9]+\.[0-9]+", lambda number: _short(float(number[0])), text)


def _short(value: float) -> str:
    return f"{value:z.1f}".removesuffix(".0")


def _short_path(path: str, place: tuple[float, float] = (0, 0)) -> str:
    """A path moved to a place; of lines alone, each point as its distance from the one before: that is fewer digits."""
    parts = re.findall(r"([A-Za-z])([^A-Za-z]*)", path)
    moved = [(command, np.array(points.split(), float).reshape(-1, 2) + place) for command, points in parts]
    if not re.fullmatch("ML+[Zz]?", "".join(command for command, _ in parts)):
        return "".join(command + _numbers(points) for command, points in moved)
    points = np.concatenate([points for _, points in moved]).round(1)
    return f"M{_numbers(points[:1])}l{_numbers(np.diff(points, axis=0))}{'z' if parts[-1][0] in 'Zz' else ''}"


def _numbers(points: np.ndarray) -> str:
    return " ".join(map(_short, points.flat)).replace(" -", "-")
