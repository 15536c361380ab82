"""Datasets whose frames are numbered files in a folder: 7-Scenes, ScanNet and Replica.

Each class defines how its folder is recognised, where its images and poses are, and which camera took them.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from jaxtyping import Float

from gavo_jax.camera import Camera
from gavo_jax.camera_files.calibration import Calibration, camera_from_table, load_calibration
from gavo_jax.camera_files.exports import common_camera
from gavo_jax.camera_files.makes import of_matrix
from gavo_jax.camera_files.words import REQUIRED
from gavo_jax.datasets.assembly import MILLIMETRES
from gavo_jax.datasets.files import Entry, FileSequence, Reading, Size, depth_size_of_most, resolve_folder, size_of_most
from gavo_jax.datasets.images import COLOR_SUFFIXES, DEPTH_SUFFIXES
from gavo_jax.datasets.layouts.image_folders import plain_files
from gavo_jax.datasets.names import Found, by_number, images_among
from gavo_jax.datasets.own_camera import nearest_camera_file, own_camera_file
from gavo_jax.datasets.truth import TRUTH, Counted, in_order, pose_files, pose_in, pose_of, truth_in
from gavo_jax.errors import GavoError
from gavo_jax.trajectory import Trajectory, inverse

RATE = 30.0
"""Default frame rate, Hz: that of nearly every RGB-D camera."""

NUMBERS = "names are numbers"
"""Value of `times_guessed` for stamps from frame numbers at the default rate."""


class NumberedFolder(FileSequence):
    """Frames whose colour and depth images share a number; times come from `stamps`, else from number and rate."""

    kind: ClassVar[str] = "folder of numbered images"
    depth_is_of_view: ClassVar[bool] = False
    """Whether depth of another size than colour is still registered to it, as from phones."""
    poses_of_depth: ClassVar[bool] = False
    """Whether the poses are those of the depth camera, if it differs from the colour camera."""
    DEPTH_SCALE: ClassVar[float] = MILLIMETRES
    """Depth units per metre, if neither a given camera file nor the folder states them."""
    STAMPS: ClassVar[str] = ""
    """Name of the file that `stamps` reads, for messages."""

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Whether the folder is laid out like this dataset."""
        raise NotImplementedError

    @classmethod
    def find(cls, path: Path) -> Found:
        """Find the image files: each kind in its folder, or distinguished by name."""
        return by_number(*plain_files(path))

    @classmethod
    def calibrate(cls, path: Path, entries: Sequence[Entry], reading: Reading) -> Calibration:
        """The camera file in the folder, else the dataset's own camera.

        Raises:
            GavoError: there is none, or it cannot be read.
        """
        size, file = size_of_most(entries), own_camera_file(path)
        return cls.own_camera(path, size) if file is None else load_calibration(file, size, cls.unit(path, reading))

    @classmethod
    def unit(cls, path: Path, reading: Reading) -> float:
        """Depth units per metre, if a given camera file does not state them.

        Raises:
            GavoError: the folder states them, and they cannot be read.
        """
        return cls.DEPTH_SCALE

    @classmethod
    def own_camera(cls, path: Path, size: Size) -> Calibration:
        """The dataset's own camera for images of a size.

        Raises:
            GavoError: as in `calibrate`.
        """
        raise NotImplementedError

    @classmethod
    def poses(cls, path: Path) -> dict[int, Float[np.ndarray, "4 4"]]:
        """True poses, world_T_camera, by frame number; empty if there is no ground truth."""
        return {}

    @classmethod
    def stamps(cls, path: Path) -> dict[int, float]:
        """Stamps, seconds, by frame number; empty if unknown, so that the rate is used."""
        return {}

    @classmethod
    def open(cls, path: Path, reading: Reading) -> Self:
        """Find the files and read camera and poses; images are read only to find their size.

        Raises:
            GavoError: no frames, no camera, or unreadable poses.
        """
        root = resolve_folder(path)
        found = cls.find(path)
        rate = reading.rate or RATE
        numbers = sorted(found.color.keys() & found.depth.keys())
        if not numbers:
            counts = f"{len(found.color)} colour and {len(found.depth)} depth images"
            raise GavoError(f"{path}: no frames: {counts}, but no two with the same number")
        times = {} if reading.rate else cls.stamps(path)
        left_out = found.unpaired(len(numbers))
        if times and (untimed := len(numbers) - len(times.keys() & set(numbers))):
            left_out.append(f"{untimed} frames: no row in {cls.STAMPS}")
        is_stamped = bool(times)
        times = times or {number: number / rate for number in numbers}
        numbers = [number for number in numbers if number in times]
        if not numbers:
            raise GavoError(f"{path / cls.STAMPS}: contains no row for any of these frames")
        entries = [Entry(times[number], found.color[number], found.depth[number]) for number in numbers]
        own = partial(cls.calibrate, path, entries, reading)
        calibration = reading.calibration(own, partial(size_of_most, entries), cls.unit(path, reading))
        if cls.depth_is_of_view:
            calibration = calibration.with_depth_of_size(*depth_size_of_most(entries))
        if (path / TRUTH).exists():  # a custom ground truth overrides the dataset's poses
            counted = None if is_stamped else Counted(numbers, lambda counts: counts / rate)
            truth = truth_in(path, times.values(), counted)
        else:
            moved = calibration.color_T_depth if cls.poses_of_depth else None
            posed_T_color = np.eye(4) if moved is None else inverse(moved)
            truth = _trajectory(cls.poses(path), {number: times[number] for number in numbers}, posed_T_color)
        sequence = cls(root.name, entries, calibration, truth, reading, left_out)
        sequence.times_guessed = "" if is_stamped or reading.rate else NUMBERS
        return sequence


