"""Converts frames, steps and populations to Rerun data."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64

from gavo_jax.alignment.search import Population
from gavo_jax.bodies.records import Body
from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame, index_at
from gavo_jax.mapping.mapper import Loops
from gavo_jax.mapping.pose_graph import COUNTED
from gavo_jax.odometry.driver import MAX_DOUBTED, Step
from gavo_jax.trajectory import Trajectory, inverse
from gavo_jax.viewer.colors import BLUE, GREEN, GREY, GREYS, VERMILION, WHITE, color_of_body, packed
from gavo_jax.viewer.layout import IMAGES
from gavo_jax.viewer.pictures import (
    Shown,
    color_residual,
    encode_jpeg,
    rays,
    shown_camera,
    shrink,
    tinted,
    warp_target,
)
from gavo_jax.viewer.search_space import MILLIMETRES, Level, level_of, star_strips, ticks_of
from gavo_jax.viewer.seen import FARTHEST, SeenCubes

if TYPE_CHECKING:
    from rerun import RecordingStream


CLOUD_STRIDE = 4
"""Spacing of the cloud's points in pixels of the shown image, along rows and columns."""


NOTHING = encode_jpeg(np.zeros((3, 4), np.uint8))
"""Placeholder for a missing picture."""


class Rows(NamedTuple):
    """Rows of one entity that belong to one frame."""

    generations: list[int]
    """Position of each row on the timeline `generation`."""
    sizes: list[int]
    """Number of instances (points, boxes, …) of each."""
    values: dict[str, Any]
    """Components of all instances: arrays, or lists of text or bytes."""
    frame: int


