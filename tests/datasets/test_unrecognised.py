"""Where no source is, the message says what is there and what would help."""

from pathlib import Path

import pytest

from gavo_jax.datasets import unrecognised
from gavo_jax.datasets.registry import open_source, source_around
from gavo_jax.errors import GavoError


def made(folder: Path, *names: str) -> Path:
    for name in names:
        path = folder / name
        path.mkdir(parents=True) if name.endswith("/") else path.parent.mkdir(parents=True, exist_ok=True)
        if not name.endswith("/"):
            path.write_bytes(b"x")
    return folder


@pytest.mark.parametrize(
    ("names", "words"),
    [
        ((), "an empty folder, not one of: "),
        (("walk.tar.xz",), r"walk\.tar\.xz: packed: unpack it first \(tar -xf\)"),
        (("walk.oni", "notes.md"), r"walk\.oni: an OpenNI recording: extract its images and depth"),
        (("walk.MP4", "notes.md"), r"walk\.MP4: a film: write its frames as images"),
        (("mav0/cam0/data/1.png",), "cam0: a recording in the layout of EuRoC: stereo images without depth"),
        (
            ("cam0/data/1.png", "depth0/data/1.png"),
            "depth0: link its images as depth/, beside rgb/; InteriorNet's are ray lengths",
        ),
        (("data.jsonl", "calibration.json", "data.mkv"), "a Spectacular AI recording: .* sai-cli process, and"),
        (
            ("depth.bin", "pose_intrinsic_imu.json", "rgb.mkv", "rgb_mask.mkv", "exif.json"),
            r"ScanNet\+\+ scan, its images still packed: write rgb/ and depth/ with iphone/prepare_iphone_data.py",
        ),
        (("depth.bin", "pose_intrinsic_imu.json", "rgb/frame_000000.jpg"), "still packed: write rgb/ and depth/"),
        (
            tuple(f"{kind}/trajectory_0000/000000.x" for kind in ("color_left", "depth", "stereo_disparity")),
            r"Mid-Air, whose PNG contain 16-bit floats: .* 512 / disparity",
        ),
        (("rgb/rgb_0000.png", "distance_to_camera/distance_to_camera_0000.npy"), "distance_to_camera: ray lengths"),
        (
            ("rgb_0000.png", "distance_to_camera_0000.npy"),
            r"distance_to_camera_0000\.npy: ray lengths from Replicator",
        ),
        (("photo/0.jpg", "depth/0.png", "instance/0.png"), "depth/: SceneNet RGB-D stores ray lengths"),
        (("color.zip", "depth.zip"), r"color\.zip: packed: unpack it first \(unzip\)"),
        (("rgb/0.png", "depth.tar.gz"), r"depth\.tar\.gz: packed: unpack it first \(tar -xf\)"),
        (("rgb.mp4", "depth.mkv"), r"depth\.mkv: a film of depth: if it has 16 bits, write its frames as images"),
        (("demo.hdf5", "model/"), r"; demo\.hdf5: arrays in HDF5: write its colour and depth as images"),
        (("scan.ply", "notes.md"), r"; scan\.ply: a model or a point cloud, without the images"),
        (("scan.ply", "parts/"), "colour is looked for in "),
        (("out_Color_1.5.raw", "out_Depth_1.5.raw"), r"1\.5\.raw: images without a header: .* pass the \.bag"),
        (("metadata", "rgbd/0.jpg", "rgbd/0.depth"), r"the contents of a Record3D recording: export it"),
        (("meta/info.json", "data/chunk-000/", "videos/"), "a LeRobot dataset of films and tables: for one"),
        (
            tuple(f"{i:04}/{kind}.png" for i in range(3) for kind in ("color", "depth")),
            "3 folders of one frame each, such as 0000: if they belong to one recording, link their images into rgb/",
        ),
        (
            tuple(f"{camera}_{kind}/0.png" for camera in ("front", "wrist") for kind in ("rgb", "depth", "mask")),
            r"2 colour folders have a depth folder beside them \(front_rgb, wrist_rgb\): link one pair as rgb/",
        ),
        (("d-1.pgm", "r-1.ppm"), "a raw recording of NYU Depth"),
        (("rgb/",), "a folder of rgb/, and "),
        (("images/scene_cam_00_geometry_hdf5/frame.0000.depth_meters.hdf5",), "Hypersim scene in HDF5: .* ray lengths"),
        (("scene_cam_00_final_hdf5/x.hdf5", "scene_cam_00_geometry_hdf5/x.hdf5"), "Hypersim scene in HDF5"),
        (
            ("image_02/data/0.png", "proj_depth/groundtruth/image_02/0.png"),
            "KITTI's depth completion: link image_02/data as rgb/ .* depth_scale = 256",
        ),
        (("image/0.png", "groundtruth_depth/0.png", "velodyne_raw/0.png"), "single images of KITTI's depth completion"),
        (
            tuple(f"{a}_{b}_images/0.png" for a in ("matterport", "undistorted") for b in ("color", "depth")),
            "photographs of Matterport3D, 60 degrees apart",
        ),
        (
            ("PV/1.bytes", "Depth Long Throw/1.pgm", "Depth Long Throw_lut.bin"),
            "HoloLens 2 recording: .*pinhole_projection",
        ),
        (("PV.tar", "Depth AHaT.tar"), "HoloLens 2 recording: .*pinhole_projection"),
        (("data/color0.jpg", "data/depth0.dpt"), "LINEMOD as first published: use its BOP version"),
        (
            ("images/0.jpg", "stereo/depth_maps/0.jpg.geometric.bin"),
            "depth maps of COLMAP's stereo, whose unit is unknown",
        ),
        (
            ("wide/1_0.1.png", "highres_depth/1_0.1.png", "wide_intrinsics/1_0.1.pincam"),
            "ARKitScenes in high resolution: in another folder, link wide/ as lowres_wide/",
        ),
        (("transforms_train.json", "train/r_0.png", "test/r_0.png"), "scene rendered for NeRF, whose views are not"),
        (("r_0.png", "r_0_depth_0001.png", "r_0_normal_0001.png"), "scene rendered for NeRF, .* picture of 8 bits"),
        (("1.jpg", "1.png", "2.jpg", "2.png", "a.txt"), r"1\.jpg beside 1\.png: put depth into depth/, and"),
        (("frame1.jpg", "frame1.npy"), r"frame1\.jpg beside frame1\.npy: put depth into depth/"),
        (("rgb/walk.mp4", "depth/0.png"), r"no colour images in rgb \(walk\.mp4\): a film goes .*, as rgb\.mp4"),
        (
            ("rgb/0.png", "depth/0.jpg"),
            r"no depth images in depth \(0\.jpg\): these are pictures of depth: write",
        ),
        (("rgb/0.png", "depth/0.bin"), r"no depth images in depth \(0\.bin\): expected names ending in \.png, "),
        (("notes.md", "more.md"), "a folder of more.md, notes.md: not one of: "),
        (("a/", "b.md"), "colour is looked for in "),
        (tuple(f"{k}.md" for k in range(9)), r"a folder of 0\.md, 1\.md, 2\.md, 3\.md, 4\.md and 4 more"),
    ],
)
def test_a_folder_is_described(tmp_path: Path, names: tuple[str, ...], words: str) -> None:
    folder = made(tmp_path / "there", *names)
    folder.mkdir(exist_ok=True)
    with pytest.raises(GavoError, match=words) as caught:
        open_source(folder)
    assert str(caught.value).startswith(f"{folder}: ")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("walk.bag.active", "was never closed"),
        ("walk.txt", "a file of 1 bytes, not one of: "),
        ("nyu_depth_v2_labeled.mat", r"labeled\.mat: MATLAB arrays: write its colour and depth as images into rgb/"),
        ("walk.npz", r"walk\.npz: Python arrays: write its colour and depth"),
        ("walk.parquet", r"walk\.parquet: a table: write its colour and depth"),
        ("walk.USDZ", r"walk\.USDZ: a model or a point cloud"),
    ],
)
def test_a_file_is_described(tmp_path: Path, name: str, words: str) -> None:
    with pytest.raises(GavoError, match=words):
        open_source(made(tmp_path, name) / name)


