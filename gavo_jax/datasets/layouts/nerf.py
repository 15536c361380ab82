"""Poses in NeRF's `transforms.json`, as written by nerfstudio, Polycam's converters and others."""

from collections.abc import Mapping, Sequence
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np
from jaxtyping import Float

from gavo_jax.camera_files.calibration import MAX_JSON_BYTES
from gavo_jax.datasets.truth import by_stamp, pose_of
from gavo_jax.errors import GavoError, read_json, shown
from gavo_jax.trajectory import Trajectory

TRANSFORMS = "transforms.json"

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
"""From our camera axes to NeRF's, where y points up and the camera looks along -z."""

LARGEST_SCALE = 1e6
"""Largest scale of translations; its inverse is the smallest."""

WITHOUT_SCALE = ("colmap_im_id", "sharpness", "colmap_pose")
"""Keys of frames whose poses come from structure from motion, so that their scale is unknown."""


def read_transforms(path: Path, stamps: Mapping[Path, float]) -> tuple[Trajectory | None, list[str]]:
    """Read the poses of images, world_T_camera.

    Args:
        path: the file.
        stamps: stamp of each image, seconds, by its path.

    Returns:
        The trajectory; or None, and a line that says why: no finite pose belongs to these images, or the scale is
        unknown (`WITHOUT_SCALE`). None and no line if the file has no poses. A line, too, if several poses may be those
        of an image: none of them is used.

    Raises:
        GavoError: not JSON, or an invalid pose or scale.
    """
    values = read_json(path, MAX_JSON_BYTES)
    frames = [(at, frame) for at, frame in _frames(values) if frame.get("transform_matrix") is not None]
    if any(key in frame for _, frame in frames for key in WITHOUT_SCALE):
        return None, [f"{path.name}: its poses come from structure from motion, whose unit is unknown"]
    scale = _scale(path, values) if frames else 1.0
    poses: dict[float, np.ndarray] = {}
    found, doubled = _stamps_of([str(frame.get("file_path")) for _, frame in frames], path.parent, stamps)
    for (at, frame), stamp in zip(frames, found, strict=True):
        pose = pose_of_rows(f"{path}: frames[{at}]", frame["transform_matrix"])
        if stamp is not None and pose is not None:
            pose[:3, 3] /= scale
            poses[stamp] = pose @ FLIP
    unread = [f"{path.name}: {line}" for line in doubled]
    if not poses:
        return None, unread or ([f"{path.name}: contains no pose for any of these images"] if frames else [])
    return by_stamp(poses), unread


def _stamps_of(
    names: Sequence[str], folder: Path, stamps: Mapping[Path, float]
) -> tuple[list[float | None], list[str]]:
    """The stamp of the image that each path names, from `folder` on; and a line if some name several images.

    Paths may be those of another machine or folder; then the image's own name decides, unless several paths have it.
    """
    places = [_place(folder / PureWindowsPath(name).as_posix()) for name in names]
    images = {_place(image): stamp for image, stamp in stamps.items()}
    by_name: dict[str, list[float]] = {}
    for image, stamp in images.items():
        by_name.setdefault(image.name, []).append(stamp)
    alike: dict[str, set[Path]] = {}
    for place in places:
        alike.setdefault(place.name, set()).add(place)
    alone = {name: by_name[name][0] for name, own in alike.items() if len(own) == len(by_name.get(name, ())) == 1}
    lost = [own for name, own in alike.items() if name in by_name and name not in alone and not own & images.keys()]
    told = dict(zip(places, names, strict=True))
    both = [" and ".join(told[place][-60:] for place in sorted(own)[:2]) for own in lost[:1]]
    lines = [f"no poses for {len(lost)} images: several of its paths end alike, such as {paths}" for paths in both]
    return [images.get(place, alone.get(place.name)) for place in places], lines


def _place(image: Path) -> Path:
    """A path with its folder's links resolved, and without the ending, unless that is the decimals of a stamp."""
    bare = image if image.suffix[1:].isdecimal() else image.parent / image.stem
    try:
        return bare.parent.resolve() / bare.name
    except (OSError, RuntimeError, ValueError):
        return bare


def _frames(values: Any) -> list[tuple[int, dict[str, Any]]]:
    """The entry of each frame, with its index."""
    frames = values.get("frames") if isinstance(values, dict) else None
    listed = frames if isinstance(frames, list) else []
    return [(at, frame) for at, frame in enumerate(listed) if isinstance(frame, dict)]


def _scale(path: Path, values: dict[str, Any]) -> float:
    """The factor by which translations were multiplied, as stated by nerfstudio; a rigid transform may be applied, too.

    Raises:
        GavoError: the scale is invalid, or the applied transform is not rigid.
    """
    if (moved := values.get("applied_transform")) is not None:
        pose_of_rows(f"{path}: applied_transform", moved)
    scale = values.get("applied_scale")
    if scale is None:
        return 1.0
    is_number = isinstance(scale, int | float) and not isinstance(scale, bool)
    if not is_number or not 1 / LARGEST_SCALE < scale < LARGEST_SCALE:
        raise GavoError(f"{path}: applied_scale: expected a number above 0, found {shown(scale)}")
    return scale


def pose_of_rows(place: str, matrix: Any) -> Float[np.ndarray, "4 4"] | None:
    """Parse a pose of three or four rows of four numbers, or as a flat list; None if it is not finite.

    Raises:
        GavoError: it is not a pose.
    """
    rows = matrix if isinstance(matrix, list) else [matrix]
    fields = [str(value) for row in rows for value in (row if isinstance(row, list) else [row])]
    return pose_of(place, fields + ["0", "0", "0", "1"] * (len(fields) == 12))