class Scene:
    """Converts frames, steps and populations to Rerun data; remembers where pieces of paths and warps start.

    Data is collected until `send`, as a call to Rerun costs about the same for one row as for hundreds.
    """

    def __init__(
        self, stream: RecordingStream, camera: Camera, stamps: Float[np.ndarray, " n"], truth: Trajectory | None
    ) -> None:
        import rerun as rr

        self._stream = stream
        self._camera = shown_camera(camera)
        self._depth_scale = camera.depth_scale
        self._cloud = np.s_[CLOUD_STRIDE // 2 :: CLOUD_STRIDE, CLOUD_STRIDE // 2 :: CLOUD_STRIDE]
        self._rays = rays(self._camera)[self._cloud]
        self._truth = Truth(stamps, truth)
        self._frame, self._generation = 0, 0
        self._segment = 0
        self._world_T_camera: Float64[np.ndarray, "4 4"] | None = None
        """Pose of the last frame; None if the motion since is unknown."""
        self._seen = SeenCubes()
        self._bodies: dict[int, Float64[np.ndarray, " 3"]] = {}
        """Centroids of the last frame's bodies by number."""
        self._last_truth: Float64[np.ndarray, "4 4"] | None = None
        self._shown: deque[Shown] = deque(maxlen=MAX_DOUBTED + 1)
        """The last readable frames, which may be references."""
        # in the order of sending: particles, shown at their own frame only, arrive before the time advances
        self._archetypes: dict[str, Any] = {
            "search/particles": rr.Points3D,
            "world/camera": rr.Transform3D,
            "world/camera/image": rr.EncodedImage,
            "world/map": rr.Points3D,
            "world/bodies": rr.LineStrips3D,
            "world/estimate": rr.LineStrips3D,
            "world/truth": rr.LineStrips3D,
            "world/corrected": rr.LineStrips3D,
            "world/loops": rr.LineStrips3D,
            "curves/rmse": rr.Scalars,
            "curves/distance_error": rr.Scalars,
            **{f"images/{name}": rr.EncodedImage for name in IMAGES},
            "search/bounds": rr.Boxes3D,
            "search/ticks": rr.LineStrips3D,
            "search/numbers": rr.Points3D,
            "search/error": rr.Arrows3D,
            "search/truth": rr.LineStrips3D,
            "state": rr.TextDocument,
        }
        self._waiting: dict[str, list[Rows]] = {path: [] for path in self._archetypes}
        self._send_static()

    def add(self, frame: Frame | None, step: Step | None, populations: tuple[Population, ...]) -> None:
        """Collect the data of one frame."""
        self._frame = 0 if step is None else step.index
        world_T_camera = np.eye(4) if step is None else step.world_T_camera
        if step is not None and step.segment != self._segment:
            self._segment, self._world_T_camera, self._last_truth, self._bodies = step.segment, None, None, {}
        truth = self._truth.at(self._frame, world_T_camera, self._segment)
        shown = None if frame is None else shrink(frame, self._camera, self._depth_scale)
        bodies = () if step is None else step.bodies
        if shown is not None:
            self._add_camera(world_T_camera, shown, bodies, step is None or not step.lost)
        self._add_paths(bodies)
        if step is not None:
            self._add_trajectory(world_T_camera, truth)
            self._add_images(shown, step)
        generations = 0
        if step is not None and populations:
            search = [level for level in map(level_of, populations) if level is not None]
            generations = self._add_search(search, self._truth.motion(step))
        self._generation += max(generations, 1)
        self._world_T_camera, self._last_truth = world_T_camera, truth
        if shown is not None:
            self._shown.append(shown)

    def add_loops(self, trajectory: Trajectory, loops: Loops) -> None:
        """Collect the corrected trajectory, and the loops with their residuals."""
        paths = np.split(trajectory.world_T_camera[:, :3, 3], np.flatnonzero(np.diff(trajectory.segments)) + 1)
        self._add("world/corrected", sizes=[len(paths)], strips=paths)
        if not loops.edges:
            return
        places = [keyframe.world_T_camera[:3, 3] for keyframe in loops.keyframes]
        strips = [np.stack([places[edge.earlier], places[edge.later]]) for edge in loops.edges]
        colors = [GREEN if weight > COUNTED else GREY for weight in loops.solution.weights]
        left = np.linalg.norm(loops.solution.residuals[:, :3], axis=1) * MILLIMETRES
        labels = [f"{residual:.0f} mm left" for residual in left]
        self._add("world/loops", sizes=[len(strips)], strips=strips, colors=colors, labels=labels)

    def send(self) -> None:
        """Send the data collected since the last call, each entity's in one call to Rerun."""
        import rerun as rr

        for path, rows in self._waiting.items():
            if not rows:
                continue
            frames = np.repeat([part.frame for part in rows], [len(part.generations) for part in rows])
            times = [
                rr.TimeColumn("frame", sequence=frames),
                rr.TimeColumn("generation", sequence=sum((part.generations for part in rows), [])),
            ]
            values = {name: _joined([part.values[name] for part in rows]) for name in rows[0].values}
            columns = self._archetypes[path].columns(**values)
            self._stream.send_columns(path, times, columns.partition(sum((part.sizes for part in rows), [])))
            rows.clear()

    def _add(self, path: str, generations: list[int] | None = None, sizes: list[int] | None = None, **values: Any):
        """Collect rows of an entity, one for each of `generations`, of `sizes` instances; by default one row of one."""
        generations = [self._generation] if generations is None else generations
        sizes = [1] * len(generations) if sizes is None else sizes
        self._waiting[path].append(Rows(generations, sizes, values, self._frame))

    def _send_static(self) -> None:
        """Send static data, including the styles of entities that change."""
        import rerun as rr

        camera, points = self._camera, rr.Radius.ui_points
        pinhole = rr.Pinhole(
            focal_length=[camera.fx, camera.fy],
            principal_point=[camera.cx + 0.5, camera.cy + 0.5],
            resolution=[camera.width, camera.height],
            image_plane_distance=0.4,
        )
        last = rr.Points3D([[0, 0, 0]], radii=points(5), colors=[WHITE], labels=["last camera"], show_labels=False)
        jpeg = rr.EncodedImage.from_fields(media_type="image/jpeg")
        looks = {
            "world": [rr.ViewCoordinates.RDF],
            "search": [rr.ViewCoordinates.RDF],
            "world/camera/image": [pinhole, jpeg],
            "world/map": [rr.Points3D.from_fields(radii=points(1.5))],
            "world/bodies": [rr.LineStrips3D.from_fields(radii=points(2.5))],
            "world/estimate": [rr.LineStrips3D.from_fields(colors=[BLUE], radii=points(2))],
            "world/truth": [rr.LineStrips3D.from_fields(colors=[WHITE], radii=points(2))],
            "world/corrected": [rr.LineStrips3D.from_fields(colors=[GREEN], radii=points(2))],
            "world/loops": [rr.LineStrips3D.from_fields(radii=points(1), show_labels=False)],
            "curves/rmse": [rr.SeriesLines(colors=[BLUE], widths=[2], names=["RMSE of the pair"])],
            "curves/distance_error": [rr.SeriesLines(colors=[VERMILION], widths=[2], names=["distance error"])],
            **{f"images/{name}": [jpeg] for name in IMAGES},
            "search/particles": [rr.Points3D.from_fields(radii=points(2.5))],
            "search/bounds": [rr.Boxes3D.from_fields(colors=[GREY])],
            "search/ticks": [rr.LineStrips3D.from_fields(colors=[GREY], radii=points(1))],
            "search/numbers": [rr.Points3D.from_fields(colors=[WHITE], radii=points(0), show_labels=True)],
            "search/error": [rr.Arrows3D.from_fields(colors=[VERMILION], radii=points(1))],
            "search/truth": [rr.LineStrips3D.from_fields(colors=[GREEN], radii=points(2))],
            "search/last_camera": [last],
            "state": [rr.TextDocument.from_fields(media_type="text/markdown")],
        }
        for path, archetypes in looks.items():
            self._stream.log(path, *archetypes, static=True)

    def _add_camera(
        self, world_T_camera: Float64[np.ndarray, "4 4"], shown: Shown, bodies: tuple[Body, ...], is_placed: bool
    ) -> None:
        self._add("world/camera", translation=world_T_camera[None, :3, 3], mat3x3=world_T_camera[None, :3, :3])
        masks = [(body.number, body.mask_at(shown.grey.shape)) for body in bodies]
        jpeg = encode_jpeg(tinted(shown.picture, masks)) if masks else shown.jpeg
        self._add("world/camera/image", blob=[jpeg])
        self._add("images/target", blob=[jpeg])
        if is_placed:
            self._add_points(world_T_camera, shown, masks)

    def _add_points(
        self,
        world_T_camera: Float64[np.ndarray, "4 4"],
        shown: Shown,
        masks: list[tuple[int, Bool[np.ndarray, "h w"]]],
    ) -> None:
        """Add the points of the scene that are seen for the first time, without bodies."""
        depth = shown.depth[self._cloud]
        seen = (depth > 0) & (depth < FARTHEST)
        for _, mask in masks:
            seen &= ~mask[self._cloud]
        points = self._rays[seen] * depth[seen][:, None]
        points = points @ world_T_camera[:3, :3].T + world_T_camera[:3, 3]
        new, picture = self._seen.new(points), shown.picture[self._cloud][seen]
        colors = GREYS[picture[new]] if picture.ndim == 1 else packed(picture[new, ::-1])
        self._add("world/map", sizes=[len(new)], positions=points[new], colors=colors)

    def _add_paths(self, bodies: tuple[Body, ...]) -> None:
        """Add a piece of the path of each body that was seen in the last frame too."""
        pieces = [(b.number, self._bodies[b.number], b.centroid) for b in bodies if b.number in self._bodies]
        if pieces:
            strips = [np.stack([start, end]) for _, start, end in pieces]
            colors = [color_of_body(number) for number, *_ in pieces]
            self._add("world/bodies", sizes=[len(pieces)], strips=strips, colors=colors)
        self._bodies = {body.number: body.centroid for body in bodies}

    def _add_trajectory(
        self, world_T_camera: Float64[np.ndarray, "4 4"], truth: Float64[np.ndarray, "4 4"] | None
    ) -> None:
        """Add this frame's piece of both paths, which the view accumulates, and the distance error."""
        for path, start, end in (
            ("world/estimate", self._world_T_camera, world_T_camera),
            ("world/truth", self._last_truth, truth),
        ):
            if start is not None and end is not None:
                self._add(path, strips=np.stack([start[:3, 3], end[:3, 3]])[None])
        if truth is not None:
            error = float(np.linalg.norm(world_T_camera[:3, 3] - truth[:3, 3]))
            self._add("curves/distance_error", scalars=[error])

    def _add_images(self, shown: Shown | None, step: Step) -> None:
        if np.isfinite(step.alignment.error):
            self._add("curves/rmse", scalars=[float(np.sqrt(step.alignment.error))])
        reference = next((s for s in reversed(self._shown) if s.timestamp == step.reference_timestamp), None)
        if shown is None or reference is None:  # otherwise those of another frame would stay
            for name in ("reference", "warped", "residual"):
                self._add(f"images/{name}", blob=[NOTHING])
            return
        warped, seen = warp_target(reference, shown, np.asarray(step.alignment.target_T_reference), self._camera)
        self._add("images/reference", blob=[reference.jpeg])
        self._add("images/warped", blob=[encode_jpeg(warped)])
        self._add("images/residual", blob=[encode_jpeg(color_residual(warped, reference.grey, seen))])

    def _add_search(self, search: list[Level], motion: Float64[np.ndarray, "4 4"] | None) -> int:
        """Add every generation of a frame; return how many there are."""
        if not search:
            return 0
        sizes = [level.positions.shape[1] for level in search for _ in level.rmse]
        count = len(sizes)
        generations = list(range(self._generation, self._generation + count))
        positions = np.concatenate([level.positions.reshape(-1, 3) for level in search])
        colors = np.concatenate([level.colors.ravel() for level in search])
        self._add("search/particles", generations, sizes, positions=positions, colors=colors)
        starts = (np.cumsum([0, *(len(level.rmse) for level in search[:-1])]) + self._generation).tolist()
        self._add(
            "search/bounds",
            starts,
            centers=np.stack([level.centre for level in search]),
            half_sizes=np.stack([level.half_sizes for level in search]),
        )
        self._add_ticks(search, starts)
        if motion is None:
            self._add("state", generations, text=[text for level in search for text in level.states()])
            return count
        true = motion[:3, 3] * MILLIMETRES
        arrows = [true - level.positions[:, 0] for level in search]
        best = np.concatenate([level.positions[:, 0] for level in search])
        self._add("search/error", generations, origins=best, vectors=np.concatenate(arrows))
        errors = [np.linalg.norm(arrow, axis=1) for arrow in arrows]
        states = [text for level, own in zip(search, errors, strict=True) for text in level.states(own)]
        self._add("state", generations, text=states)
        strips = star_strips(true, max(0.05 * float(np.linalg.norm(true)), 0.5))
        self._add("search/truth", sizes=[len(strips)], strips=strips)
        return count

    def _add_ticks(self, search: list[Level], starts: list[int]) -> None:
        """Add the ticks of each level's box."""
        ticks = [ticks_of(level.centre, level.half_sizes) for level in search]
        strips = [strip for own in ticks for strip in own.strips]
        self._add("search/ticks", starts, [len(own.strips) for own in ticks], strips=strips)
        places, labels = np.concatenate([own.places for own in ticks]), [text for own in ticks for text in own.labels]
        self._add("search/numbers", starts, [len(own.labels) for own in ticks], positions=places, labels=labels)


def _joined(parts: list[Any]) -> Any:
    return np.concatenate(parts) if isinstance(parts[0], np.ndarray) else sum(parts, [])


class Truth:
    """The true poses of the camera, in the estimate's world.

    Each segment is aligned by its first pose whose truth is known, as the motion between segments is unknown.
    """

    def __init__(self, stamps: Float[np.ndarray, " n"], truth: Trajectory | None) -> None:
        self._stamps = stamps
        self._truth_T_camera = np.zeros((len(self._stamps), 4, 4))
        self._known = np.zeros(len(self._stamps), bool)
        if truth is not None:
            self._truth_T_camera, self._known = truth.interpolate(stamps)
        self._world_T_truth: dict[int, Float64[np.ndarray, "4 4"]] = {}

    def at(
        self, index: int, world_T_camera: Float64[np.ndarray, "4 4"], segment: int = 0
    ) -> Float64[np.ndarray, "4 4"] | None:
        """Return the true world_T_camera of a frame of a segment, None if unknown."""
        if not self._is_known(index):
            return None
        if segment not in self._world_T_truth:
            self._world_T_truth[segment] = world_T_camera @ inverse(self._truth_T_camera[index])
        return self._world_T_truth[segment] @ self._truth_T_camera[index]

    def _is_known(self, index: int) -> bool:
        """Whether a frame's truth is known; frames beyond the timestamps, as of a live source, have none."""
        return index < len(self._known) and bool(self._known[index])

    def motion(self, step: Step) -> Float64[np.ndarray, "4 4"] | None:
        """Return the true reference_T_target of a step, None if unknown."""
        if not self._is_known(step.index):
            return None
        reference = index_at(self._stamps, step.reference_timestamp)
        if not self._is_known(reference):
            return None
        return inverse(self._truth_T_camera[reference]) @ self._truth_T_camera[step.index]
