"""A real clip in every form that a source may have: the drift is that of the PNG folder."""

import time
from collections.abc import Callable
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from written_bags import KINDS, Shot, record
from written_folders import image

from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Sequence
from gavo_jax.datasets.files import Reading
from gavo_jax.datasets.layouts.tum import TumSequence
from gavo_jax.datasets.registry import open_source
from gavo_jax.evaluation import relative_pose_error
from gavo_jax.odometry.run import run_odometry
from gavo_jax.presets import preset
from gavo_jax.trajectory import Trajectory

FRAMES, STRIDE = 19, 2
"""Every other frame of 1.2 seconds: the drift is over one second."""


@pytest.fixture(scope="module")
def clip(data_dir) -> TumSequence:
    return TumSequence(data_dir / "fr1_xyz")[: FRAMES * STRIDE : STRIDE]  # pyright: ignore[reportReturnType]


@pytest.fixture(scope="module")
def shots(clip) -> list[Shot]:
    """The clip's images as they were recorded."""
    found = []
    for entry in clip.entries:
        bgr, depth = cv2.imread(str(entry.color)), cv2.imread(str(entry.depth), cv2.IMREAD_UNCHANGED)
        found.append(Shot(entry.stamp, np.asarray(bgr), np.asarray(depth), entry.depth_stamp))
    return found


@pytest.fixture(scope="module")
def drift(clip) -> Callable[[Sequence], float]:
    """Drift over a second of the trajectory that is found, against the clip's truth."""

    @cache
    def of(sequence: Sequence) -> float:
        assert len(sequence) == FRAMES
        run = run_odometry(sequence, preset("gauss-newton", "fast"))
        assert run.metrics["lost_pairs"] == 0 and clip.ground_truth is not None
        return relative_pose_error(run.trajectory, clip.ground_truth).translation.rmse

    return of


def images(folder: Path, shots: list[Shot], color: str, depth: str) -> Path:
    """A folder in TUM layout, with its images in some form."""
    lists: dict[str, list[str]] = {"rgb": [], "depth": []}
    for shot in shots:
        grey = cv2.cvtColor(shot.bgr, cv2.COLOR_BGR2GRAY)
        pixels = {".jpg": shot.bgr, ".png": shot.bgr, "16.png": np.asarray(grey, np.uint16) * 257}[color]
        raw = {
            ".png": shot.depth,
            ".tiff": (shot.depth / 5000).astype(np.float32),
            ".npy": np.where(shot.depth > 0, shot.depth / 5, np.nan).astype(np.float32),
        }[depth]
        for part, stamp, array, ending in (
            ("rgb", shot.stamp, pixels, color.removeprefix("16")),
            ("depth", shot.depth_stamp, raw, depth),
        ):
            path = f"{part}/{stamp:.6f}{ending}"
            lists[part].append(f"{stamp:.6f} {path}")
            if ending == ".jpg":
                (folder / part).mkdir(parents=True, exist_ok=True)
                cv2.imwrite(str(folder / path), array, [cv2.IMWRITE_JPEG_QUALITY, 90])
            else:
                image(folder / path, array)
    for part, rows in lists.items():
        (folder / f"{part}.txt").write_text("\n".join(rows) + "\n")
    return folder


@pytest.mark.parametrize(
    ("color", "depth", "tolerance"),
    [(".jpg", ".png", 0.15), ("16.png", ".png", 0.03), (".png", ".tiff", 0.03), ("16.png", ".npy", 0.03)],
)
def test_images_of_other_forms(tmp_path, clip, shots, drift, color, depth, tolerance):
    folder = images(tmp_path / "fr1_clip", shots, color, depth)
    sequence = open_source(folder)
    assert sequence.camera == Camera.preset("fr1").rectified()
    assert drift(sequence) == pytest.approx(drift(clip), rel=tolerance)


def recorded(style: str) -> list[tuple[str, str, str]]:
    return [(kind, style, "5000") for kind in KINDS]


@pytest.mark.parametrize(
    ("kind", "style", "unit"),
    [*recorded("raw"), *recorded("compressed"), ("mcap", "jpeg", "5000"), ("ros1", "raw", "metres")],
)
def test_recordings(tmp_path, clip, shots, drift, kind, style, unit):
    """Depth as the benchmark counts it, or as floats in metres."""
    if unit == "metres":
        shots = [shot._replace(depth=(shot.depth / 5000).astype(np.float32)) for shot in shots]
    sequence = open_source(record(tmp_path / "fr1", kind, style, shots, None), Reading(camera="fr1"))
    assert sequence.camera == Camera.preset("fr1").rectified()
    assert drift(sequence) == pytest.approx(drift(clip), rel=0.15 if style == "jpeg" else 0.03)


def test_millimetres_in_a_recording(tmp_path, clip, shots, drift):
    """As cameras write them: in coarser steps than the benchmark's, but still finer than the sensor's."""
    shots = [shot._replace(depth=np.round(shot.depth / 5).astype(np.uint16)) for shot in shots]
    sequence = open_source(record(tmp_path / "fr1", "mcap", "compressed", shots, None), Reading(camera="fr1"))
    assert sequence.camera.depth_scale == 1000
    assert drift(sequence) == pytest.approx(drift(clip), rel=0.03)


def test_a_trajectory_is_the_same_to_the_last_bit(tmp_path, clip, shots):
    """What is lossless loses nothing: raw messages give the frames of the PNG files."""
    sequence = open_source(record(tmp_path / "fr1", "sqlite", "raw", shots[:5], None), Reading(camera="fr1"))
    for ours, theirs in zip(sequence, clip, strict=False):
        np.testing.assert_array_equal(ours.grey, theirs.grey)
        np.testing.assert_array_equal(ours.depth, theirs.depth)
    assert isinstance(clip.ground_truth, Trajectory)


def test_decoding_keeps_up_with_the_png_folder(tmp_path, clip, shots):
    """Processor time for a frame: that of JPEG, and of MCAP, raw or with JPEG, is below that of PNG."""

    def cost(sequence: Sequence) -> float:
        assert sequence[0].grey.size
        times = []
        for _ in range(3):
            start = time.process_time()
            assert sum(1 for frame in sequence if frame.grey.size) == FRAMES
            times.append(time.process_time() - start)
        return min(times)

    sources: list[Sequence] = [open_source(images(tmp_path / "fr1_jpg", shots, ".jpg", ".png"))]
    for style in ("raw", "jpeg"):
        path = record(tmp_path / style, "mcap", style, shots, None)
        sources.append(open_source(path, Reading(camera="fr1")))
    png = cost(clip)
    assert all(cost(source) < png for source in sources)
