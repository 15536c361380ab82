"""`gavo run --map`: writes the map to a file; impossible requests are refused before the run starts."""

import os
from pathlib import Path

from gavo_jax.cli.options import Run
from gavo_jax.datasets.base import Sequence
from gavo_jax.errors import GavoError
from gavo_jax.libusb import import_open3d
from gavo_jax.map_fusion import build_map
from gavo_jax.odometry.hindsight import revised
from gavo_jax.output.run_folder import RunFolder
from gavo_jax.output.screen import frame_progress, say
from gavo_jax.scene_map import SceneMap, Shape, check_map, check_voxel, warn_of
from gavo_jax.trajectory import Trajectory


def check_map_options(path: Path | None, shape: Shape | None, voxel: float) -> Shape:
    """Check that a map can be made and written; return its shape.

    Raises:
        GavoError: The suffix is unknown, the folder is missing or not writable, the path is a folder, or the voxel
            is absurd. Or there are options of a map but no map, or Open3D cannot be imported.
    """
    check_voxel(voxel)
    if path is None:
        for option, is_given in (("--map-shape", shape is not None), ("--voxel", voxel != Run.voxel)):
            if is_given:
                raise GavoError(f"{option}: applies only with --map FILE")
        return shape or "cloud"
    shape = check_map(path, shape)
    if not path.absolute().parent.is_dir():
        raise GavoError(f"{path}: no such folder: {path.parent}")
    if not os.access(path.absolute().parent, os.W_OK):
        raise GavoError(f"{path}: cannot be written: no permission to write to the folder")
    if path.is_dir():
        raise GavoError(f"{path}: is a folder: choose a file for the map")
    import_open3d("map")
    return shape


def save_map(
    path: Path, sequence: Sequence, folder: RunFolder, trajectory: Trajectory, shape: Shape, voxel: float
) -> None:
    """Fuse the frames of a run, as revised in hindsight, and write the map.

    Raises:
        GavoError: It cannot be written.
    """
    steps = folder.steps()
    with frame_progress("the map", len(steps) + 1) as on_frame:
        scene = build_map(
            sequence, revised(steps), shape, voxel, trajectory=trajectory, moving=folder.moving, on_frame=on_frame
        )
    write_map(scene, path)


def write_map(scene: SceneMap, path: Path) -> None:
    """Write a map, and print what it holds.

    Raises:
        GavoError: It cannot be written.
    """
    scene.write(path)
    warn_of(scene, path)
    count = f"{len(scene.points)} points" if scene.triangles is None else f"{len(scene.triangles)} triangles"
    say(f"map of {scene.frames} frames, {count}: {path}")