def test_sources_nearby_are_named(tmp_path: Path) -> None:
    scene = made(tmp_path / "scene", "seq-01/frame-000000.color.png", "seq-01/frame-000000.depth.png")
    with pytest.raises(GavoError, match=f"not a source itself, but a folder of one: pass {scene / 'seq-01'}$"):
        open_source(scene)
    image = scene / "seq-01" / "frame-000000.color.png"
    assert source_around(image) == scene / "seq-01" and source_around(scene) is None
    with pytest.raises(GavoError, match=f"a file inside a source: pass its folder, {scene / 'seq-01'}"):
        open_source(image)
    with pytest.raises(GavoError, match=f"a folder inside a source: pass the source, {scene / 'seq-01'}"):
        open_source(made(scene / "seq-01", "more/notes.md") / "more")


def test_a_source_further_down_is_named(tmp_path: Path) -> None:
    """Of a dataset's root the list of all kinds said nothing."""
    folder = made(tmp_path / "root", "notes.md", "kv1/.hidden/0.png", "kv1/sun/notes.md", "scenes/chess/rgb/0.png")
    made(folder, "scenes/chess/depth/0.png")
    with pytest.raises(
        GavoError, match=f"root: not a source itself, but contains one: pass {folder / 'scenes/chess'}$"
    ):
        open_source(folder)


def test_a_source_four_folders_down_is_named(tmp_path: Path) -> None:
    """As BlenderProc writes its scenes."""
    folder = made(tmp_path / "output", *(f"bop_data/set/train_pbr/000000/{kind}/0.png" for kind in ("rgb", "depth")))
    with pytest.raises(GavoError, match=f"contains one: pass {folder / 'bop_data/set/train_pbr/000000'}$"):
        open_source(folder)


def test_a_link_in_a_circle_is_passed_over(tmp_path: Path) -> None:
    folder = made(tmp_path / "there", "notes.md", "seq-01/frame-000000.color.png", "seq-01/frame-000000.depth.png")
    (folder / "circle").symlink_to("circle")
    with pytest.raises(GavoError, match=f"not a source itself, but a folder of one: pass {folder / 'seq-01'}$"):
        open_source(folder)


def test_the_last_guess_always_has_words(tmp_path: Path) -> None:
    place = unrecognised.Place(tmp_path, [], "", lambda _: False)
    assert unrecognised.GUESSES[-1](place)
