"""A synthetic RGB-D sequence: a camera that moves through the rendered room, with exact poses and optional noise."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar, overload

import cv2
import numpy as np
from jaxtyping import Float, UInt8, UInt16

from gavo_jax.camera import Camera
from gavo_jax.camera_check import require_camera
from gavo_jax.datasets.base import Frame
from gavo_jax.datasets.rendered.actors import builtin_bodies, turn
from gavo_jax.datasets.rendered.moving import BodyTruth, MovingBody, Scene, body_of_part, build_scene, truths
from gavo_jax.datasets.rendered.rendering import render
from gavo_jax.datasets.rendered.room import (
    HIGHEST_VIEW,
    LOWEST_VIEW,
    MARGIN_X,
    MARGIN_Y,
    free_space,
)
from gavo_jax.datasets.rendered.sensor_noise import KINECT, SensorNoise
from gavo_jax.errors import GavoError, as_number, as_whole, shown
from gavo_jax.image.shutter import row_time
from gavo_jax.trajectory import Trajectory

DEPTH_SCALES = (100.0, 20_000.0)
"""Units per metre in which 16 bits hold depth to a centimetre at least, and three metres at least."""
DEFAULT_CAMERA = Camera(525.0, 525.0, 319.5, 239.5, 640, 480)
"""The factory calibration commonly used for Kinect-like cameras, 640 x 480, no distortion."""
DEFAULT_FRAMES, DEFAULT_RATE = 30, 30.0
BANDS = 60
"""Bands of rows that a rolling shutter exposes one after the other."""

MOST_FRAMES = 1_000_000
"""Largest number of frames: all poses are computed up front and held in memory."""

LARGEST_EXTENT = 50.0
"""Trajectories that reach further than this (m) along an axis are refused: a room has to hold them."""

_HALF_EXTENT, _HEIGHT = (3.0, 2.5), 3.0
_FORWARD, _EYE_LEVEL = 0.45, 1.35
_PATH_STREAM, _EXPOSURE_STREAM, _FRAME_STREAM = range(3)


class SyntheticSequence:
    """A camera moving through a textured, furnished room; exact poses, depth along z, optional sensor noise.

    Frame i depends on the arguments and i alone: not on the order of access, nor on slicing. Frames are rendered on
    demand (the last two are cached). World frame: metres, z up, origin on the floor below the room's middle.

    Args:
        frames: how many; by default 30 on the built-in path, all of a given trajectory (never more than it has).
        seed: of the textures, the noise and the phases of the built-in path; from 0.
        noise: what the sensor adds; `NONE` for exact frames.
        camera: any pinhole camera; frames come undistorted. By default 640 x 480, f = 525, the centre in the middle.
            With a `readout` it has a rolling shutter: rows are rendered from the pose at which they are read.
        trajectory: what to follow instead of the built-in path: a Trajectory or a TUM file (camera to world, z up). It
            is shifted into the room's free middle (the room is enlarged as needed); scale and rotation stay.
        rate: frames per second. By default 30 on the built-in path, and the trajectory's own stamps otherwise.
        speed: the motion is played this many times faster.
        color: also give RGB images; grey is then computed from them as OpenCV does.
        bodies: what moves through the room: bodies with paths of their own (`speed` is the camera's alone), or how many
            of the built-in ones (a box, a walking figure, more boxes). `bodies_truth`, `body_labels` and `part_labels`
            tell where they are; the camera's truth and what the bodies leave of the room are the same without them.

    Raises:
        GavoError: an argument out of range, a body that cannot be, or a trajectory that cannot be read, is empty, not
            finite or too large.
    """

    kind: ClassVar[str] = "rendered room"

    def __init__(
        self,
        frames: int | None = None,
        seed: int = 0,
        noise: SensorNoise = KINECT,
        camera: Camera | None = None,
        trajectory: Trajectory | str | Path | None = None,
        rate: float | None = None,
        speed: float = 1.0,
        color: bool = False,
        bodies: int | Iterable[MovingBody] = (),
    ) -> None:
        frames = None if frames is None else _whole("frames", frames, 1)
        if frames is not None and frames > MOST_FRAMES:
            raise GavoError(f"synthetic: frames: must be at most {MOST_FRAMES}, not {frames}")
        seed = _whole("seed", seed, 0)
        rate, speed = None if rate is None else _positive("rate", rate), _positive("speed", speed)
        if not isinstance(noise, SensorNoise):
            raise GavoError(f"synthetic: noise: expected a SensorNoise, got {shown(noise)}")
        camera = DEFAULT_CAMERA if camera is None else camera
        require_camera(camera)
        self._noise, self._color, self._seed = noise, color, seed
        self._camera = camera.rectified()
        low, high = DEPTH_SCALES
        if not low <= self._camera.depth_scale <= high:
            fault = f"camera.depth_scale: must be from {low:g} to {high:g}, for a room's depth to fit 16 bits, not"
            raise GavoError(f"synthetic: {fault} {self._camera.depth_scale!r}")
        if trajectory is None:
            self._truth = builtin_path(frames or DEFAULT_FRAMES, rate or DEFAULT_RATE, speed, seed)
            self._half_extent, self._height = _HALF_EXTENT, _HEIGHT
        else:
            source = _as_trajectory(trajectory)
            self._truth, self._half_extent, self._height = _fit_room(_play(source, frames, rate, speed))
            source.require_rigid()
        self._selection = np.arange(len(self._truth))
        self._phases = np.random.default_rng([seed, _EXPOSURE_STREAM]).uniform(0, 2 * np.pi, 2)
        if not isinstance(bodies, Iterable):
            bodies = as_whole("synthetic: bodies", bodies)
            bodies = builtin_bodies(bodies, seed, self._truth.world_T_camera[0], self._half_extent)
        self._bodies = tuple(bodies)
        self._bodies_truth = truths(self._bodies, self._truth.timestamps)
        self._keep_last()

    def _keep_last(self) -> None:
        self._render: Callable[[int], Frame] = lru_cache(maxsize=2)(self._render_frame)
        self._expose: Callable[[int], tuple[np.ndarray, ...]] = lru_cache(maxsize=2)(self._expose_frame)

    def __getstate__(self) -> dict[str, Any]:
        """The state without cached frames, which are rendered again on demand."""
        return {name: value for name, value in vars(self).items() if name not in ("_render", "_expose")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore a pickled or copied state with empty frame caches."""
        vars(self).update(state)
        self._keep_last()

    @property
    def name(self) -> str:
        """Always "synthetic"."""
        return "synthetic"

    @property
    def camera(self) -> Camera:
        """The camera that all frames are rendered with; no distortion."""
        return self._camera

    @property
    def ground_truth(self) -> Trajectory:
        """Exact `world_T_camera` of every frame of the whole sequence (slices keep it whole)."""
        return self._truth

    @property
    def timestamps(self) -> Float[np.ndarray, " frames"]:
        """Stamp of each frame, seconds."""
        return self._truth.timestamps[self._selection]

    @property
    def bodies_truth(self) -> tuple[BodyTruth, ...]:
        """Exact poses of every body at every frame of the whole sequence (slices keep it whole)."""
        return self._bodies_truth

    def body_labels(self, index: int) -> UInt8[np.ndarray, "height width"]:
        """Which body each pixel's centre shows in frame `index`: its label, or 0 for the room; IndexError outside."""
        return body_of_part(self._bodies_truth)[self.part_labels(index)]

    def part_labels(self, index: int) -> UInt8[np.ndarray, "height width"]:
        """Which body's rigid part each pixel's centre shows in frame `index`, or 0 for the room; IndexError outside."""
        face = self._expose(int(self._selection[index]))[2]
        return self._scene().label.astype(np.uint8)[face]

    def check(self) -> None:
        """Do nothing: there are no files to check."""

    def __len__(self) -> int:
        return len(self._selection)

    @overload
    def __getitem__(self, index: int) -> Frame: ...
    @overload
    def __getitem__(self, index: slice) -> SyntheticSequence: ...
    def __getitem__(self, index: int | slice) -> Frame | SyntheticSequence:
        """Frame i (arrays are read-only), or a slice of the sequence; IndexError outside."""
        if isinstance(index, slice):
            part = copy.copy(self)
            part._selection = self._selection[index]
            part._render, part._expose = self._render, self._expose
            return part
        return self._render(int(self._selection[index]))

    def __iter__(self) -> Iterator[Frame]:
        return (self[i] for i in range(len(self)))

    def _render_frame(self, i: int) -> Frame:
        """Render frame i of the whole sequence and let the sensor disturb it."""
        exact_grey, exact_depth, face = self._expose(i)
        rng = np.random.default_rng([self._seed, _FRAME_STREAM, i])
        seconds = float(self._truth.timestamps[i] - self._truth.timestamps[0])
        grey = self._noise.disturb_grey(exact_grey, seconds, self._phases, rng)
        depth = self._noise.disturb_depth(exact_depth, float(self._camera.fx), rng)
        color = None
        if self._color:
            color = _to_bytes(grey[..., None] * self._scene().room.faces.tint.astype(np.float32)[face])
            grey = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)
        frame = Frame(
            grey=_to_bytes(grey),
            depth=_to_raw(depth, float(self._camera.depth_scale)),
            timestamp=float(self._truth.timestamps[i]),
            color=color,
        )
        for image in (frame.grey, frame.depth, frame.color):
            if image is not None:
                image.setflags(write=False)
        return frame

    def _scene(self) -> Scene:
        return build_scene(self._seed, self._half_extent, self._height, self._bodies)

    def _expose_frame(self, i: int) -> tuple[np.ndarray, ...]:
        """Exact grey, depth and faces of frame i; with a rolling shutter in bands of rows, each at its moment."""
        camera, scene, stamps = self._camera, self._scene(), self._truth.timestamps
        if not camera.readout:
            return render(scene.at(stamps[i] - stamps[0]), camera, self._truth.world_T_camera[i])
        tops = np.unique(np.linspace(0, camera.height, BANDS + 1).astype(int))
        middles = 0.5 * (tops[:-1] + tops[1:] - 1)
        moments = np.clip(stamps[i] + camera.readout * row_time(middles, camera), stamps[0], stamps[-1])
        poses, _ = self._truth.interpolate(moments, max_gap=math.inf)
        bands = [
            render(scene.at(moment - stamps[0]), replace(camera, cy=camera.cy - top, height=int(bottom - top)), pose)
            for top, bottom, moment, pose in zip(tops[:-1], tops[1:], moments, poses, strict=True)
        ]
        return tuple(np.concatenate(rows) for rows in zip(*bands, strict=True))


