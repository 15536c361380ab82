"""A map of what a run saw: depth and colour fused into a signed distance field, out of which come a cloud or a mesh.

Open3D does the work (extra `[map]`): a sparse grid of voxels (Curless and Levoy 1996; blocks in a hash map, as of
Nießner et al. 2013), into which frames go one by one, so that memory grows with the surface seen, not with the frames.
"""

import contextlib
import os
import warnings
from collections import Counter, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int, UInt8

from gavo_jax.bodies.records import without_moving
from gavo_jax.camera import Camera, require_camera
from gavo_jax.datasets.base import Frame, FrameError, Sequence, require_sequence
from gavo_jax.datasets.rectified import rectified
from gavo_jax.errors import GavoError, GavoWarning, partial_of
from gavo_jax.image.numbers import grey_bytes
from gavo_jax.libusb import import_open3d
from gavo_jax.map_blocks import BLOCK, MOST_BLOCKS, image_for_blocks
from gavo_jax.odometry.drawn import AsTracked
from gavo_jax.odometry.driver import Moving, Step, seen_moving
from gavo_jax.se3 import is_rigid
from gavo_jax.status import AlignmentStatus
from gavo_jax.trajectory import Trajectory, inverse, stamp_name

Shape = Literal["cloud", "mesh"]

ENDINGS: dict[str, tuple[Shape, ...]] = {".ply": ("cloud", "mesh"), ".pcd": ("cloud",), ".obj": ("mesh",)}
"""What a file of each ending can hold; the first is written where nothing is said."""

LARGEST = {".ply": (51, 13), ".pcd": (28, 0), ".obj": (120, 70)}
"""Bytes that a point or vertex, and a triangle, take at most in a file of each ending."""

VOXEL = 0.01
"""Metres."""
SMALLEST_VOXEL, LARGEST_VOXEL = 1e-3, 1.0

TRUNCATION = 6.0
"""Voxels before and behind a surface that know their distance from it."""

FARTHEST = 4.0
"""Metres: beyond, the noise of a structured-light or stereo camera exceeds several voxels."""

OFF_THE_GRID = 1.000001
"""Factor on depth: a surface that lies exactly on voxels would have no side for Open3D."""

MIN_WEIGHT = 3.0
"""Frames that must have seen a voxel for it to count; fewer where the run has fewer."""


