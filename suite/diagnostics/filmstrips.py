"""Filmstrips: real frames above imagined ones, differences outlined, for a person to judge (Section 4.4)."""

from __future__ import annotations

import dataclasses
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw
from PIL.PngImagePlugin import PngInfo

from suite.configuration.schema import PATCH_THRESHOLD
from suite.diagnostics.evaluation_set import EvaluationSet
from suite.diagnostics.pictures import ALARM, INK, PAPER, as_rgb, enlarged, font
from suite.records.tables import write_whole
from suite.tokenizers.patches import patch_grid

FRAME_SIDE = 190  # pixels, about
PER_ROW = 7  # frames side by side; longer strips go on below
HEADER, LABEL, GAP = 22, 22, 6  # pixels
SECONDS = 0.7  # of each frame of a film
SMALL_BYTES, SMALL_FRAMES, SMALL_SIDE, SMALL_GAP = 30_000, 6, 63, 2  # of a filmstrip for a page: at most, and pixels
SMALL_COLORS = (256, 64, 16)


@dataclasses.dataclass(frozen=True)
class Strip:
    """One trajectory, real and imagined.

    Attributes:
      title: what stands above it.
      real: uint8 [T + 1, H, W, C].
      imagined: by run, frames after the first, uint8 [at most T, H, W, C].
      notes: T + 1 of them; what stands above each frame.
      patch, high: of the observations.
    """

    title: str
    real: np.ndarray
    imagined: dict[str, np.ndarray]
    notes: Sequence[str]
    patch: tuple[int, int]
    high: int


