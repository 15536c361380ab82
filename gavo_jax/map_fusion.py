"""Fusion of frames into a map: depth and colour in a signed distance field, on a sparse grid of voxels.

Open3D does the work (extra `[map]`). Frames are fused one by one (Curless and Levoy 1996; with hashed blocks, as in
Nießner et al. 2013). Memory grows with the surface seen, not with the number of frames.
"""

from collections import Counter, deque
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from jaxtyping import Float

from gavo_jax.bodies.records import without_moving
from gavo_jax.camera import Camera
from gavo_jax.camera_check import require_camera
from gavo_jax.datasets.base import Frame, FrameError, Sequence, require_sequence
from gavo_jax.datasets.rectified import rectified
from gavo_jax.errors import GavoError, as_number
from gavo_jax.libusb import import_open3d
from gavo_jax.map_blocks import BLOCK, MOST_BLOCKS, image_for_blocks
from gavo_jax.number_types import grey_bytes
from gavo_jax.odometry.driver import Moving, Step, seen_moving
from gavo_jax.odometry.overlays import AsTracked
from gavo_jax.scene_map import FARTHEST, VOXEL, SceneMap, Shape, check_shape, check_voxel
from gavo_jax.se3 import is_rigid
from gavo_jax.status import AlignmentStatus
from gavo_jax.trajectory import Trajectory, inverse, require_trajectory, stamp_name

TRUNCATION = 6.0
"""Truncation distance of the field before and behind a surface, voxels."""

OFF_THE_GRID = 1.000001
"""Factor on depth that moves surfaces off the voxels: Open3D cannot tell the sides of one that lies exactly on them."""

MIN_WEIGHT = 3.0
"""More frames than this must have seen a voxel for it to count; fewer where the run has fewer."""


class MapBuilder:
    """Fuses frames with their poses, one by one; it keeps only the field, not the frames."""

    def __init__(self, camera: Camera, voxel: float = VOXEL, farthest: float = FARTHEST) -> None:
        """Make an empty field.

        Args:
            camera: camera of the frames; any lens distortion is removed from every frame.
            voxel: side of a voxel, metres.
            farthest: depth beyond this is left out, metres.

        Raises:
            GavoError: not a camera, voxel size or depth out of range, or Open3D cannot be imported.
        """
        check_voxel(voxel)
        require_camera(camera)
        self._recorded = camera
        self.camera, self.voxel, self.farthest = camera.rectified(), voxel, as_number("farthest", farthest)
        if not 0 < self.farthest < np.inf:
            raise GavoError(f"farthest: must be a positive number of metres, not {farthest:g}")
        self._open3d = import_open3d("map")
        core = self._open3d.core
        self._intrinsic = core.Tensor(self.camera.matrix)
        types = (core.float32, core.float32, core.float32)
        self._grid = self._open3d.t.geometry.VoxelBlockGrid(
            ("tsdf", "weight", "color"), types, ((1), (1), (3)), voxel, BLOCK, 1000, core.Device("CPU:0")
        )
        self.frames, self.is_full = 0, False

    def add(self, frame: Frame, world_T_camera: Float[np.ndarray, "4 4"]) -> None:
        """Fuse one more frame.

        Args:
            frame: frame of the map's camera; its `color` is used if it has one.
            world_T_camera: its pose; the map is in that world, metres.

        Raises:
            FrameError: an image is not of the camera's size, or colour not RGB of bytes.
            GavoError: not a frame, or the pose is not a 4x4 matrix of a rigid motion.
        """
        if not isinstance(frame, Frame):
            raise GavoError(f"expected a Frame, got {type(frame).__name__}: use gavo.Frame(grey, depth, timestamp)")
        image, core = self._open3d.t.geometry.Image, self._open3d.core
        world_T_camera = np.asarray(world_T_camera)
        if world_T_camera.shape != (4, 4) or not is_rigid(world_T_camera):
            raise GavoError("world_T_camera: expected a 4x4 matrix of a rotation and a translation")
        if (color := frame.color) is not None:
            shape = (*np.shape(frame.grey), 3)
            if np.shape(color) != shape or np.asarray(color).dtype != np.uint8:
                found = f"{np.asarray(color).dtype} of shape {np.shape(color)}"
                raise FrameError(f"color image is {found}: expected uint8 of {shape}")
        frame = rectified(frame, self._recorded)
        metres = np.asarray(frame.depth, np.float32) / np.float32(self.camera.depth_scale)
        metres = np.where((metres > 0) & (metres < self.farthest), metres, np.float32(0))
        self.frames += 1
        if not metres.any():
            return
        metres *= np.float32(OFF_THE_GRID)
        seen, matrix = image_for_blocks(metres, self.camera, self.voxel)
        depth, seen, by = image(metres), image(seen), core.Tensor(matrix)
        rgb = np.repeat(grey_bytes(frame.grey)[..., None], 3, axis=2) if frame.color is None else frame.color
        color = image(np.ascontiguousarray(rgb, np.float32))
        extrinsic = core.Tensor(inverse(world_T_camera))
        reach = (1.0, self.farthest, TRUNCATION)
        blocks = self._grid.compute_unique_block_coordinates(seen, by, extrinsic, *reach)
        blocks = self._within_memory(blocks, world_T_camera[:3, 3])
        if len(blocks):
            self._grid.integrate(blocks, depth, color, self._intrinsic, self._intrinsic, extrinsic, *reach)

    def _within_memory(self, blocks: Any, place: Float[np.ndarray, " 3"]) -> Any:
        """Limit the blocks to touch to `MOST_BLOCKS` in all: existing ones, and the nearest new ones."""
        table = self._grid.hashmap()
        room = MOST_BLOCKS - table.size()
        if len(blocks) <= room:
            return blocks
        numbers, known = blocks.numpy(), table.find(blocks)[1].numpy()
        new = numbers[~known]
        if len(new) <= room:
            return blocks
        self.is_full = True
        distances = np.linalg.norm((new + 0.5) * (BLOCK * self.voxel) - place, axis=1)
        nearest = new[np.argsort(distances, kind="stable")[:room]]
        return self._open3d.core.Tensor(np.concatenate([numbers[known], nearest]))

    def extract(self, shape: Shape = "cloud", left_out: Iterable[str] = ()) -> SceneMap:
        """Extract the surface as a cloud or a mesh; empty if nothing was seen often enough.

        Raises:
            GavoError: unknown shape.
        """
        check_shape(shape)
        weight = min(MIN_WEIGHT, max(0.0, self.frames - 1))
        words = [*left_out]
        if self.is_full:
            words.append(f"part of the scene: more than {MOST_BLOCKS} blocks; larger voxels reach further")
        if self.frames == 0 or self._grid.hashmap().size() == 0:
            nothing = np.zeros((0, 3))
            triangles = None if shape == "cloud" else np.zeros((0, 3), int)
            return SceneMap(nothing, nothing.astype(np.uint8), nothing, triangles, self.frames, tuple(words))
        grid = self._grid
        extracted = (grid.extract_point_cloud if shape == "cloud" else grid.extract_triangle_mesh)(weight)
        part = extracted.point if shape == "cloud" else extracted.vertex
        points, colors, normals = (part[name].numpy() for name in ("positions", "colors", "normals"))
        triangles = None if shape == "cloud" else extracted.triangle["indices"].numpy().astype(np.int32)
        colors = np.clip(np.rint(colors), 0, 255).astype(np.uint8)
        return SceneMap(
            points.astype(np.float64), colors, normals.astype(np.float64), triangles, self.frames, tuple(words)
        )