@dataclass(frozen=True, eq=False)
class SceneMap:
    """What a run saw, in its world: that of the first camera of its segment, metres.

    Attributes:
        points: of the cloud, or the vertices of the mesh.
        colors: RGB of each; grey where the sequence was opened without colour.
        normals: unit vectors, towards where the camera was.
        triangles: three indices of vertices each; None of a cloud.
        frames: that went into it.
        left_out: why others did not, one line each.
    """

    points: Float[np.ndarray, "n 3"]
    colors: UInt8[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    triangles: Int[np.ndarray, "t 3"] | None = None
    frames: int = 0
    left_out: tuple[str, ...] = ()

    @property
    def shape(self) -> Shape:
        """What it is."""
        return "cloud" if self.triangles is None else "mesh"

    def write(self, path: str | Path) -> None:
        """Write it, whole or not at all: a cloud as `.ply` or `.pcd`, a mesh as `.ply` or `.obj`.

        Raises:
            GavoError: another ending, there is nothing in it, or the file cannot be written.
        """
        path = Path(path)
        check_map(path, self.shape)
        if len(self.points) == 0:
            raise GavoError(f"{path}: not written: nothing nearer than {FARTHEST:g} m was seen often enough for a map")
        open3d = import_open3d("map")
        vector = open3d.utility.Vector3dVector
        partial = path.with_name(partial_of(path).name + path.suffix.lower())  # which Open3D goes by
        if self.triangles is None:
            cloud: Any = open3d.geometry.PointCloud(vector(self.points))
            cloud.colors, cloud.normals = vector(self.colors / 255.0), vector(self.normals)
            write = open3d.io.write_point_cloud
        else:
            cloud = open3d.geometry.TriangleMesh(vector(self.points), open3d.utility.Vector3iVector(self.triangles))
            cloud.vertex_colors, cloud.vertex_normals = vector(self.colors / 255.0), vector(self.normals)
            write = open3d.io.write_triangle_mesh
        try:
            partial.unlink(missing_ok=True)
            _take_room(partial, len(self.points), 0 if self.triangles is None else len(self.triangles))
            with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
                written = write(str(partial), cloud)
            if not written:
                raise OSError("Open3D could not write it")
            partial.replace(path)
        except OSError as error:
            with contextlib.suppress(OSError):
                partial.unlink(missing_ok=True)
            raise GavoError(f"{path}: cannot be written: {error.strerror or error}") from None


def _take_room(path: Path, points: int, triangles: int) -> None:
    """Make a file that is as large as a map's, where the system can; Open3D does not notice a full disk.

    Raises:
        OSError: there is no room.
    """
    of_point, of_triangle = LARGEST[path.suffix]
    with path.open("xb") as file:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(file.fileno(), 0, 1000 + points * of_point + triangles * of_triangle)


class MapBuilder:
    """Takes frames with their poses, one by one; of those it keeps nothing but the field."""

    def __init__(self, camera: Camera, voxel: float = VOXEL, farthest: float = FARTHEST) -> None:
        """Make an empty field.

        Args:
            camera: of the frames; where it has lens distortion, that is taken out of every frame.
            voxel: side, metres.
            farthest: depth beyond is left out, metres.

        Raises:
            GavoError: what is no camera, an absurd voxel, or Open3D cannot be imported.
        """
        check_voxel(voxel)
        require_camera(camera)
        self._recorded = camera
        self.camera, self.voxel, self.farthest = camera.rectified(), voxel, farthest
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
            frame: of the camera that the map was made for; its `color` is used where it has one.
            world_T_camera: its pose; the map is in that world, metres.

        Raises:
            FrameError: an image is not of the camera's size.
            GavoError: the pose is no 4x4 matrix of a rigid motion.
        """
        image, core = self._open3d.t.geometry.Image, self._open3d.core
        world_T_camera = np.asarray(world_T_camera)
        if world_T_camera.shape != (4, 4) or not is_rigid(world_T_camera):
            raise GavoError("world_T_camera: a 4x4 matrix is needed, of a rotation and a translation")
        if frame.color is not None and np.shape(frame.color) != (*np.shape(frame.grey), 3):
            raise FrameError(f"color image is of shape {np.shape(frame.color)}: {(*np.shape(frame.grey), 3)} is needed")
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
        """Blocks that may be touched: beyond the largest number those that are there, and of the others the nearest."""
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
        """The surface as a cloud or a mesh; empty where nothing was seen often enough.

        Raises:
            GavoError: another shape.
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
    """A map of frames that come once: those of a run's first segment are fused as they are tracked. It begins with the
    first frame that the next one can be aligned with.

    Args:
        builder: what fuses them.
    """

    def __init__(self, builder: MapBuilder) -> None:
        self._builder = builder
        self._reasons: Counter[str] = Counter()
        self._first: tuple[Frame, np.ndarray, int] | None = None
        """The first frame, until the next one tells whether it is any good, with its pose and segment."""
        self._segment: int | None = None
        """The map's; None before it has begun."""

    def watch(self, frame: Frame, step: Step | None) -> None:
        """Take one more frame; no step: it is the first."""
        if step is None:
            self._first = frame, np.eye(4), 0
            return
        if self._segment is None and step.alignment.status == AlignmentStatus.NO_REFERENCE:
            self._reasons[LOST] += 1  # the frame before
            self._first = frame, step.world_T_camera, step.segment
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
        """The map."""
        self._begin()
        return self._builder.extract(shape, _left_out(self._reasons))


LOST, GUESSED, DOUBTED = "lost", "of a pose that was guessed", "of doubtful depth"
ELSEWHERE, UNREADABLE = "of another segment", "unreadable"


def _why_not(step: Step) -> str | None:
    """Why a step's frame is no part of a map of its segment; None: it is."""
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
    """Fuse the frames of a run, read once more, one at a time.

    Between two segments of a run the motion is unknown, so that they are no part of one map: that of most frames is
    returned. A frame that was lost, whose pose is a guess, whose depth is in doubt, or that cannot be read, is left
    out, and so is of each frame what moves on its own.

    Args:
        sequence: the run's; with `Reading(color=True)` the map has colours, else it is grey.
        steps: the run's.
        shape: cloud or mesh.
        voxel: side, metres.
        farthest: depth beyond is left out, metres.
        trajectory: the poses where they are not the steps' own any more: loops have corrected them.
        moving: where bodies are in the frame of a step.
        on_frame: called for each frame.

    Raises:
        GavoError: what is no sequence, another shape, an absurd voxel, or Open3D cannot be imported.
    """
    check_shape(shape)
    require_sequence(sequence)
    frames, steps = AsTracked(sequence), list(steps)
    corrected = _PosesInOrder(trajectory, float(sequence.timestamps[0]))
    places: list[tuple[int, Step | None, np.ndarray, int]] = [(0, None, np.eye(4), 0)]
    reasons: Counter[str] = Counter()
    for step in steps:
        world_T_camera, segment = corrected.of(step)
        if step.alignment.status is AlignmentStatus.NO_REFERENCE:  # the frames before were fit for nothing
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


class _PosesInOrder:
    """The poses and segments of steps that a trajectory has, asked in the steps' order: a stamp may come again, once a
    clock was set back.
    """

    def __init__(self, trajectory: Trajectory | None, first: float) -> None:
        self._left: dict[str, deque[tuple[np.ndarray, int]]] = {}
        if trajectory is None:
            return
        for row in zip(trajectory.timestamps, trajectory.world_T_camera, trajectory.segments, strict=True):
            stamp, pose, segment = row
            self._left.setdefault(stamp_name(stamp), deque()).append((pose, int(segment)))
        if len(trajectory) and stamp_name(trajectory.timestamps[0]) == stamp_name(first):
            self._left[stamp_name(first)].popleft()  # the first frame's, which no step has

    def of(self, step: Step) -> tuple[np.ndarray, int]:
        """What the trajectory has for the next step, or the step itself."""
        left = self._left.get(stamp_name(step.timestamp))
        has_pose = step.alignment.status is not AlignmentStatus.BAD_TIMESTAMP  # see `run.trajectory_of`
        return left.popleft() if left and has_pose else (step.world_T_camera, step.segment)


def check_map(path: str | Path, shape: Shape | None = None) -> Shape:
    """What is to be written into a file, by its ending.

    Args:
        path: of the file.
        shape: what is wanted; None: what the ending stands for.

    Raises:
        GavoError: an unknown ending, or one that cannot hold that.
    """
    ending = Path(path).suffix.lower()
    if ending not in ENDINGS:
        raise GavoError(f"{path}: a map ends in {', '.join(ENDINGS)}, not in {ending or 'nothing'!r}")
    if shape is None:
        return ENDINGS[ending][0]
    if shape not in ENDINGS[ending]:
        fit = [other for other, holds in ENDINGS.items() if shape in holds]
        raise GavoError(f"{path}: {ending} holds no {shape}: {' or '.join(fit)} does")
    return shape


def check_shape(shape: str) -> None:
    """Raise GavoError for what a map cannot be."""
    if shape not in ("cloud", "mesh"):
        raise GavoError(f"shape: cloud or mesh, not {shape!r}")


def check_voxel(voxel: float) -> None:
    """Raise GavoError for a voxel that no map can have."""
    is_number = isinstance(voxel, int | float | np.integer | np.floating) and not isinstance(voxel, bool)
    if not is_number or not SMALLEST_VOXEL <= voxel <= LARGEST_VOXEL:
        raise GavoError(f"voxel: must be from {SMALLEST_VOXEL:g} to {LARGEST_VOXEL:g} m, not {voxel!r}")


def warn_of(scene: SceneMap, path: str | Path) -> None:
    """Warn of what a map lacks."""
    for line in scene.left_out:
        warnings.warn(f"{path}: left out: {line}", GavoWarning, stacklevel=2)