def _to_bytes(image: np.ndarray) -> UInt8[np.ndarray, "height width *channels"]:
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def _to_raw(depth: np.ndarray, depth_scale: float) -> UInt16[np.ndarray, "height width"]:
    """Convert metres to raw units; depth that does not fit in 16 bits becomes 0 (no reading)."""
    raw = np.rint(depth * np.float32(depth_scale))
    return np.where(raw <= np.iinfo(np.uint16).max, raw, 0).astype(np.uint16)


def builtin_path(frames: int, rate: float = DEFAULT_RATE, speed: float = 1.0, seed: int = 0) -> Trajectory:
    """A path like that of a handheld camera, a sum of sinusoids: 0.25 m/s and 18 deg/s on average at speed 1.

    Args:
        frames: how many poses.
        rate: poses per second.
        speed: the motion is played this many times faster.
        seed: of the sinusoids' phases.

    Returns:
        `world_T_camera`, stamps from 0 in whole microseconds.
    """
    timestamps = np.round(np.arange(frames) / rate, 6)
    phases = np.random.default_rng([seed, _PATH_STREAM]).uniform(0, 2 * np.pi, (6, 3))

    def wave(row: int, *terms: tuple[float, float]) -> np.ndarray:
        """The sum of (amplitude, period in seconds)."""
        turns = [2 * np.pi * speed * timestamps / period for _, period in terms]
        return sum(
            (terms[k][0] * np.sin(turns[k] + phases[row, k]) for k in range(len(terms))), np.zeros_like(timestamps)
        )

    yaw = np.radians(wave(0, (32, 10.0), (4, 2.3)))
    pitch = np.radians(10 + wave(1, (7, 4.7), (2, 1.7)))
    roll = np.radians(wave(2, (4, 3.9), (1, 1.5)))
    world_T_camera = np.tile(np.eye(4), (frames, 1, 1))
    # camera axes (right, down, forward) in a body frame (forward, left, up)
    body_R_camera = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    world_T_camera[:, :3, :3] = turn(yaw, 2) @ turn(pitch, 1) @ turn(roll, 0) @ body_R_camera
    world_T_camera[:, 0, 3] = _FORWARD + wave(3, (0.18, 5.5), (0.015, 1.1))
    world_T_camera[:, 1, 3] = wave(4, (0.22, 6.3), (0.015, 1.3))
    world_T_camera[:, 2, 3] = _EYE_LEVEL + wave(5, (0.09, 3.9), (0.015, 1.2))
    return Trajectory(timestamps, world_T_camera)


