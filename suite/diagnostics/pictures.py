"""Curves and pictures of codes, as PNG files that a person can read."""

from __future__ import annotations

import colorsys
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.font_manager import findfont
from PIL import Image, ImageDraw, ImageFont

from suite.interface.tokens import Tokenizer, TokenizerState
from suite.records.tables import write_whole

CODES, CODE_COLUMNS, CODE_SIDE, CAPTION = 128, 16, 56, 16  # codes in a picture; pixels
TEXT, MARGIN = 22, 10  # pixels
INK, PAPER, ALARM = (20, 20, 20), (255, 255, 255), (255, 0, 160)


def save(path: Path, image: Image.Image) -> None:
    """An image as PNG, whole or not at all."""
    content = io.BytesIO()
    image.save(content, "PNG")
    write_whole(path, content.getvalue())


def font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Pillow's own."""
    return ImageFont.load_default(size)


def pages(texts: Sequence[str], least: int) -> np.ndarray:
    """Texts of equally wide letters as pictures, uint8 [N, H, W, 3], all as large as the largest, at least `least`."""
    letters = ImageFont.truetype(findfont("DejaVu Sans Mono"), TEXT)
    probe = ImageDraw.Draw(Image.new("RGB", (1, 1)))
    corners = [probe.multiline_textbbox((MARGIN, MARGIN), text, letters)[2:] for text in texts]
    width, height = (max(least, *(round(corner[i]) + MARGIN for corner in corners)) for i in range(2))
    found = []
    for text in texts:
        page = Image.new("RGB", (width, height), PAPER)
        ImageDraw.Draw(page).multiline_text((MARGIN, MARGIN), text, INK, letters)
        found.append(np.asarray(page))
    return np.stack(found)


def enlarged(image: np.ndarray, scale: int) -> np.ndarray:
    """[H, W, 3] with every pixel a square of `scale` pixels."""
    return image.repeat(scale, 0).repeat(scale, 1)


def as_rgb(frames: np.ndarray, high: int) -> np.ndarray:
    """uint8 [..., H, W, 3] of frames [..., H, W, C]: colors as they are, one channel gray, others a color each."""
    channels, levels = frames.shape[-1], frames.astype(np.float32) / high
    if channels == 1:
        levels = levels.repeat(3, -1)
    elif channels != 3:
        colors = np.array([colorsys.hsv_to_rgb(i / channels, 0.8, 1.0) for i in range(channels)], np.float32)
        levels = (levels[..., None] * colors).max(-2)
    return np.round(255 * levels).astype(np.uint8)


