"""Robustness to other light, lenses, sensors, image sizes and frame rates, none of which is a fault.

Every frame of a clip is changed as if another camera or room had produced it. Only the camera moves in the clips, so
bodies are false alarms. Prints for each clip and condition:

- the share of the pairs that are not ok at the end of the run;
- how many pairs are off by more than 5 cm or 3 degrees, and how many of these are ok;
- the share of the images in which a body was found;
- drift (RPE over 1 s, RMSE; a dash where no segment is that long), also over the unchanged clip's at the same frames.

    python benchmarks/conditions.py
    python benchmarks/conditions.py --conditions "bands of 4 %,vignette" --method gauss-newton --json conditions.json

On 2 cores the defaults take about 10 minutes.
"""

import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import common
import cv2
import numpy as np
from faults import Damaged, every_frame, follow, is_wrong, known_drift

from gavo_jax.camera import Camera, vignetting_gain
from gavo_jax.datasets.base import Frame
from gavo_jax.datasets.base import Sequence as FrameSequence
from gavo_jax.output.screen import number
from gavo_jax.trajectory import Trajectory

AS_IT_IS = "as it is"
RESTING = 20
"""Frames for which a camera rests."""

Image = np.ndarray
Grey = Callable[[int, Image], Image]
"""Changes the grey levels of a frame, as floats, given its index and them."""
Condition = Callable[[FrameSequence], Damaged]


def grey(make: Grey) -> Condition:
    """Change all grey images."""

    def alter(_: FrameSequence, index: int, frame: Frame) -> Frame:
        return replace(frame, grey=rounded(make(index, frame.grey.astype(np.float32))))

    return every_frame(alter)


def rounded(levels: Image) -> Image:
    """Grey levels as an image of 8 bits."""
    return np.clip(np.round(levels), 0, 255).astype(np.uint8)


def depth(make: Callable[[int, Image], Image]) -> Condition:
    """Change all depth images, in the clip's unit; 0 is no reading."""
    return every_frame(lambda _, index, frame: replace(frame, depth=make(index, frame.depth).astype(np.uint16)))


def frames(chosen: Callable[[int], bool]) -> Condition:
    """Keep only some of the frames."""
    return lambda clip: Damaged(clip, [index for index in range(len(clip)) if chosen(index)])


def rested(clip: FrameSequence) -> Damaged:
    """Let the camera rest before its first frame: the frame again and again, with other noise of image and depth."""
    sequence = Damaged(clip, [0] * RESTING + list(range(len(clip))))
    sequence.timestamps[:RESTING] -= np.arange(RESTING, 0, -1) / 30
    sequence.alter = {seed: partial(noisy, seed) for seed in range(RESTING)}
    return sequence


def noisy(seed: int, clip: FrameSequence, index: int, frame: Frame) -> Frame:
    """Add a sensor's noise to both images."""
    del clip, index
    generator = random(seed)
    levels = frame.grey + generator.normal(0.0, 1.2, frame.grey.shape)
    raw = np.where(frame.depth > 0, frame.depth + generator.integers(-8, 9, frame.depth.shape), 0)
    return replace(frame, grey=rounded(levels), depth=raw.astype(frame.depth.dtype))


def gain(of_place: Callable[[int, Image, Image], Image]) -> Condition:
    """Apply a gain to each pixel, given the frame's index and the pixel's column and row from -1 to 1."""

    def shone(index: int, levels: Image) -> Image:
        height, width = levels.shape
        rows, columns = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
        return levels * of_place(index, columns, rows)

    return grey(shone)


def with_camera(camera_of: Callable[[Camera], Camera], grey: Callable, depth: Callable) -> Condition:
    """Change the size of all images, and their camera with it."""
    images = every_frame(lambda _, index, frame: replace(frame, grey=grey(frame.grey), depth=depth(frame.depth)))

    def change(clip: FrameSequence) -> Damaged:
        sequence = images(clip)
        sequence.camera = camera_of(clip.camera)
        return sequence

    return change


def vignette(is_known: bool) -> Condition:
    """Darken the image away from its middle as lenses do, by 45 % in its corners; the camera says so, or does not."""

    def change(clip: FrameSequence) -> Damaged:
        lens = replace(clip.camera, vignetting=(1.2, 0.36))
        sequence = grey(lambda _, levels: levels / vignetting_gain(lens))(clip)
        sequence.camera = lens if is_known else clip.camera
        return sequence

    return change


