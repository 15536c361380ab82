"""The scene map of a run: a point cloud or a mesh, and the files that hold it; `map_fusion` makes it of frames."""

import contextlib
import os
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int, UInt8

from gavo_jax.errors import GavoError, GavoWarning, as_path, partial_of
from gavo_jax.libusb import import_open3d

Shape = Literal["cloud", "mesh"]

ENDINGS: dict[str, tuple[Shape, ...]] = {".ply": ("cloud", "mesh"), ".pcd": ("cloud",), ".obj": ("mesh",)}
"""Shapes that a file with each ending can hold; the first is the default."""

LARGEST = {".ply": (51, 13), ".pcd": (28, 0), ".obj": (120, 70)}
"""Largest size of a point or vertex, and of a triangle, in a file with each ending, bytes."""

VOXEL = 0.01
"""Default side of a voxel, metres."""
SMALLEST_VOXEL, LARGEST_VOXEL = 1e-3, 1.0

FARTHEST = 4.0
"""Default range of depth, metres: beyond it the noise of a structured-light or stereo camera exceeds several voxels."""


@dataclass(frozen=True, eq=False)
class SceneMap:
    """Map of a segment of a run, in the run's world (the frame of its first camera), metres.

    Attributes:
        points: points of the cloud, or vertices of the mesh.
        colors: RGB of each; grey where the sequence was opened without colour.
        normals: unit vectors, towards where the camera was.
        triangles: three vertex indices each; None for a cloud.
        frames: number of frames fused.
        left_out: what was left out and why, one line each.
    """

    points: Float[np.ndarray, "n 3"]
    colors: UInt8[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    triangles: Int[np.ndarray, "t 3"] | None = None
    frames: int = 0
    left_out: tuple[str, ...] = ()

    @property
    def shape(self) -> Shape:
        """Whether the map is a cloud or a mesh."""
        return "cloud" if self.triangles is None else "mesh"

    def write(self, path: str | Path) -> None:
        """Write the map atomically: a cloud as `.ply` or `.pcd`, a mesh as `.ply` or `.obj`.

        Raises:
            GavoError: unsuitable ending, empty map, or the file cannot be written.
        """
        path = as_path(path)
        check_map(path, self.shape)
        if len(self.points) == 0:
            raise GavoError(
                f"{path}: not written: nothing near enough ({FARTHEST:g} m by default) was seen often enough for a map"
            )
        open3d = import_open3d("map")
        vector = open3d.utility.Vector3dVector
        partial = path.with_name(partial_of(path).name + path.suffix.lower())  # Open3D goes by the suffix
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
    """Reserve the disk space of a map's file, if the system can; Open3D does not notice a full disk.

    Raises:
        OSError: there is not enough space.
    """
    of_point, of_triangle = LARGEST[path.suffix]
    with path.open("xb") as file:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(file.fileno(), 0, 1000 + points * of_point + triangles * of_triangle)


def check_map(path: str | Path, shape: Shape | None = None) -> Shape:
    """Return the shape to write into a file, checked against its ending.

    Args:
        path: path of the file.
        shape: the shape that is wanted; None for the ending's default.

    Raises:
        GavoError: unknown ending, or one that cannot hold the shape.
    """
    ending = as_path(path).suffix.lower()
    if ending not in ENDINGS:
        raise GavoError(f"{path}: the name of a map must end in {', '.join(ENDINGS)}, not in {ending or 'nothing'!r}")
    if shape is None:
        return ENDINGS[ending][0]
    if shape not in ENDINGS[ending]:
        fit = [other for other, holds in ENDINGS.items() if shape in holds]
        raise GavoError(f"{path}: {ending} cannot store a {shape}: use {' or '.join(fit)}")
    return shape


def check_shape(shape: str) -> None:
    """Raise GavoError for an unknown shape."""
    if shape not in ("cloud", "mesh"):
        raise GavoError(f"shape: must be cloud or mesh, not {shape!r}")


def check_voxel(voxel: float) -> None:
    """Raise GavoError for a voxel size that is not a number in the allowed range."""
    is_number = isinstance(voxel, int | float | np.integer | np.floating) and not isinstance(voxel, bool)
    if not is_number or not SMALLEST_VOXEL <= voxel <= LARGEST_VOXEL:
        raise GavoError(f"voxel: must be from {SMALLEST_VOXEL:g} to {LARGEST_VOXEL:g} m, not {voxel!r}")


def warn_of(scene: SceneMap, path: str | Path) -> None:
    """Warn of what a map lacks."""
    for line in scene.left_out:
        warnings.warn(f"{path}: left out: {line}", GavoWarning, stacklevel=2)