def _trajectory(
    poses: Mapping[int, np.ndarray], times: Mapping[int, float], posed_T_color: np.ndarray
) -> Trajectory | None:
    """Trajectory of the frames that have a pose, sorted by time (the first of equal times); None if none has one."""
    numbers = [number for number in times if number in poses]
    if not numbers:
        return None
    stamps, kept = np.unique([times[number] for number in numbers], return_index=True)
    return Trajectory(stamps, np.stack([poses[numbers[at]] @ posed_T_color for at in kept]))


class SevenScenes(NumberedFolder):
    """A sequence of 7-Scenes (Shotton et al. 2013): `frame-000000.color.png`, `.depth.png`, `.pose.txt`.

    Depth is in millimetres, 65535 = no reading, and not registered to colour. BundleFusion, 3RScan and 12-Scenes use
    the same file names; their `info.txt` has the cameras.
    """

    kind: ClassVar[str] = "7-Scenes sequence"
    poses_of_depth: ClassVar[bool] = True
    CAMERA = Camera(585.0, 585.0, 320.0, 240.0, 640, 480, depth_scale=MILLIMETRES)
    """Camera from the dataset's page, for both colour and depth."""

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Recognise a folder by its image names."""
        return bool(_any(path, "frame-*.color.*")) and bool(_any(path, "frame-*.depth.*"))

    @classmethod
    def find(cls, path: Path) -> Found:
        """The images of both kinds, in the folder itself."""
        color, depth = (sorted(path.glob(f"frame-*.{kind}.*")) for kind in ("color", "depth"))
        return found_among(_recorded(color), _recorded(depth))

    @classmethod
    def calibrate(cls, path: Path, entries: Sequence[Entry], reading: Reading) -> Calibration:
        """The camera file or a scan's info.txt in the folder or its parent, else the dataset's camera."""
        file = nearest_camera_file(path)
        if file is None:
            return Calibration(cls.CAMERA, origin="the one of 7-Scenes")
        return _millimetres(load_calibration(file, partial(size_of_most, entries), MILLIMETRES))

    @classmethod
    def poses(cls, path: Path) -> dict[int, Float[np.ndarray, "4 4"]]:
        """Poses from one file per frame."""
        return pose_files(images_among(path.glob("frame-*.pose.*"), (".txt",)))


class ScanNet(NumberedFolder):
    """A scan of ScanNet (Dai et al. 2017) as exported by its reader: `color/`, `depth/`, `pose/`, `intrinsic/`.

    In the dataset's own export of every hundredth frame, the camera files are beside these folders.
    """

    kind: ClassVar[str] = "ScanNet scan"
    INTRINSICS: ClassVar[tuple[str, ...]] = ("intrinsic/intrinsic_", "intrinsic_", "intrinsics_")
    """Prefixes of the camera files' names."""

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Recognise a folder by image folders and the colour camera's file, in `intrinsic/` or beside `pose/`."""
        file = cls._intrinsics(path, "color")
        if file is None or not all((path / name).is_dir() for name in ("color", "depth")):
            return False
        return file.parent != path or (path / "pose").is_dir()

    @classmethod
    def _intrinsics(cls, path: Path, camera: str) -> Path | None:
        files = (path / f"{beginning}{camera}.txt" for beginning in cls.INTRINSICS)
        return next((file for file in files if file.is_file()), None)

    @classmethod
    def find(cls, path: Path) -> Found:
        """The images of both kinds, each in its folder."""
        return found_among((path / "color").glob("*"), (path / "depth").glob("*"))

    @classmethod
    def calibrate(cls, path: Path, entries: Sequence[Entry], reading: Reading) -> Calibration:
        """The cameras of colour and depth, or one if they are equal; the extrinsics of scans are the identity."""
        color, depth = (cls._intrinsics(path, name) for name in ("color", "depth"))
        assert color is not None
        found = _millimetres(load_calibration(color, partial(size_of_most, entries), MILLIMETRES))
        if depth is None:
            return found
        for name in ("color", "depth"):
            _check_identity(color.with_name(f"extrinsic_{name}.txt"))
        other = load_calibration(depth, partial(depth_size_of_most, entries), MILLIMETRES).color
        if other == found.color:
            return found
        return replace(found, depth=other, color_T_depth=np.eye(4), origin=f"{color}, {depth.name}")

    @classmethod
    def poses(cls, path: Path) -> dict[int, Float[np.ndarray, "4 4"]]:
        """Poses from one file per frame; frames that were not tracked have infinite values."""
        return pose_files(images_among((path / "pose").glob("*.txt"), (".txt",)))


