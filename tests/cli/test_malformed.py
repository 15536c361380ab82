"""Malformed sources, one after the other: status 2 and one line with the file, what was found and what would help."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from command import runner
from written_bags import COLOR, DEPTH, Recorder, Shot, record
from written_folders import (
    ARKIT_STAMPS,
    CAMERA,
    GREYS,
    LAYOUTS,
    METRES,
    POLYCAM_STAMPS,
    RTABMAP_STAMPS,
    image,
    raw,
)

SHOTS = [
    Shot(1 + i / 30, np.dstack([grey] * 3), raw(metres, 1000))
    for i, (grey, metres) in enumerate(zip(GREYS, METRES, strict=True))
]


def write(name: str, content: str | bytes) -> Callable[[Path], object]:
    return lambda clip: (clip / name).write_bytes(content if isinstance(content, bytes) else content.encode())


def edit(name: str, old: str, new: str) -> Callable[[Path], object]:
    def change(clip: Path) -> None:
        text = (clip / name).read_text()
        assert old in text
        (clip / name).write_text(text.replace(old, new))

    return change


def cut(name: str, keep: float) -> Callable[[Path], object]:
    def change(clip: Path) -> None:
        data = (clip / name).read_bytes()
        (clip / name).write_bytes(data[: int(len(data) * keep)])

    return change


def remove(name: str) -> Callable[[Path], object]:
    return lambda clip: shutil.rmtree(clip / name) if (clip / name).is_dir() else (clip / name).unlink()


def pixels(name: str, array: np.ndarray) -> Callable[[Path], object]:
    return lambda clip: image(clip / name, array)


def encoded(ending: str, array: np.ndarray) -> bytes:
    return cv2.imencode(ending, array)[1].tobytes()


SMALL = np.zeros((60, 80), np.uint8)
FIRST = "0.000000.png"
FOLDERS: dict[str, tuple[str, Callable[[Path], object], list[str]]] = {
    "tum: no depth list": ("tum", remove("depth.txt"), ["depth.txt", "no such file"]),
    "tum: a list of prose": ("tum", write("rgb.txt", "this is no list\n"), ["rgb.txt:1", "expected `timestamp path`"]),
    "tum: a stamp of text": (
        "tum",
        edit("rgb.txt", "0.000000 rgb", "noon rgb"),
        ["rgb.txt:2", "not a time stamp", "noon"],
    ),
    "tum: an empty list": ("tum", write("depth.txt", "# nothing\n"), ["depth.txt", "lists no images"]),
    "tum: a binary list": ("tum", write("rgb.txt", b"\x89PNG\xff\xfe"), ["rgb.txt", "not a text file"]),
    "tum: a list in UTF-16": (
        "tum",
        write("rgb.txt", f"0.0 rgb/{FIRST}\n".encode("utf-16")),
        ["rgb.txt", "not a text file (UTF-8)", "save it as UTF-8"],
    ),
    "tum: stamps of another day": (
        "tum",
        edit("depth.txt", "\n0.", "\n99990."),
        ["rgb.txt and depth.txt", "within 0.02 s"],
    ),
    "tum: a path out of it": (
        "tum",
        edit("rgb.txt", "rgb/0.0", "../../0.0"),
        ["rgb.txt:2", "leaves the sequence's folder"],
    ),
    "tum: a missing image": ("tum", remove(f"rgb/{FIRST}"), [FIRST, "missing", "restore"]),
    "tum: truth of prose": ("tum", write("groundtruth.txt", "x y z\n"), ["groundtruth.txt:1"]),
    "tum: no camera": ("tum", remove("camera.toml"), ["clip", "no camera known", "--camera"]),
    "tum: half a camera": ("tum", write("camera.toml", "fx = 131\n"), ["camera.toml", "fy: missing"]),
    "tum: a camera of text": (
        "tum",
        edit("camera.toml", "fx = 131.0", "fx = 'long'"),
        ["camera.toml: fx", "must be a number"],
    ),
    "tum: a camera of another size": (
        "tum",
        edit("camera.toml", "160", "320"),
        [FIRST, "160x120", "320x120", "--camera"],
    ),
    "tum: associations of three": (
        "associations",
        write("associations.txt", "0 a 0\n"),
        ["associations.txt:1", "expected"],
    ),
    "image: empty": ("tum", write(f"rgb/{FIRST}", b""), [FIRST, "empty file"]),
    "image: torn PNG": ("tum", cut(f"rgb/{FIRST}", 0.5), [FIRST, "truncated PNG", "again"]),
    "image: text": ("tum", write(f"rgb/{FIRST}", "hello"), [FIRST, "not an image", "hello"]),
    "image: torn JPEG": ("scannet", cut("color/0.jpg", 0.5), ["color/0.jpg", "truncated or damaged", "again"]),
    "image: torn JPEG, deep": ("replica", cut("results/frame000000.jpg", 0.9), ["frame000000.jpg", "or damaged"]),
    "image: another size": ("plain", pixels("rgb/0.png", SMALL), ["rgb/0.png", "80x60", "160x120", "--camera"]),
    "image: of floats": (
        "tum",
        write(f"rgb/{FIRST}", encoded(".tiff", METRES[0].astype(np.float32))),
        [FIRST, "8 or 16 bits"],
    ),
    "depth: of 8 bits": ("tum", pixels(f"depth/{FIRST}", GREYS[0]), [FIRST, "not a depth image", "16 bits", "8 bits"]),
    "depth: colour": (
        "tum",
        pixels(f"depth/{FIRST}", np.dstack([GREYS[0]] * 3)),
        [FIRST, "not a depth image", "3 channels"],
    ),
    "depth: a JPEG": ("tum", write(f"depth/{FIRST}", encoded(".jpg", GREYS[0])), [FIRST, "not a depth image"]),
    "depth: torn TIFF": ("plain", cut("depth/0.tiff", 0.5), ["depth/0.tiff", "truncated or damaged"]),
    "depth: torn array": ("one_folder", cut("depth_000.npy", 0.5), ["depth_000.npy", "not a NumPy array"]),
    "depth: array of text": (
        "one_folder",
        lambda clip: np.save(clip / "depth_000.npy", np.array([["a"]])),
        ["depth_000.npy", "not an image", "<U1"],
    ),
    "depth: another size": (
        "plain",
        pixels("depth/0.tiff", METRES[0][:60, :80].astype(np.float32)),
        ["depth/0.tiff", "80x60", "160x120", "[depth]", "colour_T_depth"],
    ),
    "depth: OpenEXR, torn": (
        "tum",
        lambda clip: (clip / f"depth/{FIRST}").write_bytes(b"\x76\x2f\x31\x01" + bytes(60)),
        [FIRST, "OpenEXR"],
    ),
    "depth: inches": (
        "plain",
        lambda clip: [image(clip / f"depth/{i}.tiff", (METRES[i] * 1e7).astype(np.float32)) for i in range(4)],
        ["depth/0.tiff", "neither metres nor millimetres", "--depth-scale"],
    ),
    "7-scenes: no depth": (
        "seven_scenes",
        lambda clip: [file.unlink() for file in clip.glob("*.depth.png")],
        ["clip", "a folder of", "not one of"],
    ),
    "7-scenes: a pose of prose": (
        "seven_scenes",
        write("frame-000002.pose.txt", "up"),
        ["000002.pose.txt", "four rows"],
    ),
    "7-scenes: a skewed pose": (
        "seven_scenes",
        lambda clip: np.savetxt(clip / "frame-000002.pose.txt", 3 * np.eye(4)),
        ["000002.pose.txt", "not a rotation"],
    ),
    "7-scenes: intrinsics of prose": (
        "seven_scenes",
        write("camera-intrinsics.txt", "wide"),
        ["camera-intrinsics.txt", "3x3"],
    ),
    "scannet: no common numbers": (
        "scannet",
        lambda clip: [file.rename(file.with_name(f"8{file.name}")) for file in list((clip / "depth").iterdir())],
        ["clip", "4 colour and 4 depth images", "same number"],
    ),
    "scannet: intrinsics of zeros": (
        "scannet",
        lambda clip: np.savetxt(clip / "intrinsic/intrinsic_color.txt", np.zeros((4, 4))),
        ["intrinsic_color.txt: ", "matrix is zero", "--camera"],
    ),
    "stray: frames of another size": (
        "stray",
        lambda clip: [image(clip / f"rgb/{i:06}.png", cv2.resize(GREYS[i], (320, 180))) for i in range(4)],
        ["clip: images of 320x180", "from a film of 1920x1440", "do not crop them"],
    ),
    "stray: poses of other frames": (
        "stray",
        edit("odometry.csv", ", 0000", ", 0050"),
        ["odometry.csv: contains no row for any"],
    ),
    "stray: poses of prose": ("stray", write("odometry.csv", "up\n"), ["odometry.csv:1: expected 9 numbers"]),
    "stray: depth of another shape": (
        "stray",
        lambda clip: [image(clip / f"depth/{i:06}.png", raw(METRES[i][:90], 1000)) for i in range(4)],
        ["depth/000000.png: is 160x90 pixels", "160x120", "colour_T_depth"],
    ),
    "scannet++: a list of frames": (
        "scannet_plus_plus",
        write("pose_intrinsic_imu.json", "[1, 2]"),
        ["pose_intrinsic_imu.json: not a JSON object"],
    ),
    "scannet++: frames of another name": (
        "scannet_plus_plus",
        edit("pose_intrinsic_imu.json", '"frame_000002"', '"img 2"'),
        ["pose_intrinsic_imu.json: 'img 2'", "frame_000000"],
    ),
    "scannet++: no camera": (
        "scannet_plus_plus",
        edit("pose_intrinsic_imu.json", '"intrinsic"', '"lens"'),
        ["pose_intrinsic_imu.json: contains no camera", "--camera"],
    ),
    "scannet++: a camera of four numbers": (
        "scannet_plus_plus",
        edit("pose_intrinsic_imu.json", '"intrinsic": [[131.0, 0.0, 79.5], [0.0', '"intrinsic": [[131.0, 0.0'),
        ["pose_intrinsic_imu.json: expected a camera matrix of nine numbers"],
    ),
    "scannet++: stamps of text": (
        "scannet_plus_plus",
        edit("pose_intrinsic_imu.json", '"timestamp": ', '"timestamp": "a", "then": '),
        ["pose_intrinsic_imu.json: timestamp: expected seconds", "--rate"],
    ),
    "scannet++: a pose of two rows": (
        "scannet_plus_plus",
        edit("pose_intrinsic_imu.json", '"aligned_pose": [[', '"aligned_pose": [[1, 0, 0, 0], [0, 1, 0, 0]], "b": [['),
        ["pose_intrinsic_imu.json: frame 0: expected a pose of four rows"],
    ),
    "bop: a list of cameras": ("bop", write("scene_camera.json", "[1]"), ["scene_camera.json: not a JSON object"]),
    "bop: cameras by name": ("bop", write("scene_camera.json", '{"left": {}}'), ["'left': expected the number of an"]),
    "bop: a matrix of eight": (
        "bop",
        write("scene_camera.json", '{"1": {"cam_K": [1, 0, 0, 0, 1, 0, 0, 0]}}'),
        ["scene_camera.json: expected a camera matrix of nine numbers"],
    ),
    "bop: no matrix": ("bop", write("scene_camera.json", '{"1": {}}'), ["contains no camera for any frame: pass"]),
    "bop: units that differ": (
        "bop",
        write("scene_camera.json", '{"1": {"depth_scale": 0.1}, "2": {"depth_scale": 1.0}}'),
        ["scene_camera.json: depth_scale: expected one number", "--depth-scale"],
    ),
    "bop: half a pose": (
        "bop",
        write(
            "scene_camera.json",
            json.dumps(
                {"1": {"cam_K": [131, 0, 79.5, 0, 131, 59.5, 0, 0, 1], "cam_R_w2c": [1], "cam_t_w2c": [0, 0, 0]}}
            ),
        ),
        ["scene_camera.json: image 1: expected nine numbers in cam_R_w2c"],
    ),
    "scanner app: half a frame's file": ("scanner_app", cut("frame_00001.json", 0.5), ["frame_00001.json: not JSON"]),
    "scanner app: text for a stamp": (
        "scanner_app",
        write("frame_00001.json", '{"time": "now", "cameraPoseARFrame": []}'),
        ["frame_00001.json: timestamp: expected seconds", "--rate"],
    ),
    "neural rgbd: a camera of prose": (
        "neural_rgbd",
        write("focal.txt", "wide"),
        ["focal.txt: expected a focal length"],
    ),
    "neural rgbd: poses of three numbers": (
        "neural_rgbd",
        write("poses.txt", "1 2 3"),
        ["poses.txt:1: expected a pose"],
    ),
    "semantic nerf: no poses": ("semantic_replica", write("traj_w_c.txt", ""), ["traj_w_c.txt: contains no traj"]),
    "polycam: a camera without numbers": (
        "polycam",
        lambda clip: [write(f"cameras/{file.name}", "{}")(clip) for file in list((clip / "cameras").iterdir())],
        ["cameras: fx: missing"],
    ),
    "polycam: half a camera's file": (
        "polycam",
        lambda clip: write(f"cameras/{POLYCAM_STAMPS[1] * 1e6:.0f}.json", '{"fx": 131.0, ')(clip),
        [".json: not JSON"],
    ),
    "polycam: a pose that is none": (
        "polycam",
        lambda clip: write(f"corrected_cameras/{POLYCAM_STAMPS[1] * 1e6:.0f}.json", '{"t_00": 2.0}')(clip),
        [".json: expected a pose"],
    ),
    "arkitscenes: cameras of two lenses": (
        "arkit_scenes",
        lambda clip: write(f"lowres_wide_intrinsics/41069021_{ARKIT_STAMPS[1]}.pincam", "160 120 140 131 79.5 59.5")(
            clip
        ),
        ["lowres_wide_intrinsics: the frames have different cameras", "fx differs by 9"],
    ),
    "arkitscenes: poses of prose": (
        "arkit_scenes",
        write("lowres_wide.traj", "up\n"),
        ["lowres_wide.traj:1: expected 7"],
    ),
    "nerf: poses of prose": ("nerf", edit("transforms.json", "0.0, 1.0", "0.0, 2.0"), ["transforms.json: frames[0]"]),
    "nerfstudio: half a file": ("nerfstudio", cut("transforms.json", 0.5), ["transforms.json: not JSON"]),
    "nerfstudio: depth of another folder": (
        "nerfstudio",
        edit("transforms.json", "./lidar/6.png", "../lidar/6.png"),
        ["transforms.json: frames[1]: depth_file_path: path leaves"],
    ),
    "nerfstudio: depth that is missing": ("nerfstudio", remove("lidar/6.png"), ["lidar/6.png: image is missing"]),
    "openloris: no sensors": ("open_loris", remove("sensors.yaml"), ["sensors.yaml: no such file", "--camera"]),
    "openloris: sensors of prose": (
        "open_loris",
        write("sensors.yaml", "%YAML:1.0\nwheels: 4\n"),
        ["sensors.yaml: camera_matrix: missing"],
    ),
    "openloris: no registered depth": (
        "open_loris",
        remove("aligned_depth.txt"),
        ["aligned_depth.txt: no such file", "unpack it"],
    ),
    "tartanair: depth that was not downloaded": (
        "tartan_air_2",
        remove("depth_lcam_front"),
        ["depth_lcam_front: no such folder beside image_lcam_front", "download it"],
    ),
    "tartanair: images that were scaled": (
        "tartan_air",
        remove("camera.yaml"),
        ["clip: images of 160x120", "rendered at 640x480 or 640x640", "--camera"],
    ),
    "tartanair: poses of prose": ("tartan_air", write("pose_left.txt", "up\n"), ["pose_left.txt:1: expected 7"]),
    "virtual kitti: depth that was not unpacked": (
        "virtual_kitti",
        remove("frames/depth"),
        ["depth/Camera_0: no such folder beside that of rgb: unpack depth, too"],
    ),
    "virtual kitti: poses of prose": (
        "virtual_kitti",
        write("extrinsic.txt", "up\n"),
        ["extrinsic.txt:1: expected the"],
    ),
    "airsim: a torn row": (
        "airsim",
        cut("airsim_rec.txt", 0.81),
        ["airsim_rec.txt:5: expected 10 tab-separated values"],
    ),
    "airsim: a file of prose": (
        "airsim",
        write("airsim_rec.txt", "up\n"),
        ["airsim_rec.txt: expected tab-separated column names"],
    ),
    "airsim: no camera": ("airsim", remove("camera.toml"), ["clip: no camera file in it", "--camera"]),
    "rtabmap: a camera of prose": (
        "rtabmap",
        write(f"calib/{RTABMAP_STAMPS[1]}.yaml", "wide"),
        [f"{RTABMAP_STAMPS[1]}.yaml", "not a camera file"],
    ),
    "rtabmap: depth of a smaller size": (
        "rtabmap",
        pixels(f"depth/{RTABMAP_STAMPS[0]}.png", SMALL.astype(np.uint16) + 1000),
        [f"{RTABMAP_STAMPS[0]}.png", "80x60", "160x120", "[depth]"],
    ),
    "replica: short trajectory rows": ("replica", write("traj.txt", "1 0 0 0\n"), ["traj.txt:1", "found 4 fields"]),
    "replica: cameras of prose": ("replica", write("cam_params.json", "none"), ["cam_params.json", "not JSON"]),
    "replica: a list for a camera": (
        "replica",
        write("cam_params.json", '{"camera": {"w": 3}}'),
        ["cam_params.json", "Replica"],
    ),
    "open3d: torn intrinsics": ("open3d", cut("camera_intrinsic.json", 0.5), ["camera_intrinsic.json", "not JSON"]),
    "open3d: short matrix": (
        "open3d",
        write("camera_intrinsic.json", json.dumps({"width": 160, "height": 120, "intrinsic_matrix": [1, 2]})),
        ["camera_intrinsic.json", "Open3D"],
    ),
    "open3d: a log of prose": (
        "open3d",
        write("trajectory.log", "left, then right\n"),
        ["trajectory.log:1", "three whole numbers", "left then right"],
    ),
    "tum: icl's truth, twice": (
        "associations",
        lambda clip: [write(f"{i}.gt.freiburg", "1 0 0 0 0 0 0 1\n")(clip) for i in "ab"],
        ["clip: contains both a.gt.freiburg and b.gt.freiburg", "keep only one"],
    ),
    "plain: no camera": ("plain", remove("camera.yaml"), ["clip", "no camera file", "no camera known", "--camera"]),
    "plain: YAML that is none": ("plain", write("camera.yaml", "fx: [1, 2"), ["camera.yaml", "not YAML"]),
    "plain: stamps that never meet": (
        "plain",
        lambda clip: [
            file.rename(file.with_name(f"{day}0.{file.stem}5{file.suffix}"))
            for day, part in ((1, "rgb"), (2, "depth"))
            for file in list((clip / part).iterdir())
        ],
        ["clip", "within 0.02 s", "--rate"],
    ),
    "plain: colour of another ending": (
        "plain",
        lambda clip: [file.rename(file.with_suffix(".raw")) for file in list((clip / "rgb").iterdir())],
        ["clip: no colour images in rgb (0.raw, 1.raw)", "ending in .png"],
    ),
    "plain: folders of other names": (
        "plain",
        lambda clip: (clip / "depth").rename(clip / "range"),
        ["clip: a folder of camera.yaml, range/, rgb/", "depth is looked for in aligned_depth"],
    ),
    "plain: numbers longer than any float": (
        "plain",
        lambda clip: [
            file.rename(file.with_name(f"9{int(file.stem):017}{file.suffix}"))
            for part in ("rgb", "depth")
            for file in list((clip / part).iterdir())
        ],
        ["clip: no frame", "same number"],
    ),
    "replica: no pose": ("replica", write("traj.txt", ""), ["traj.txt", "contains no trajectory"]),
    "scannet: a pose on its side": (
        "scannet",
        lambda clip: np.savetxt(clip / "pose/1.txt", np.eye(4) + np.eye(4, k=-3)),
        ["pose/1.txt", "not a rotation and translation"],
    ),
    "tum: names with blanks": (
        "tum",
        edit("rgb.txt", "rgb/", "my rgb/"),
        ["rgb.txt:2", "expected `timestamp path`, with no blanks", "3 fields"],
    ),
    "tum: a folder for an image": (
        "tum",
        lambda clip: [remove(f"rgb/{FIRST}")(clip), (clip / f"rgb/{FIRST}").mkdir()],
        [FIRST, "not a file", "restore"],
    ),
    "kalibr: another kind of camera": (
        "plain",
        write("camera.yaml", "cam0:\n  camera_model: omni\n"),
        ["camera.yaml: camera_model 'omni': only pinhole"],
    ),
    "plain: only colour": ("plain", remove("depth"), ["clip: a folder of", "no folder of depth beside rgb/"]),
    "nothing at all": (
        "plain",
        lambda clip: [remove(n)(clip) for n in ("rgb", "depth", "camera.yaml")],
        ["an empty folder"],
    ),
    "one frame": ("plain", lambda clip: [remove(f"rgb/{i}.png")(clip) for i in (1, 2, 3)], ["clip", "at least 2"]),
}


def torn_bag(path: Path) -> Path:
    found = record(path / "x", "ros1", "raw", SHOTS, CAMERA)
    cut("x.bag", 0.4)(path)
    return found


def no_images(path: Path) -> Path:
    recorder = Recorder(path / "x.bag", "ros1")
    recorder.info("/camera_info", 1.0, CAMERA)
    recorder.close()
    return path / "x.bag"


def two_colours(path: Path) -> Path:
    recorder = Recorder(path / "x", "mcap")
    for topic in ("/left", "/right"):
        recorder.image(topic, 1.0, GREYS[0], "mono8")
    recorder.image("/depth", 1.0, SHOTS[0].depth, "16UC1")
    recorder.close()
    return path / "x"


def odd_encoding(path: Path) -> Path:
    recorder = Recorder(path / "x", "sqlite")
    for stamp in (1.0, 1.1):
        recorder.info("/camera/color/camera_info", stamp, CAMERA)
        recorder.image(COLOR, stamp, SHOTS[0].bgr, "nv24")
        recorder.image(DEPTH, stamp, SHOTS[0].depth, "16UC1")
    recorder.close()
    return path / "x"


def no_metadata(path: Path) -> Path:
    (path / "x").mkdir()
    (path / "x" / "metadata.yaml").write_text("hello: there\n")
    return path / "x"


def file_of(name: str, content: bytes) -> Callable[[Path], Path]:
    def make(path: Path) -> Path:
        (path / name).write_bytes(content)
        return path / name

    return make


def euroc(path: Path) -> Path:
    for camera in ("cam0", "cam1"):
        image(path / f"room/mav0/{camera}/data/1403636579763555584.png", GREYS[0])
    return path / "room"


def nyu(path: Path) -> Path:
    (path / "room").mkdir()
    for name in ("a-1.0-1.dump", "d-1.0-1.pgm", "r-1.0-1.ppm", "INDEX.txt"):
        (path / "room" / name).write_bytes(b"x")
    return path / "room"


OTHERS: dict[str, tuple[Callable[[Path], Path], list[str]]] = {
    "nowhere": (lambda path: path / "nowhere", ["nowhere", "no such folder or file", "synthetic"]),
    "a path that cannot be": (lambda path: path / ("x" * 300), ["unusable"]),
    "a film": (file_of("walk.mp4", bytes(100)), ["walk.mp4", "a film", "frames as images"]),
    "record3d": (file_of("walk.r3d", b"PK"), ["walk.r3d", "Record3D", "EXR + RGB"]),
    "nyu": (nyu, ["room: a raw recording of NYU Depth", "toolbox", "rgb/ and depth/"]),
    "euroc": (euroc, ["mav0/cam0: a recording in the layout of EuRoC", "without depth"]),
    "bag: empty": (file_of("x.bag", b""), ["x.bag", "cannot be read as a bag"]),
    "bag: text": (file_of("x.bag", b"hello"), ["x.bag", "cannot be read as a bag"]),
    "bag: torn": (torn_bag, ["x.bag"]),
    "bag: no images": (no_images, ["x.bag", "contains no images", "sensor_msgs"]),
    "bag: never closed": (file_of("x.bag.active", b"#ROSBAG V2.0\n"), ["x.bag.active", "never closed", "reindex"]),
    "an archive": (file_of("clip.tgz", b"\x1f\x8b"), ["clip.tgz", "packed", "tar -xf"]),
    "mcap: text": (file_of("x.mcap", b"hello"), ["x.mcap", "cannot be read as a bag"]),
    "db3: text": (file_of("x.db3", b"hello" * 300), ["x.db3", "cannot be read as a bag"]),
    "mcap: several colours": (two_colours, ["/left, /right", "--colour-topic"]),
    "mcap: no camera": (lambda path: record(path / "x", "mcap", "raw", SHOTS, None), ["no camera_info", "--camera"]),
    "sqlite: odd encoding": (odd_encoding, [COLOR, "nv24"]),
    "ros 2: metadata of something else": (no_metadata, ["x", "cannot be read as a bag"]),
}


def test_there_are_at_least_forty():
    assert len(FOLDERS) + len(OTHERS) >= 40


def refuse(capsys: pytest.CaptureFixture[str], source: Path, words: list[str]) -> None:
    for command in ("run", "inspect"):
        done = runner(capsys)(command, source)
        assert done.status == 2 and not done.out, done
        assert done.err.startswith("gavo: ") and done.err.count("\n") == 1 and len(done.err) < 700, done.err
        assert all(word in done.err for word in words), done.err


@pytest.mark.parametrize("name", FOLDERS)
def test_a_malformed_folder(capfd, tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    layout, damage, words = FOLDERS[name]
    clip = tmp_path / "clip"
    clip.mkdir() if layout != "tum" else None
    LAYOUTS[layout][1](clip)
    damage(clip)
    refuse(capfd, clip, [str(clip), *words])
    assert [path.name for path in tmp_path.iterdir()] == ["clip"]


@pytest.mark.parametrize("name", OTHERS)
def test_another_malformed_source(capfd, tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    make, words = OTHERS[name]
    refuse(capfd, make(tmp_path), [str(tmp_path), *words])
    assert not (tmp_path / "runs").exists()
