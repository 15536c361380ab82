"""Datasets and recordings that cannot be read: how to recognise their folders, and how to convert them."""

from pathlib import Path
from typing import NamedTuple

ARRAYS = "write its colour and depth as images into rgb/ and depth/, or as one .npy per frame"

RECORD_3D = "a Record3D recording: export it in the app as EXR + RGB, and pass the folder with rgb/ and depth/"

AS_DEPTH = "as z = length / sqrt(1 + x^2 + y^2)"


class Known(NamedTuple):
    """A kind of folder that is recognised, but cannot be read."""

    patterns: tuple[str, ...]
    """Glob patterns; the folder has a match for each."""
    words: str
    """What it is, and how to convert it."""


KNOWN = (
    Known(
        ("d-*.pgm", "r-*.ppm"),
        "a raw recording of NYU Depth, whose depth is in units of disparity: write rgb/ and depth/ with the "
        "dataset's toolbox first",
    ),
    Known(
        ("data.jsonl", "calibration.json"),
        "a Spectacular AI recording: extract its images with sai-cli process, and pass the folder of transforms.json",
    ),
    Known(
        ("depth.bin", "pose_intrinsic_imu.json"),
        "the iPhone's part of a ScanNet++ scan, its images still packed: write rgb/ and depth/ with "
        "iphone/prepare_iphone_data.py of its toolbox (extract_rgb, extract_depth)",
    ),
    Known(
        ("color_left/trajectory_*",),
        "recordings of Mid-Air, whose PNG contain 16-bit floats: for a trajectory, write depth = 512 / disparity from "
        "stereo_disparity/ as TIFF or .npy of floats into depth/, beside rgb/ with the images of color_left/",
    ),
    Known(("rgbd/", "metadata"), f"the contents of {RECORD_3D}"),
    Known(("meta/info.json", "data/"), f"a LeRobot dataset of films and tables: for one episode, {ARRAYS}"),
    *(
        Known(
            (f"{inside}*_geometry_hdf5/",),
            "a Hypersim scene in HDF5: for one camera, write color as images into rgb/, and depth_meters, which are "
            f"ray lengths, {AS_DEPTH} into depth/ (h5py)",
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
        "single images of KITTI's depth completion: expected a drive, with consecutive frames",
    ),
    *(
        Known(
            (f"{name}_color_images/", f"{name}_depth_images/"),
            "photographs of Matterport3D, 60 degrees apart: expected consecutive frames, such as Habitat "
            "renders of its rooms",
        )
        for name in ("matterport", "undistorted")
    ),
    *(
        Known(
            (f"Depth {mode}*",),
            "a HoloLens 2 recording: extract its images with save_pclouds.py of HoloLens2ForCV (StreamRecorder), and "
            "pass the folder pinhole_projection",
        )
        for mode in ("Long Throw", "AHaT")
    ),
    *(
        Known((f"{inside}depth*.dpt",), "LINEMOD as first published: use its BOP version, which is read")
        for inside in ("", "data/")
    ),
    Known(
        ("wide/", "highres_depth/"),
        "ARKitScenes in high resolution: in another folder, link wide/ as lowres_wide/, highres_depth/ as "
        "lowres_depth/, wide_intrinsics/ as lowres_wide_intrinsics/, and lowres_wide.traj",
    ),
    *(
        Known(
            patterns,
            "a scene rendered for NeRF, whose views are not consecutive, and whose depth is a picture of 8 bits: "
            "expected consecutive frames with depth of 16 bits or floats",
        )
        for patterns in (("transforms_train.json", "train/"), ("r_*.png", "r_*_depth_*.png"))
    ),
    Known(
        ("stereo/depth_maps/",),
        "depth maps of COLMAP's stereo, whose unit is unknown and whose images are not consecutive: expected those of "
        "an RGB-D camera",
    ),
)
"""Known kinds of folders; the first whose patterns match counts."""


def words_of_known(path: Path) -> str | None:
    """Describe a folder of a known kind and how to convert it; None if it is of no such kind."""
    return next((known.words for known in KNOWN if all(_has(path, pattern) for pattern in known.patterns)), None)


def _has(path: Path, pattern: str) -> bool:
    """Whether a folder contains a match for a pattern: a folder if the pattern ends with a slash."""
    found = path.glob(pattern.rstrip("/"))
    return any(there.is_dir() or not pattern.endswith("/") for there in found)