class LiveMap:
    """A map built while tracking, from frames that are available only once: those of the run's first segment.

    It begins with the first frame that the next one can be aligned with.

    Args:
        builder: fuses the frames.
    """

    def __init__(self, builder: MapBuilder) -> None:
        self._builder = builder
        self._reasons: Counter[str] = Counter()
        self._first: tuple[Frame, np.ndarray, int] | None = None
        """The first frame, with its pose and segment, until the next one shows whether it is usable."""
        self._segment: int | None = None
        """Segment of the map; None before it has begun."""

    def watch(self, frame: Frame, step: Step | None) -> None:
        """Process one more frame; `step` is None for the first."""
        if step is None:
            self._first = frame, np.eye(4), 0
            return
        if self._segment is None and step.alignment.status == AlignmentStatus.NO_REFERENCE:
            self._reasons[LOST] += 1  # the frame before
            self._first = frame, step.world_T_camera, step.segment
            return
        if self._segment is None and step.lost:  # the first frame may be at fault: it waits for one that fits it
            self._reasons[LOST] += 1
            return
        self._begin()
        why = _why_not(step)
        if why is None and step.segment != self._segment:
            why = ELSEWHERE
        if why is None:
            self._builder.add(without_moving(frame, step.moving), step.world_T_camera)
        else:
            self._reasons[why] += 1

    def _begin(self) -> None:
        if self._first is not None:
            frame, world_T_camera, self._segment = self._first
            self._builder.add(frame, world_T_camera)
            self._first = None

    def finish(self, shape: Shape) -> SceneMap:
        """Return the map."""
        self._begin()
        return self._builder.extract(shape, _left_out(self._reasons))


LOST, GUESSED, DOUBTED = "lost", "with a guessed pose", "with doubtful depth"
ELSEWHERE, UNREADABLE = "in another segment", "unreadable"


