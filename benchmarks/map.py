"""Distance of a run's map from the depth of a frame left out of it, and a picture of the map.

Tracks a clip and fuses every frame but one (by default the middle one) into a mesh (`gavo_jax.map_fusion`). Prints how
far the left-out frame's depth, placed at its tracked pose, lies from the mesh. Needs the extra `[map]`.

    python benchmarks/map.py
    python benchmarks/map.py --record benchmarks/records/map.toml --picture-file docs/map.png
    python benchmarks/map.py --clip FOLDER --voxels 0.02 --json map.json

On 2 cores the defaults take about two minutes.
"""

from pathlib import Path
from typing import Any

import common
import cv2
import numpy as np
from jaxtyping import Float, UInt8

from gavo_jax import Camera, Frame, Reading, open_source, run_odometry
from gavo_jax.libusb import import_open3d
from gavo_jax.map_fusion import build_map
from gavo_jax.output.screen import number
from gavo_jax.scene_map import VOXEL, SceneMap
from gavo_jax.trajectory import inverse

FARTHEST = 4.0
"""Metres: depth beyond this is not in the map."""

SIZE, ABOVE, BEHIND, VIEW = (1000, 750), -0.25, -0.75, 55.0
"""Picture: size in pixels, y and z of its camera in the first one's frame (m), horizontal field of view (deg)."""


BACKGROUND = 45
"""Grey level where there is no surface."""


def distances(scene: SceneMap, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Distances of points from the mesh, metres."""
    open3d = import_open3d("map")
    tensor, faces = open3d.core.Tensor, np.asarray(scene.triangles, np.uint32)
    rays = open3d.t.geometry.RaycastingScene()
    rays.add_triangles(tensor(scene.points.astype(np.float32)), tensor(faces))
    return rays.compute_distance(tensor(points.astype(np.float32))).numpy()


def points_of(frame: Frame, camera: Camera, world_T_camera: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "n 3"]:
    """Return the points of a frame's depth in the world frame, metres."""
    depth = frame.depth / camera.depth_scale
    v, u = np.nonzero((depth > 0) & (depth < FARTHEST))
    points = np.asarray(camera.back_project(np.stack([u, v], axis=-1).astype(float), depth[v, u]))
    return points @ world_T_camera[:3, :3].T + world_T_camera[:3, 3]


def picture(scene: SceneMap, world_T_camera: Float[np.ndarray, "4 4"]) -> UInt8[np.ndarray, "h w 3"]:
    """Render the mesh in RGB by casting a ray through each pixel; dark where there is no surface."""
    open3d = import_open3d("map")
    tensor, faces = open3d.core.Tensor, np.asarray(scene.triangles, np.uint32)
    rays = open3d.t.geometry.RaycastingScene()
    rays.add_triangles(tensor(scene.points.astype(np.float32)), tensor(faces))
    width, height = SIZE
    focal = width / 2 / np.tan(np.radians(VIEW / 2))
    matrix = np.array([[focal, 0, width / 2 - 0.5], [0, focal, height / 2 - 0.5], [0, 0, 1]])
    through = rays.create_rays_pinhole(tensor(matrix), tensor(inverse(world_T_camera)), width, height)
    hit = rays.cast_rays(through)
    triangle, share = hit["primitive_ids"].numpy(), hit["primitive_uvs"].numpy()
    seen = np.isfinite(hit["t_hit"].numpy())
    corners = scene.colors[faces[np.where(seen, triangle, 0)]].astype(float)
    weights = np.stack([1 - share.sum(-1), share[..., 0], share[..., 1]], axis=-1)
    color = np.einsum("hwkc,hwk->hwc", corners, weights)
    return np.where(seen[..., None], np.rint(np.clip(color, 0, 255)), BACKGROUND).astype(np.uint8)


def looking_on() -> Float[np.ndarray, "4 4"]:
    """Return a pose behind and above the first camera, looking at a point 1.5 m in front of it."""
    tilt = np.arctan2(-ABOVE, 1.5 - BEHIND)
    pose = np.eye(4)
    pose[1:3, 1:3] = [[np.cos(tilt), np.sin(tilt)], [-np.sin(tilt), np.cos(tilt)]]
    pose[:3, 3] = (0, ABOVE, BEHIND)
    return pose


def main(
    clip: str = "fr1_xyz:60",
    method: str = "ga:fast",
    voxels: str = f"{VOXEL:g},0.005",
    left_out: int | None = None,
    picture_file: Path | None = None,
    json: Path | None = None,
) -> dict[str, Any]:
    """Measure, print and return the figures.

    Args:
        clip: one clip; see `common.open_clip`.
        method: METHOD or METHOD:PRESET.
        voxels: comma-separated sides of a voxel, metres.
        left_out: number of the frame left out of the map; the middle one by default.
        picture_file: file for a picture of the map of all frames, with the last voxel size.
        json: file for the figures.
    """
    plain = common.open_clip(clip)
    sequence = plain
    if (folder := getattr(plain, "folder", None)) is not None:
        sequence = open_source(folder, Reading(color=True))[: len(plain)]
    run = run_odometry(sequence, common.preset_of(method))
    index = len(sequence) // 2 if left_out is None else left_out
    step = next(step for step in run.steps if step.index == index)
    points = points_of(sequence[index], sequence.camera, step.world_T_camera)
    others = [other for other in run.steps if other.index != index]
    sides = [float(voxel) for voxel in common.names(voxels)]
    figures: dict[str, Any] = {}
    rows = []
    for side in sides:
        scene = build_map(sequence, others, "mesh", side)
        away = 1e3 * distances(scene, points)
        median, most = float(np.median(away)), float(np.percentile(away, 90))
        figures[f"{side:g}"] = {"median_mm": median, "p90_mm": most, "frames": scene.frames, "points": len(away)}
        triangles = len(np.asarray(scene.triangles))
        rows.append((f"{1e3 * side:g} mm", number(median, 2), number(most, 2), str(scene.frames), str(triangles)))
    columns = ("voxel", "median, mm", "90th percentile, mm", "frames", "triangles")
    common.print_table(f"distance of frame {index} of {clip} from the map of the others, {method}", columns, rows)
    if picture_file is not None:
        image = picture(build_map(sequence, run.steps, "mesh", sides[-1]), looking_on())
        cv2.imwrite(str(picture_file), cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    common.record(json, "map", figures)
    return figures


if __name__ == "__main__":
    common.command(main)