def _whole(name: str, value: Any, least: int) -> int:
    if (whole := as_whole(f"synthetic: {name}", value)) < least:
        raise GavoError(f"synthetic: {name}: must be at least {least}, not {whole}")
    return whole


def _positive(name: str, value: Any) -> float:
    number = as_number(f"synthetic: {name}", value)
    if not (math.isfinite(number) and number > 0):
        raise GavoError(f"synthetic: {name}: must be a number above 0, not {number!r}")
    return number


def _as_trajectory(source: Any) -> Trajectory:
    if isinstance(source, Trajectory):
        return source
    if not isinstance(source, str | Path):
        raise GavoError(f"synthetic: trajectory: expected a Trajectory or a TUM file, got {shown(source)}")
    return Trajectory.read_tum(source)


def _play(source: Trajectory, frames: int | None, rate: float | None, speed: float) -> Trajectory:
    """The trajectory at the frames' stamps: its time runs `speed` times faster, resampled where a rate is given."""
    if len(source) == 0:
        raise GavoError("synthetic: the trajectory is empty")
    if not (np.isfinite(source.timestamps).all() and np.isfinite(source.world_T_camera).all()):
        raise GavoError("synthetic: the trajectory contains values that are not finite")
    stamps, first = np.unique(source.timestamps, return_index=True)
    start = stamps[0]
    played = Trajectory(start + (stamps - start) / speed, source.world_T_camera[first])
    if rate is not None:
        span = played.timestamps[-1] - start
        stamps = np.round(start + np.arange(math.floor(span * rate + 1e-6) + 1) / rate, 6)
        stamps = np.clip(stamps, start, played.timestamps[-1])
        world_T_camera, _ = played.interpolate(stamps, max_gap=math.inf)
        played = Trajectory(stamps, world_T_camera)
    return Trajectory(played.timestamps[:frames], played.world_T_camera[:frames])