class Replica(NumberedFolder):
    """A room of Replica as rendered for NICE-SLAM: `results/frame*.jpg`, `results/depth*.png`, `traj.txt`."""

    kind: ClassVar[str] = "Replica room"
    DEPTH_SCALE: ClassVar[float] = 6553.5
    CAMERA = Camera(600.0, 600.0, 599.5, 339.5, 1200, 680, depth_scale=DEPTH_SCALE)

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Recognise a folder by its image names."""
        results = path / "results"
        return results.is_dir() and all(_any(results, f"{kind}[0-9]*") for kind in ("frame", "depth"))

    @classmethod
    def find(cls, path: Path) -> Found:
        """The images of both kinds, in `results/`."""
        results = path / "results"
        return found_among(results.glob("frame*"), results.glob("depth*"))

    @classmethod
    def calibrate(cls, path: Path, entries: Sequence[Entry], reading: Reading) -> Calibration:
        """The camera file (cam_params.json) of the room or of all rooms, else the camera used for rendering."""
        file = nearest_camera_file(path)
        if file is None:
            return Calibration(cls.CAMERA, origin="the one that Replica was rendered with")
        return load_calibration(file, partial(size_of_most, entries), cls.CAMERA.depth_scale)

    @classmethod
    def poses(cls, path: Path) -> dict[int, Float[np.ndarray, "4 4"]]:
        """Poses from rows of sixteen numbers: by frame number, or in order if there are as many as images."""
        file = path / "traj.txt"
        rows = in_order(file, cls.find(path).color) if file.exists() else ()
        return {number: pose for number, place, row in rows if (pose := pose_of(place, row)) is not None}


def _any(folder: Path, pattern: str) -> Path | None:
    return next(folder.glob(pattern), None)


def _recorded(files: list[Path]) -> list[Path]:
    """Files whose names have three parts, if there are any; those with more were derived by projection or rendering."""
    return [file for file in files if file.name.count(".") == 2] or files


def found_among(color: Iterable[Path], depth: Iterable[Path]) -> Found:
    """Index the images of both kinds among files by their numbers."""
    return by_number(images_among(color, COLOR_SUFFIXES), images_among(depth, DEPTH_SUFFIXES))


def _millimetres(calibration: Calibration) -> Calibration:
    """Set the depth scale to the dataset's millimetres, unless the camera file states one."""
    return calibration if calibration.states_depth_scale else calibration.with_depth_scale(MILLIMETRES)


def _check_identity(file: Path) -> None:
    """Refuse extrinsics other than the identity: no scan has them, and their direction is undocumented."""
    if not file.is_file():
        return
    pose = pose_in(file)
    if pose is None or not np.allclose(pose, np.eye(4), atol=1e-6):
        raise GavoError(f"{file}: is not the identity: pass --camera with a file for both cameras and colour_T_depth")


def of_matrices(file: Path, matrices: list[Any], size: Size, depth_scale: float) -> Calibration:
    """Combine the frames' camera matrices into one camera, see `common_camera`.

    Args:
        file: their file, for messages.
        matrices: camera matrices, each nine numbers or three rows of three.
        size: width and height of the images.
        depth_scale: depth units per metre.

    Raises:
        GavoError: there is none, one is no camera matrix, or they differ by more than autofocus explains.
    """
    if not matrices:
        raise GavoError(f"{file}: contains no camera for any frame: pass --camera")
    tables = [_table_of(file, matrix) for matrix in matrices]
    table = {**common_camera(str(file), tables), "width": size[0], "height": size[1]}
    origin = f"{file}, the median of {len(matrices)}"
    return Calibration(camera_from_table(file, table, depth_scale), origin=origin)


def _table_of(file: Path, matrix: Any) -> dict[str, Any]:
    """The intrinsics in a camera matrix, by name."""
    try:
        return of_matrix(str(file), matrix)
    except GavoError:
        raise
    except (ValueError, TypeError):
        raise GavoError(f"{file}: expected a camera matrix of nine numbers, or of three rows of three") from None


def of_each_frame(folder: Path, files: Sequence[Path], load: Callable[[Path], Calibration]) -> Calibration:
    """Combine the frames' camera files into one camera, see `common_camera`.

    Args:
        folder: their folder, for messages.
        files: the camera files.
        load: reads one of them.

    Raises:
        GavoError: they differ by more than autofocus explains, or one cannot be read.
    """
    first, *_ = cameras = [load(file).color for file in files]
    found = common_camera(str(folder), [{key: getattr(camera, key) for key in REQUIRED} for camera in cameras])
    return Calibration(
        replace(first, **found), origin=f"{folder}, the median of {len(files)}", states_depth_scale=False
    )