def choose(real: EvaluationSet, steps: int, count: int) -> list[int]:
    """Trajectories in which most changes, of those whose episode goes on longest: half with a reward, if there are."""
    steps = min(steps, real.action.shape[1])
    lasts = real.frame_counted[:, :steps].sum(axis=1)
    whole = (lasts == lasts.max()) & (lasts > 0)
    if real.symbols.shape[-1]:  # noise, as of a night, would be the most of what changes in pixels
        seen = real.symbols[:, :steps]
    else:
        seen = real.frames[:, : steps + 1].reshape(*real.frames[:, : steps + 1].shape[:2], -1)
    changes = (seen[:, 1:] != seen[:, :-1]).sum((1, 2))
    order = [int(n) for n in np.argsort(-changes, kind="stable") if whole[int(n)]]
    rewarded = [n for n in order if (real.reward[n, :steps] > 0).any()]
    others = [n for n in order if n not in rewarded]
    chosen = rewarded[: max(count // 2, count - len(others))]
    return chosen + others[: count - len(chosen)]


def differing(frame: np.ndarray, other: np.ndarray, patch: tuple[int, int], high: int) -> list[tuple[int, int]]:
    """Upper left corners of patches of [H, W, C] frames that differ by more than patches of one code may."""
    rows, columns = patch_grid(frame.shape, patch)
    squared = np.square((frame.astype(np.float32) - other) / high).sum(-1)
    corners = [(r * patch[0], c * patch[1]) for r in range(rows) for c in range(columns)]
    return [(y, x) for y, x in corners if squared[y : y + patch[0], x : x + patch[1]].sum() > PATCH_THRESHOLD]


def filmstrip(strip: Strip) -> Image.Image:
    """All frames of a strip: rows of at most `PER_ROW`, real ones first, each run's below."""
    frames = _drawn(strip)
    total, (height, width) = len(strip.real), frames["real"][0].shape[:2]
    across = min(PER_ROW, total)
    block = HEADER + len(frames) * (LABEL + height) + 2 * GAP
    size = (GAP + across * (width + GAP), HEADER + -(-total // PER_ROW) * block)
    picture = Image.new("RGB", (max(size[0], 700), size[1]), PAPER)
    draw = ImageDraw.Draw(picture)
    draw.text((GAP, 3), strip.title, INK, font(15))
    for t in range(total):
        x, y = GAP + t % PER_ROW * (width + GAP), HEADER + t // PER_ROW * block
        draw.text((x, y + 3), strip.notes[t], INK, font(14))
        y += HEADER
        for label, images in frames.items():
            if t % PER_ROW == 0 and t < len(images):
                draw.text((x, y + 2), label, INK, font(14))
            if t < len(images):
                picture.paste(Image.fromarray(images[t]), (x, y + LABEL))
            y += LABEL + height
    return picture


def small_filmstrip(strip: Strip) -> bytes:
    """A PNG for a page: a row of frames as they are, a row for each run below; "Description" in it says which.

    Of a longer trajectory it has some frames, from the first to the last. If that is more than `SMALL_BYTES`, it has
    fewer colours, and then fewer frames.
    """
    rows = [strip.real, *(np.concatenate([strip.real[:1], frames]) for frames in strip.imagined.values())]
    scale = max(1, SMALL_SIDE // max(strip.real.shape[1:3]))
    height, width = (scale * side + SMALL_GAP for side in strip.real.shape[1:3])
    for count in range(min(SMALL_FRAMES, len(strip.real)), 1, -1):
        shown = np.linspace(0, len(strip.real) - 1, count).round().astype(int).tolist()
        picture = Image.new("RGB", (count * width - SMALL_GAP, len(rows) * height - SMALL_GAP), PAPER)
        for y, frames in enumerate(rows):
            for x, t in enumerate(shown):
                if t < len(frames):
                    frame = Image.fromarray(enlarged(as_rgb(frames[t], strip.high), scale))
                    picture.paste(frame, (x * width, y * height))
        text = PngInfo()
        steps, names = ", ".join(map(str, shown)), ", ".join(["real", *strip.imagined])
        text.add_text("Description", f"{strip.title} From left to right steps {steps}; from above {names}.")
        for colors in SMALL_COLORS:
            content = io.BytesIO()
            few = picture.quantize(colors, dither=Image.Dither.NONE)
            few.save(content, "PNG", optimize=True, pnginfo=text)
            if len(content.getvalue()) <= SMALL_BYTES:
                return content.getvalue()
    return content.getvalue()


def film(path: Path, strip: Strip, seconds: float = SECONDS) -> None:
    """The same as an animated GIF: real and imagined frames side by side, each for so many seconds."""
    frames = _drawn(strip)
    height, width = frames["real"][0].shape[:2]
    pages, lines = [], max(note.count("\n") + 1 for note in strip.notes)
    for t in range(len(strip.real)):
        top = HEADER * (1 + lines)
        page = Image.new("RGB", (max(GAP + len(frames) * (width + GAP), 420), top + height + GAP), PAPER)
        draw = ImageDraw.Draw(page)
        draw.text((GAP, 3), strip.notes[t], INK, font(14))
        for i, (label, images) in enumerate(frames.items()):
            x = GAP + i * (width + GAP)
            draw.text((x, top - HEADER), label if t < len(images) else f"{label}: ended", INK, font(14))
            if t < len(images):
                page.paste(Image.fromarray(images[t]), (x, top))
        pages.append(page)
    content = io.BytesIO()
    pages[0].save(
        content, "GIF", save_all=True, append_images=pages[1:], duration=round(1000 * seconds), loop=0, optimize=False
    )
    write_whole(path, content.getvalue())


def _drawn(strip: Strip) -> dict[str, list[np.ndarray]]:
    """By label, enlarged RGB frames; imagined ones begin with the real first frame, and differences are outlined."""
    scale = max(1, round(FRAME_SIDE / max(strip.real.shape[1:3])))
    rows = {"real": strip.real} | {
        run: np.concatenate([strip.real[:1], frames]) for run, frames in strip.imagined.items()
    }
    drawn: dict[str, list[np.ndarray]] = {}
    for label, frames in rows.items():
        drawn[label] = []
        for frame, real in zip(frames, strip.real, strict=False):
            image = Image.fromarray(enlarged(as_rgb(frame, strip.high), scale))
            draw = ImageDraw.Draw(image)
            for y, x in differing(frame, real, strip.patch, strip.high):
                low = ((y + strip.patch[0]) * scale - 1, (x + strip.patch[1]) * scale - 1)
                draw.rectangle((x * scale, y * scale, low[1], low[0]), outline=ALARM, width=max(1, scale // 2))
            drawn[label].append(np.asarray(image))
    return drawn
