"""A film of the search: the particles close in on the motion of each frame while the trajectory grows.

Run it as `python examples/film.py [FILE]`, by default into film.webp; a name that ends in .gif makes a GIF. It needs
the extra `[plot]`. `Odometry` keeps the populations only if told to record them.
"""

import io
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from PIL import Image

import gavo_jax as gavo
from gavo_jax.viewer.search_space import Level, level_of

DARK, PALE, GREEN, BLUE = "#181a20", "#d0d4dc", "#2fcf9a", "#56b4e9"
SECONDS = 0.09
"""Seconds per picture."""


class Moment(NamedTuple):
    """Content of one picture of the film."""

    frame: gavo.Frame
    path: np.ndarray
    """Positions of the camera so far, [n, 3], metres."""
    truth: np.ndarray
    """True positions, [n, 3], metres."""
    level: Level
    generation: int
    title: str
    true_step: np.ndarray
    """True position of the camera in its previous frame, millimetres."""


def moments(frames: int, stride: int) -> Iterator[Moment]:
    """Track the synthetic room; yield every other generation of the first two searches, one per level of later ones."""
    sequence = gavo.SyntheticSequence(frames=frames * stride, color=True)[::stride]
    odometry = gavo.Odometry(sequence.camera, gavo.preset("ga"), record=True)
    world_T_camera, _ = sequence.ground_truth.interpolate(sequence.timestamps)
    seen = np.linalg.inv(world_T_camera[0]) @ world_T_camera
    path = np.zeros((1, 3))
    for i, frame in enumerate(sequence):
        step = odometry.register(frame, frame.timestamp)
        if step is None:
            continue
        path = np.concatenate([path, step.world_T_camera[None, :3, 3]])
        true_step = 1e3 * (np.linalg.inv(seen[i - 1]) @ seen[i])[:3, 3]
        for population in odometry.candidates:
            level = level_of(population)
            if level is None:
                continue
            count = len(level.positions)
            for generation in range(0, count, 2) if i < 3 else (count // 4,):
                title = f"frame {i}   level {int(population.level)}   generation {generation + 1}"
                yield Moment(frame, path, seen[: i + 1, :3, 3], level, generation, title, true_step)


def draw(moment: Moment, room: np.ndarray) -> Image.Image:
    """One picture: the camera's image, the particles, the trajectory from above."""
    figure = Figure(figsize=(9.0, 3.1), dpi=100, facecolor=DARK)
    view, search, above = figure.subplots(1, 3, width_ratios=(4.0, 3.0, 3.0))
    figure.subplots_adjust(left=0.01, right=0.985, bottom=0.16, top=0.89, wspace=0.22)
    image = moment.frame.color if moment.frame.color is not None else moment.frame.grey
    view.imshow(image, cmap="gray", vmin=0, vmax=255, aspect="auto")
    view.set_axis_off()
    view.set_title("what the camera sees", color=PALE, fontsize=9)

    particles = moment.level.positions[moment.generation]
    packed = moment.level.colors[moment.generation]
    colors = np.stack([packed >> 24, packed >> 16 & 255, packed >> 8 & 255], axis=-1) / 255.0
    widest = float(np.quantile(np.abs(moment.level.positions[0] - moment.true_step), 0.9))
    reach = 1.15 * max(widest, 2.0)
    x, y, _ = moment.true_step
    search.scatter(particles[::-1, 0], particles[::-1, 1], s=14, c=colors[::-1], linewidths=0, clip_on=True)
    search.plot(x, y, marker="*", color=GREEN, markersize=11, markeredgewidth=0, linestyle="none")
    search.set(xlim=(x - reach, x + reach), ylim=(y + reach, y - reach))
    search.set_title(moment.title, color=PALE, fontsize=9)
    search.set_xlabel("candidates: x, y (mm)", color=PALE, fontsize=8)

    above.plot(moment.truth[:, 0], moment.truth[:, 2], color=PALE, linewidth=4.0, alpha=0.35)
    above.plot(moment.path[:, 0], moment.path[:, 2], color=BLUE, linewidth=1.6)
    above.plot(*moment.path[-1, [0, 2]], marker="o", color=BLUE, markersize=5)
    above.plot(0, 0, marker="s", color=PALE, markersize=4)
    low, high = room[:, [0, 2]].min(axis=0), room[:, [0, 2]].max(axis=0)
    middle, half = (low + high) / 2, 0.58 * float(np.max(high - low))
    above.set(xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] - half, middle[1] + half))
    above.set_title("trajectory (blue) and truth", color=PALE, fontsize=9)
    above.set_xlabel("x, z (m), from above", color=PALE, fontsize=8)
    for axes in (search, above):
        axes.set_facecolor(DARK)
        axes.tick_params(colors=PALE, labelsize=7)
        axes.locator_params(nbins=5)
        for spine in axes.spines.values():
            spine.set_color("#50555f")
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", facecolor=DARK)
    return Image.open(buffer).convert("RGB")


def main(file: str = "film.webp", frames: int = 26, stride: int = 4) -> list[Image.Image]:
    """Write a film of `frames` frames of the synthetic room, every `stride`-th of its path."""
    gavo.enable_compilation_cache()
    matplotlib.rcParams["font.family"] = "DejaVu Sans"
    shown = list(moments(frames, stride))
    pictures = [draw(moment, shown[-1].truth) for moment in shown]
    first, *rest = pictures
    lossy: dict[str, Any] = {} if file.endswith(".gif") else {"quality": 55, "method": 6}
    first.save(file, save_all=True, append_images=rest, duration=int(1e3 * SECONDS), loop=0, **lossy)
    print(f"{file}: {len(pictures)} pictures, {Path(file).stat().st_size / 1e6:.1f} MB")
    return pictures


if __name__ == "__main__":
    main(sys.argv[1]) if len(sys.argv) > 1 else main()
