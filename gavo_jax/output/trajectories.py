"""Writes trajectories in the formats of other programs: TUM, KITTI, EuRoC's CSV, JSON, and a ROS 2 bag of poses."""

import shutil
import sqlite3
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from gavo_jax.errors import GavoError, as_path, partial_of, shown
from gavo_jax.output.files import TRAJECTORY, json_text, remove_files
from gavo_jax.output.screen import say
from gavo_jax.trajectory import Trajectory, quaternion_from_rotation, require_trajectory, write_lines

FILES = {
    "tum": TRAJECTORY,
    "kitti": "trajectory.kitti.txt",
    "euroc": "trajectory.csv",
    "json": "trajectory.json",
    "bag": "trajectory_bag",
}
"""Name of each format's file in a run's folder; the bag is a folder, as usual in ROS 2."""

SHOWING_SEGMENTS = ("tum", "json")
"""Formats that tell the segments of a trajectory."""

EUROC_HEADER = "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []"

POSES, POSE_TYPE = "/gavo/pose", "geometry_msgs/msg/PoseStamped"
"""Topic and type of a bag's messages; the pose is that of the camera (x right, y down, z forward) in the world."""

BAG_METADATA = "metadata.yaml"
"""File that every bag's folder contains."""

WORLD = "world"
"""Frame in the messages' headers."""

LATEST_STAMP = 2**31
"""Bound of the timestamps in a ROS header, seconds: they are below it, and not below 0."""


def write_trajectory(trajectory: Trajectory, path: str | Path, form: str) -> None:
    """Write a trajectory, camera to world, atomically.

    Segments, between which the motion is unknown (`Trajectory.segments`), are kept in TUM files and JSON; the other
    formats cannot hold them.

    Args:
        trajectory: Timestamps in seconds, poses in metres.
        path: The file, or a bag's folder. An existing file is replaced, a folder only if it is a bag.
        form: One of `FILES`.

    Raises:
        GavoError: The format is unknown, the input is not a trajectory, a pose is not a rigid transform, or a timestamp
            is not finite or not allowed in the format. Or the extra `[bag]` is missing, or writing fails.
    """
    check_format(form)
    require_trajectory(trajectory)
    trajectory.require_rigid()
    if not np.isfinite(trajectory.timestamps).all():
        raise GavoError(
            f"{path}: pose {np.argmin(np.isfinite(trajectory.timestamps))} has a stamp that is not a number"
        )
    WRITERS[form](trajectory, as_path(path))


def check_format(form: str) -> None:
    """Check that `write_trajectory` knows a format, before there is a trajectory.

    Raises:
        GavoError: The format is unknown, or it is a bag and the extra `[bag]` is missing.
    """
    if not isinstance(form, str) or form not in WRITERS:
        raise GavoError(f"trajectory format {shown(form)}: not one of {', '.join(WRITERS)}")
    if form == "bag":
        _import_rosbags()


def formats(text: str) -> list[str]:
    """Return the formats of a comma-separated list, each once.

    Raises:
        GavoError: See `check_format`.
    """
    chosen = list(dict.fromkeys(name.strip() for name in text.split(",")))
    for form in chosen:
        check_format(form)
    return chosen


def write_trajectories(trajectory: Trajectory, folder: Path, forms: Iterable[str]) -> None:
    """Write a run's trajectory in some formats, except TUM, which every run writes as it goes.

    A line on screen names those that do not show where the motion is unknown.

    Raises:
        GavoError: See `write_trajectory`.
    """
    for form in forms:
        if form != "tum":
            write_trajectory(trajectory, folder / FILES[form], form)
    if trajectory.segments.any() and (blind := [FILES[form] for form in forms if form not in SHOWING_SEGMENTS]):
        say(f"{', '.join(blind)}: not shown there: the motion between the segments of {TRAJECTORY} is unknown")


def remove_trajectories(folder: Path) -> None:
    """Remove an earlier run's trajectories in formats other than TUM.

    Raises:
        GavoError: A file cannot be removed.
    """
    remove_files(folder, *(name for form, name in FILES.items() if form not in ("tum", "bag")))
    bag = folder / FILES["bag"]
    if (bag / BAG_METADATA).is_file() and not bag.is_symlink():
        shutil.rmtree(bag, ignore_errors=True)


def write_euroc(trajectory: Trajectory, path: Path) -> None:
    """Write EuRoC's CSV: nanoseconds, x y z, qw qx qy qz."""
    write_lines(path, [EUROC_HEADER, *_euroc_rows(trajectory)])