def _fit_room(path: Trajectory) -> tuple[Trajectory, tuple[float, float], float]:
    """Shift a path into the free middle of a room; also the half extent and height (m) that the room needs for it."""
    positions = path.world_T_camera[:, :3, 3]
    low, high = positions.min(axis=0), positions.max(axis=0)
    extent = high - low
    if extent.max() > LARGEST_EXTENT:
        raise GavoError(
            f"synthetic: the trajectory spans {extent.max():.1f} m; the largest room is for {LARGEST_EXTENT:g} m"
        )
    need = np.ceil(10 * extent + 1) / 10
    half_extent = (max(_HALF_EXTENT[0], need[0] / 2 + MARGIN_X), max(_HALF_EXTENT[1], need[1] / 2 + MARGIN_Y))
    height = max(_HEIGHT, LOWEST_VIEW + need[2] + HIGHEST_VIEW)
    lowest, highest = free_space(half_extent, height)
    middle = np.array([0.0, 0.0, _EYE_LEVEL])
    middle = np.clip(middle, lowest + extent / 2, highest - extent / 2)
    world_T_camera = path.world_T_camera.copy()
    world_T_camera[:, :3, 3] += middle - (low + high) / 2
    return Trajectory(path.timestamps, world_T_camera), (float(half_extent[0]), float(half_extent[1])), float(height)
