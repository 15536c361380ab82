"""Datasets and recordings that are not read: what their folders are recognised by, and what makes a source of them."""

from pathlib import Path
from typing import NamedTuple

ARRAYS = "write its colour and depth as images into rgb/ and depth/, or as .npy of one frame each"

RECORD_3D = "a recording of Record3D: export it in the app as EXR + RGB, and name the folder of rgb/ and depth/"

AS_DEPTH = "as z = length / sqrt(1 + x^2 + y^2)"


class Known(NamedTuple):
    """A kind of folder that is known, but not read."""

    patterns: tuple[str, ...]
    """Glob patterns; the folder has something for each."""
    words: str
    """What it is, and what helps."""


KNOWN = (
    Known(
        ("d-*.pgm", "r-*.ppm"),
        "the raw recording of NYU Depth, whose depth is in units of disparity: write rgb/ and depth/ with the "
        "dataset's toolbox first",
    ),
    Known(
        ("data.jsonl", "calibration.json"),
        "a recording of Spectacular AI: write its images with sai-cli process, and name the folder of transforms.json",
    ),
    Known(
        ("depth.bin", "pose_intrinsic_imu.json"),
        "the iPhone's part of a scan of ScanNet++, its images still packed: write rgb/ and depth/ with "
        "iphone/prepare_iphone_data.py of its toolbox (extract_rgb, extract_depth)",
    ),
    Known(
        ("color_left/trajectory_*",),
        "recordings of Mid-Air, whose PNG hold floats of 16 bits: of a trajectory write depth = 512 / disparity of "
        "stereo_disparity/ as TIFF or .npy of floats into depth/, beside rgb/ with the images of color_left/",
    ),
    Known(("rgbd/", "metadata"), f"unzipped, {RECORD_3D}"),
    Known(("meta/info.json", "data/"), f"a dataset of LeRobot, of films and tables: of one episode {ARRAYS}"),
    *(
        Known(
            (f"{inside}*_geometry_hdf5/",),
            "a scene of Hypersim, in HDF5: of one camera write color as images into rgb/, and depth_meters, which are "
            f"lengths of rays, {AS_DEPTH} into depth/ (h5py)",
        )
        for inside in ("", "images/")
    ),
    Known(
        ("proj_depth/groundtruth/",),
        "a drive of KITTI's depth completion: link image_02/data as rgb/ and proj_depth/groundtruth/image_02 as "
        "depth/, and write depth_scale = 256 into a camera.toml",
    ),
    Known(
        ("groundtruth_depth/", "velodyne_raw/"),
        "single images of KITTI's depth completion: a drive is needed, whose frames follow each other",
    ),
    *(
        Known(
            (f"{name}_color_images/", f"{name}_depth_images/"),
            "photographs of Matterport3D, which turns by 60 degrees from one to the next: a film is needed, as Habitat "
            "renders one of its rooms",
        )
        for name in ("matterport", "undistorted")
    ),
    *(
        Known(
            (f"Depth {mode}*",),
            "a recording of HoloLens 2: write its images with save_pclouds.py of HoloLens2ForCV (StreamRecorder), and "
            "name the folder pinhole_projection",
        )
        for mode in ("Long Throw", "AHaT")
    ),
    *(
        Known((f"{inside}depth*.dpt",), "LINEMOD as first published: take it as BOP has it, which is read")
        for inside in ("", "data/")
    ),
    Known(
        ("stereo/depth_maps/",),
        "depth of COLMAP's stereo, whose unit is unknown and whose images are no film: an RGB-D camera's is needed",
    ),
)
"""Known kinds of folders; the first whose patterns fit is told."""


def words_of_known(path: Path) -> str | None:
    """What a folder is, and what helps, if it is of a known kind that is not read; else None."""
    return next((known.words for known in KNOWN if all(_has(path, pattern) for pattern in known.patterns)), None)


def _has(path: Path, pattern: str) -> bool:
    """Whether a folder has something for a pattern: a folder if that ends with a slash."""
    found = path.glob(pattern.rstrip("/"))
    return any(there.is_dir() or not pattern.endswith("/") for there in found)