def random(index: int) -> np.random.Generator:
    """Random generator of a frame."""
    return np.random.default_rng(index)


def jpeg(index: int, levels: Image) -> Image:
    """Compress an image as JPEG of quality 30, and decode it."""
    coded = cv2.imencode(".jpg", levels, [cv2.IMWRITE_JPEG_QUALITY, 30])[1]
    return np.asarray(cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE))


def blurred(sigma: float, levels: Image) -> Image:
    """Blur an image by `sigma` pixels, as out of focus."""
    return cv2.GaussianBlur(levels, (0, 0), sigma)


def bands(amplitude: float) -> Condition:
    """Bands of a lamp that flickers while rows are exposed, with another phase in every frame."""
    return gain(lambda index, columns, rows: 1.0 + amplitude * np.sin(2.0 * np.pi * rows + 2.1 * index))


def without_edges(index: int, raw: Image) -> Image:
    """Remove depth along its edges."""
    steps = np.abs(cv2.Laplacian(raw.astype(np.float32), cv2.CV_32F)) > 300
    return np.where(cv2.dilate(steps.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0, 0, raw)


def interpolated(index: int, raw: Image) -> Image:
    """Shift depth by 0.4 pixels with linear interpolation, as if undistorted by someone who forgot about its edges."""
    return cv2.warpAffine(raw.astype(np.float32), np.array([[1, 0, 0.4], [0, 1, 0.4]]), raw.shape[::-1])


def upsampled(index: int, raw: Image) -> Image:
    """Depth of a camera of 256 columns, interpolated to the size of the image."""
    small = cv2.resize(raw.astype(np.float32), (256, 192), interpolation=cv2.INTER_NEAREST)
    return cv2.resize(small, raw.shape[::-1], interpolation=cv2.INTER_LINEAR)


def halved(camera: Camera) -> Camera:
    """The camera of images half as large along each side."""
    fx, fy, cx, cy = camera.scaled(0.5)
    return replace(camera, fx=fx, fy=fy, cx=cx, cy=cy, width=camera.width // 2, height=camera.height // 2)


def cropped(camera: Camera) -> Camera:
    """The camera of the middle quarter of its images; half of the rows take half of the readout."""
    width, height = camera.width // 2, camera.height // 2
    cx, cy = camera.cx - width // 2, camera.cy - height // 2
    return replace(camera, cx=cx, cy=cy, width=width, height=height, readout=camera.readout / 2)


def middle(image: Image) -> Image:
    """The middle quarter of an image."""
    height, width = (size // 2 for size in image.shape)
    return image[height // 2 : height // 2 + height, width // 2 : width // 2 + width].copy()


def smaller(image: Image) -> Image:
    """An image half as large along each side."""
    return cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)


CONDITIONS: dict[str, Condition] = {
    AS_IT_IS: every_frame(lambda clip, index, frame: frame),
    "noise of 10 levels": grey(lambda index, levels: levels + random(index).normal(0.0, 10.0, levels.shape)),
    "JPEG 30": grey(jpeg),
    "16 grey levels": grey(lambda index, levels: np.floor(levels / 16) * 16),
    "blurred by 2 pixels": grey(lambda index, levels: blurred(2.0, levels)),
    "blurred by 4 pixels": grey(lambda index, levels: blurred(4.0, levels)),
    "every second blurred": grey(lambda index, levels: blurred(3.0, levels) if index % 2 else levels),
    "a tenth of the light": grey(lambda index, levels: 0.1 * levels),
    "twice the light": grey(lambda index, levels: 2.0 * levels),
    "overexposed flicker of 20 %": grey(lambda index, levels: 1.4 * levels * (1.0 + 0.2 * np.sin(2.1 * index))),
    "gamma 0.5": grey(lambda index, levels: 255 * (levels / 255) ** 0.5),
    "gamma 2": grey(lambda index, levels: 255 * (levels / 255) ** 2),
    "a slow fade": grey(lambda index, levels: levels * 0.93 ** np.clip(index - 20, 0, 15)),
    "flicker of 20 %": grey(lambda index, levels: levels * (1.0 + 0.2 * np.sin(2.1 * index))),
    "bands of 4 %": bands(0.04),
    "bands of 8 %": bands(0.08),
    "bands of 15 %": bands(0.15),
    "a lamp that blinks": gain(
        lambda index, columns, rows: 0.7 + 0.4 * (index // 4 % 2) * np.exp(-5 * ((columns + 0.4) ** 2 + rows**2))
    ),
    "a shadow that passes": gain(
        lambda index, columns, rows: 1 - 0.4 / (1 + np.exp(16 * np.abs(columns + 1.3 - 0.04 * (index % 65)) - 5))
    ),
    "vignette": vignette(is_known=False),
    "a known vignette": vignette(is_known=True),
    "shade": gain(lambda index, columns, rows: 1 - 0.3 / (1 + np.exp(5 * columns + 1.6 * np.sin(0.1 * index)))),
    "black bars": gain(lambda index, columns, rows: np.abs(rows) < 0.75),
    "noisy depth": depth(
        lambda index, raw: np.where(raw > 0, raw + random(index).normal(0, 6e-7, raw.shape) * np.float64(raw) ** 2, 0)
    ),
    "a third without depth": depth(lambda index, raw: np.where(random(index).random(raw.shape) < 0.3, 0, raw)),
    "depth in centimetres": depth(lambda index, raw: raw // 50 * 50),
    "depth without edges": depth(without_edges),
    "depth interpolated": depth(interpolated),
    "depth of 256 columns": depth(upsampled),
    "half size": with_camera(halved, smaller, lambda image: image[::2, ::2].copy()),
    "middle quarter": with_camera(cropped, middle, middle),
    "every second": frames(lambda index: index % 2 == 0),
    "every third": frames(lambda index: index % 3 == 0),
    "at rest at first": rested,
    "a tenth missing": frames(lambda index: index == 0 or random(index).random() > 0.1),
}


def measure(
    clip: FrameSequence, truth: Trajectory, condition: str, contender: common.Contender, clean: Trajectory | None
) -> tuple[dict[str, Any], Trajectory]:
    """Figures and trajectory of one run; `clean` is the unchanged clip's trajectory, None if this run makes it."""
    sequence = CONDITIONS[condition](clip)
    steps, trajectory = follow(sequence, contender, 0)
    stamps = np.intersect1d(sequence.timestamps, clip.timestamps)
    drift_of = partial(known_drift, stamps=stamps, truth=truth)
    metres, before = drift_of(trajectory), drift_of(trajectory if clean is None else clean)
    wrong = [step.alignment.status == 0 for step in steps if is_wrong(step, sequence, truth)]
    row = {
        "flagged": float(np.mean([step.alignment.status != 0 for step in steps])),
        "wrong": len(wrong),
        "silent": sum(wrong),
        "bodies": float(np.mean([bool(step.bodies) for step in steps])),
        "drift": metres,
        "ratio": metres / before if metres and before else None,
    }
    return row, trajectory


def main(
    clips: str = common.CLIPS, method: str = "ga:fast", conditions: str = ",".join(CONDITIONS), json: Path | None = None
) -> dict[str, Any]:
    """Measure, print and return the figures.

    Args:
        clips: comma-separated clips with ground truth in which only the camera moves; see `common.open_clip`.
        method: METHOD or METHOD:PRESET.
        conditions: comma-separated names; the unchanged clip always comes first.
        json: file for the figures.
    """
    contender, rows, cells = common.parse_methods(method)[0], [], []
    chosen = [name for name in common.names_among(CONDITIONS, "condition", conditions) if name != AS_IT_IS]
    for clip in common.names(clips):
        sequence, truth = common.open_true_clip(clip)
        clean = None
        for name in (AS_IT_IS, *chosen):
            row, trajectory = measure(sequence, truth, name, contender, clean)
            clean = trajectory if name == AS_IT_IS else clean
            rows.append({"clip": clip, "condition": name, **row})
            print(f"{clip} {name}: {row['flagged']:.0%} flagged", file=sys.stderr)
            shares = [f"{row['flagged']:.1%}", f"{row['silent']} of {row['wrong']}", f"{row['bodies']:.0%}"]
            cells.append([clip, name, *shares, number(row["drift"], 4), number(row["ratio"], 2)])
    columns = ("clip", "condition", "flagged", "wrong and ok", "bodies", "m/s", "drift / as it is")
    common.print_table(f"nothing wrong, {contender.name}", columns, cells)
    wrong, silent = sum(row["wrong"] for row in rows), sum(row["silent"] for row in rows)
    common.tell(f"{silent} of {wrong} wrong pairs are ok")
    results = {"method": method, "conditions": rows}
    common.record(json, "conditions", results)
    return results


if __name__ == "__main__":
    common.command(main)