def _why_not(step: Step) -> str | None:
    """Return why a step's frame is left out of its segment's map; None if it isn't."""
    if step.lost:
        return LOST
    return GUESSED if step.origin == "guessed" else None if step.depth_is_trusted else DOUBTED


def _left_out(reasons: Counter[str]) -> list[str]:
    return [f"{count} frame{'s' * (count != 1)}: {why}" for why, count in reasons.items()]


def build_map(
    sequence: Sequence,
    steps: Iterable[Step],
    shape: Shape = "cloud",
    voxel: float = VOXEL,
    farthest: float = FARTHEST,
    trajectory: Trajectory | None = None,
    moving: Moving = seen_moving,
    on_frame: Callable[[], None] = lambda: None,
) -> SceneMap:
    """Fuse the frames of a run into a map, reading them again one at a time.

    The motion between two segments of a run is unknown, so only the segment with the most frames is mapped. Frames that
    were lost, have a guessed pose or doubtful depth, or cannot be read are left out. So are the moving bodies in each
    frame.

    Args:
        sequence: sequence of the run; with `Reading(color=True)` the map has colours, else it is grey.
        steps: steps of the run.
        shape: cloud or mesh.
        voxel: side of a voxel, metres.
        farthest: depth beyond this is left out, metres.
        trajectory: poses to use instead of the steps' own, if loop closures have corrected them.
        moving: gives the mask of moving bodies in a step's frame.
        on_frame: called for each frame.

    Raises:
        GavoError: not a sequence or its steps, unknown shape, voxel size out of range, or Open3D cannot be imported.
    """
    check_shape(shape)
    require_sequence(sequence)
    steps = _steps_of(sequence, steps)
    if trajectory is not None:
        require_trajectory(trajectory)
    frames = AsTracked(sequence, steps)
    corrected = _PosesInOrder(trajectory, float(sequence.timestamps[0]))
    places: list[tuple[int, Step | None, np.ndarray, int]] = [(0, None, np.eye(4), 0)]
    reasons: Counter[str] = Counter()
    for step in steps:
        world_T_camera, segment = corrected.of(step)
        if step.alignment.status is AlignmentStatus.NO_REFERENCE:  # the frames before were unusable
            reasons[LOST] += len(places)
            places.clear()
        if (why := _why_not(step)) is not None:
            reasons[why] += 1
        else:
            places.append((step.index, step, world_T_camera, segment))
    segments = [segment for *_, segment in places]
    chosen = max(set(segments), key=lambda segment: (segments.count(segment), -segment), default=0)
    builder = MapBuilder(sequence.camera.rectified(), voxel, farthest)
    for index, step, world_T_camera, segment in places:
        on_frame()
        if segment != chosen:
            reasons[ELSEWHERE] += 1
            continue
        try:
            frame = frames[index]
            builder.add(frame if step is None else without_moving(frame, moving(step)), world_T_camera)
        except FrameError:
            reasons[UNREADABLE] += 1
    return builder.extract(shape, _left_out(reasons))


def _steps_of(sequence: Sequence, steps: Any) -> list[Step]:
    """Return steps as a list; raises GavoError unless they are those of a run over the sequence."""
    steps = list(steps) if isinstance(steps, Iterable) else [None]
    if not all(isinstance(step, Step) for step in steps):
        raise GavoError("steps: expected the steps of a run, run.steps")
    if steps and max(step.index for step in steps) >= len(sequence):
        raise GavoError(f"steps: of a longer sequence than this one, which has {len(sequence)} frames")
    return steps


class _PosesInOrder:
    """Looks up the poses and segments of steps in a trajectory, in the steps' order.

    Stamps may repeat if a clock was set back.
    """

    def __init__(self, trajectory: Trajectory | None, first: float) -> None:
        self._left: dict[str, deque[tuple[np.ndarray, int]]] = {}
        if trajectory is None:
            return
        for row in zip(trajectory.timestamps, trajectory.world_T_camera, trajectory.segments, strict=True):
            stamp, pose, segment = row
            self._left.setdefault(stamp_name(stamp), deque()).append((pose, int(segment)))
        if len(trajectory) and stamp_name(trajectory.timestamps[0]) == stamp_name(first):
            self._left[stamp_name(first)].popleft()  # the first frame's, which has no step

    def of(self, step: Step) -> tuple[np.ndarray, int]:
        """Return the pose and segment of the next step: the trajectory's, or the step's own."""
        left = self._left.get(stamp_name(step.timestamp))
        has_pose = step.alignment.status is not AlignmentStatus.BAD_TIMESTAMP  # see `run.trajectory_of`
        return left.popleft() if left and has_pose else (step.world_T_camera, step.segment)