def curves(path: Path, steps: Mapping[str, pd.DataFrame], codes: Mapping[str, pd.DataFrame]) -> None:
    """Errors, symbols, calibration and codebook of runs, one color each.

    Args:
      path: of the PNG.
      steps: by run, the rows of `rollouts.compare`.
      codes: by run, columns "step" and "codes".
    """
    figure = Figure(figsize=(13, 10), layout="constrained")
    (errors, symbols), (events, codebook) = figure.subplots(2, 2)
    known = all("symbols_percent" in rows for rows in steps.values())
    longest = max(steps.values(), key=len)
    for i, (run, rows) in enumerate(steps.items()):
        color = f"C{i}"
        errors.plot(rows.step, rows.error, color=color, marker="o", label=run)
        errors.plot(rows.step, rows.tokenizer_error, color=color, ls=":", label=f"{run}, tokenizer alone")
        if known:
            alone = {"color": color, "ls": ":", "label": f"{run}, tokenizer alone"}
            symbols.plot(rows.step, rows.symbols_percent, color=color, marker="o", label=run)
            symbols.plot(rows.step, rows.tokenizer_symbols_percent, **alone)
        events.plot(rows.step, rows.reward_probability, color=color, marker="o", label=f"reward, {run}")
        events.plot(rows.step, rows.termination_probability, color=color, marker="x", label=f"termination, {run}")
        if run in codes:
            codebook.plot(codes[run].step, codes[run].codes, color=color, label=run)
    repeated = {"color": "gray", "ls": "--", "label": "first frame repeated"}
    errors.plot(longest.step, longest.repeated_error, **repeated)
    if known:
        symbols.plot(longest.step, longest.repeated_symbols_percent, **repeated)
        symbols.plot(longest.step, longest.real_symbols_percent, color="black", label="real frame (extractor's limit)")
    else:
        symbols.text(0.5, 0.5, "this task has no symbols", ha="center", transform=symbols.transAxes)
    for event, marker in (("reward", "o"), ("termination", "x")):
        frequency = longest[f"{event}_frequency"]
        events.plot(longest.step, frequency, color="black", marker=marker, ls="--", label=f"{event}, real")
    if not codes:
        codebook.text(0.5, 0.5, "no run counts its codes", ha="center", transform=codebook.transAxes)
    labels = {
        errors: ("Rollout error", "rollout step", "squared L2 distance per frame, pixels in [0, 1]"),
        symbols: ("Symbol accuracy", "rollout step", "symbols right [%]"),
        events: (
            "Are rewards and ends as likely as they are frequent?",
            "step, real frames given",
            "mean probability, frequency [%]",
        ),
        codebook: ("Codebook", "real environment steps", "codes (of a VQ-VAE: those in use)"),
    }
    for axes, (title, x, y) in labels.items():
        axes.set(title=title, xlabel=x, ylabel=y)
        axes.grid(alpha=0.3)
        if axes is not codebook:
            axes.set_xticks(longest.step[:: max(1, len(longest) // 10)])
        if axes.get_legend_handles_labels()[0]:
            axes.legend(fontsize="small", loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=3)
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=110)
    write_whole(path, content.getvalue())


def code_picture(
    tokenizer: Tokenizer, state: TokenizerState, used: Sequence[int] | np.ndarray, shape: tuple[int, ...], high: int
) -> Image.Image:
    """The first codes of `used`, each with its number.

    Each is placed in the middle of a frame that otherwise has the first code everywhere. Where that changes the middle
    alone, a code is a patch, and the patch is shown; else the middle and what surrounds it.
    """
    codes = np.asarray(used[:CODES], np.int32)
    rows, columns = tokenizer.grid
    middle = (rows // 2) * columns + columns // 2
    tokens = np.full((len(codes), tokenizer.tokens_per_frame), codes[0], np.int32)
    tokens[:, middle] = codes
    frames = np.asarray(tokenizer.decode(state, jnp.asarray(tokens)))
    h, w = math.ceil(shape[0] / rows), math.ceil(shape[1] / columns)
    top, left = (rows // 2) * h, (columns // 2) * w
    elsewhere = np.ones(shape[:2], bool)
    elsewhere[top : top + h, left : left + w] = False
    if (frames[:, elsewhere] == frames[:1, elsewhere]).all():
        crop, title = frames[:, top : top + h, left : left + w], "as patches"
    else:
        crop = frames[:, max(top - h, 0) : top + 2 * h, max(left - w, 0) : left + 2 * w]
        title = f"each placed in the middle of a frame of code {codes[0]}, with what surrounds it"
    images = as_rgb(crop, high)
    scale = max(1, CODE_SIDE // max(images.shape[1:3]))
    width, height = images.shape[2] * scale + 8, images.shape[1] * scale + CAPTION + 8
    picture = Image.new(
        "RGB", (max(CODE_COLUMNS * width, 640) + 8, 30 + height * -(-len(codes) // CODE_COLUMNS)), PAPER
    )
    draw = ImageDraw.Draw(picture)
    draw.text((8, 6), f"{len(codes)} of {len(used)} codes that real frames use, {title}", INK, font(15))
    for i, (code, image) in enumerate(zip(codes, images, strict=True)):
        x, y = 8 + i % CODE_COLUMNS * width, 30 + i // CODE_COLUMNS * height
        picture.paste(Image.fromarray(enlarged(image, scale)), (x, y + CAPTION))
        draw.text((x, y), str(code), INK, font(12))
    return picture