def write_json_trajectory(trajectory: Trajectory, path: Path) -> None:
    """Write one object: `frame`, `units` and `poses`, each with timestamp, translation, quaternion and segment."""
    poses = [
        {
            "timestamp": stamp,
            "translation": matrix[:3, 3].tolist(),
            "quaternion_xyzw": quaternion.tolist(),
            "segment": int(segment),
        }
        for stamp, matrix, quaternion, segment in zip(
            trajectory.timestamps.tolist(),
            trajectory.world_T_camera,
            _quaternions(trajectory),
            trajectory.segments,
            strict=True,
        )
    ]
    whole = {"frame": "world_T_camera", "units": {"timestamp": "s", "translation": "m"}, "poses": poses}
    write_lines(path, [json_text(whole)])


def write_bag(trajectory: Trajectory, path: Path) -> None:
    """Write a ROS 2 bag (SQLite) of `geometry_msgs/PoseStamped` on the topic `/gavo/pose`."""
    if len(trajectory) and not 0 <= trajectory.timestamps.min() <= trajectory.timestamps.max() < LATEST_STAMP:
        raise GavoError(f"{path}: a ROS bag can only store stamps from 0 to {LATEST_STAMP} seconds")
    rosbag2, typesys = _import_rosbags()
    if path.exists() and not (path / BAG_METADATA).is_file():
        raise GavoError(f"{path}: already exists, and is not a bag")
    partial = partial_of(path)
    try:
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir()
        _record(trajectory, partial / path.name, rosbag2, typesys)
        if path.exists():
            shutil.rmtree(path)
        (partial / path.name).rename(path)
    except (OSError, sqlite3.Error, rosbag2.WriterError) as error:
        raise GavoError(f"{path}: cannot be written: {getattr(error, 'strerror', None) or error}") from None
    finally:
        shutil.rmtree(partial, ignore_errors=True)


WRITERS: dict[str, Callable[[Trajectory, Path], None]] = {
    "tum": Trajectory.write_tum,
    "kitti": Trajectory.write_kitti,
    "euroc": write_euroc,
    "json": write_json_trajectory,
    "bag": write_bag,
}


def _record(trajectory: Trajectory, folder: Path, rosbag2: Any, typesys: Any) -> None:
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    types = store.types
    point, turn = types["geometry_msgs/msg/Point"], types["geometry_msgs/msg/Quaternion"]
    with rosbag2.Writer(folder, version=8, storage_plugin=rosbag2.StoragePlugin.SQLITE3) as writer:
        connection = writer.add_connection(POSES, POSE_TYPE, typestore=store)
        rows = zip(_nanoseconds(trajectory), trajectory.world_T_camera, _quaternions(trajectory), strict=True)
        for stamp, matrix, quaternion in rows:
            time = types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
            message = types[POSE_TYPE](
                header=types["std_msgs/msg/Header"](stamp=time, frame_id=WORLD),
                pose=types["geometry_msgs/msg/Pose"](
                    position=point(*matrix[:3, 3].tolist()), orientation=turn(*quaternion.tolist())
                ),
            )
            writer.write(connection, stamp, store.serialize_cdr(message, POSE_TYPE))


def _euroc_rows(trajectory: Trajectory) -> Iterator[str]:
    quaternions = np.roll(_quaternions(trajectory), 1, axis=1)
    for stamp, matrix, quaternion in zip(_nanoseconds(trajectory), trajectory.world_T_camera, quaternions, strict=True):
        values = [*matrix[:3, 3].tolist(), *quaternion.tolist()]
        yield ",".join([str(stamp), *(np.format_float_positional(value, min_digits=9) for value in values)])


def _nanoseconds(trajectory: Trajectory) -> list[int]:
    """Return timestamps in nanoseconds, rounded to the microsecond: seconds since 1970 as floats hold no more."""
    return [round(stamp * 1e6) * 1000 for stamp in trajectory.timestamps.tolist()]


def _quaternions(trajectory: Trajectory) -> Float[np.ndarray, "n 4"]:
    return quaternion_from_rotation(trajectory.world_T_camera[:, :3, :3])


def _import_rosbags() -> tuple[Any, Any]:
    try:
        from rosbags import rosbag2, typesys
    except ImportError as error:
        raise GavoError(f"a ROS bag needs the library rosbags ({error}): install 'gavo-jax[bag]'") from None
    return rosbag2, typesys
