"""The same few frames written in the layouts of several datasets."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from gavo_jax.camera import Camera
from gavo_jax.datasets.depth_unit import KINECT_STEP
from gavo_jax.datasets.layouts.tum_writing import write_tum
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.trajectory import quaternion_from_rotation

CAMERA = Camera(131.0, 131.0, 79.5, 59.5, 160, 120)
ROOM = SyntheticSequence(frames=4, camera=CAMERA)
GREYS, DEPTHS = [frame.grey for frame in ROOM], [frame.depth for frame in ROOM]
METRES = [depth / CAMERA.depth_scale for depth in DEPTHS]
assert ROOM.ground_truth is not None
POSES = ROOM.ground_truth.interpolate(ROOM.timestamps)[0]
STRAY_STAMPS = [round(9000.5 + i / 60, 6) for i in range(4)]
ARKIT_STAMPS = [f"{4097.9 + i / 30:.3f}" for i in range(4)]
MATRIX = np.array([[131.0, 0, 79.5], [0, 131.0, 59.5], [0, 0, 1]])


def image(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".npy":
        np.save(path, pixels)
    else:
        path.write_bytes(cv2.imencode(path.suffix, pixels)[1].tobytes())


def raw(metres: np.ndarray, scale: float, none: int = 0) -> np.ndarray:
    return np.where(metres > 0, np.round(metres * scale), none).astype(np.uint16)


def kinect(metres: np.ndarray, scale: float) -> np.ndarray:
    """As a first Kinect returns it: in steps of disparity."""
    return np.round(scale / (np.round(1 / metres / KINECT_STEP) * KINECT_STEP)).astype(np.uint16)


def seven_scenes(folder: Path) -> None:
    for i, (grey, metres, pose) in enumerate(zip(GREYS, METRES, POSES, strict=True)):
        image(folder / f"frame-{i:06}.color.png", grey)
        image(folder / f"frame-{i:06}.depth.png", raw(metres, 1000, 65535))
        np.savetxt(folder / f"frame-{i:06}.pose.txt", pose, delimiter="\t ")
    np.savetxt(folder / "camera-intrinsics.txt", MATRIX)


def scannet(folder: Path) -> None:
    four = np.eye(4)
    four[:3, :3] = MATRIX
    for i, (grey, metres, pose) in enumerate(zip(GREYS, METRES, POSES, strict=True)):
        image(folder / f"color/{i}.jpg", grey)
        image(folder / f"depth/{i}.png", raw(metres, 1000))
        (folder / "pose").mkdir(exist_ok=True)
        np.savetxt(folder / f"pose/{i}.txt", pose if i != 2 else np.full((4, 4), -np.inf))
    (folder / "intrinsic").mkdir()
    for name in ("color", "depth"):
        np.savetxt(folder / f"intrinsic/intrinsic_{name}.txt", four)
        np.savetxt(folder / f"intrinsic/extrinsic_{name}.txt", np.eye(4))


def replica(folder: Path) -> None:
    for i, (grey, metres) in enumerate(zip(GREYS, METRES, strict=True)):
        image(folder / f"results/frame{i:06}.jpg", grey)
        image(folder / f"results/depth{i:06}.png", raw(metres, 6553.5))
    np.savetxt(folder / "traj.txt", POSES.reshape(-1, 16))
    camera = {"w": 160, "h": 120, "fx": 131.0, "fy": 131.0, "cx": 79.5, "cy": 59.5, "scale": 6553.5}
    (folder / "cam_params.json").write_text(json.dumps({"camera": camera}))


def open3d(folder: Path, color: str = "color") -> None:
    for i, (grey, metres) in enumerate(zip(GREYS, METRES, strict=True)):
        image(folder / f"{color}/{i + 1:06}.jpg", grey)
        image(folder / f"depth/{i + 1:06}.png", raw(metres, 1000))
    intrinsics = {"width": 160, "height": 120, "intrinsic_matrix": MATRIX.T.ravel().tolist()}
    (folder / "camera_intrinsic.json").write_text(json.dumps(intrinsics))


def open3d_image(folder: Path) -> None:
    open3d(folder, "image")


def plain(folder: Path) -> None:
    for i, (grey, metres) in enumerate(zip(GREYS, METRES, strict=True)):
        image(folder / f"rgb/{i}.png", grey)
        image(folder / f"depth/{i}.tiff", metres.astype(np.float32))
    (folder / "camera.yaml").write_text("fx: 131\nfy: 131\ncx: 79.5\ncy: 59.5\nwidth: 160\nheight: 120\n")


def one_folder(folder: Path) -> None:
    for i, (grey, metres) in enumerate(zip(GREYS, METRES, strict=True)):
        image(folder / f"color_{i:03}.png", grey)
        image(folder / f"depth_{i:03}.npy", metres.astype(np.float32))
    (folder / "intrinsics.txt").write_text("131 131 79.5 59.5\n")


def stray(folder: Path) -> None:
    """As Stray Scanner leaves it, at 60 Hz; the film's frames written at depth's size, its camera that of the film."""
    film = np.array([[12 * 131.0, 0, 959.5], [0, 12 * 131.0, 719.5], [0, 0, 1]])
    rows = ["timestamp, frame, x, y, z, qx, qy, qz, qw"]
    for i, (grey, metres, pose) in enumerate(zip(GREYS, METRES, POSES, strict=True)):
        image(folder / f"rgb/{i:06}.png", grey)
        image(folder / f"depth/{i:06}.png", raw(metres, 1000))
        numbers = [*pose[:3, 3], *quaternion_from_rotation(pose[:3, :3])]
        rows.append(f"{STRAY_STAMPS[i]}, {i:06}, {', '.join(map(str, numbers))}")
    np.savetxt(folder / "camera_matrix.csv", film, delimiter=", ")
    (folder / "odometry.csv").write_text("\n".join(rows) + "\n")


def arkit_scenes(folder: Path) -> None:
    """Poses are axis, angle and shift of the world into the camera; each frame has its camera."""
    rows = []
    for stamp, grey, metres, pose in zip(ARKIT_STAMPS, GREYS, METRES, POSES, strict=True):
        image(folder / f"lowres_wide/41069021_{stamp}.png", grey)
        image(folder / f"lowres_depth/41069021_{stamp}.png", raw(metres, 1000))
        pincam = folder / f"lowres_wide_intrinsics/41069021_{stamp}.pincam"
        pincam.parent.mkdir(exist_ok=True)
        pincam.write_text("160 120 131 131 79.5 59.5\n")
        camera_T_world = np.linalg.inv(pose)
        turn = cv2.Rodrigues(camera_T_world[:3, :3])[0].ravel()
        rows.append(" ".join(map(str, [stamp, *turn, *camera_T_world[:3, 3]])))
    (folder / "lowres_wide.traj").write_text("\n".join(rows) + "\n")


def nerf(folder: Path) -> None:
    """NeRF's cameras look along -z, their y points up."""
    frames = []
    for i, (grey, metres, pose) in enumerate(zip(GREYS, METRES, POSES, strict=True), 1):
        image(folder / f"images/frame_{i:05}.png", grey)
        image(folder / f"depths/frame_{i:05}.png", raw(metres, 1000))
        matrix = (pose @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist()
        frames.append({"file_path": f"./images/frame_{i:05}.png", "transform_matrix": matrix})
    camera = {"fl_x": 131.0, "fl_y": 131.0, "cx": 79.5, "cy": 59.5, "w": 160, "h": 120}
    (folder / "transforms.json").write_text(json.dumps({**camera, "frames": frames[::-1]}))


def nerfstudio(folder: Path) -> None:
    """The same, and the file names depth, which counts otherwise; that in `depth/` is another's."""
    nerf(folder)
    (folder / "lidar").mkdir()
    for i in range(1, 5):
        (folder / f"depths/frame_{i:05}.png").rename(folder / f"lidar/{9 - i}.png")
        image(folder / f"depth/frame_{i:05}.png", np.full((120, 160), 2000, np.uint16))
    values = json.loads((folder / "transforms.json").read_text())
    for frame in values["frames"]:
        frame["depth_file_path"] = f"./lidar/{9 - int(frame['file_path'][-9:-4])}.png"
    (folder / "transforms.json").write_text(json.dumps(values))


PLUS_STAMPS = [round(71234.25 + i / 60, 6) for i in range(4)]


def scannet_plus_plus(folder: Path) -> None:
    """As its toolbox leaves the iPhone's part; the poses of ARKit's own world lie there, too."""
    frames: dict[str, object] = {}
    for i, (grey, metres, pose) in enumerate(zip(GREYS, METRES, POSES, strict=True)):
        image(folder / f"rgb/frame_{i:06}.jpg", grey)
        image(folder / f"depth/frame_{i:06}.png", raw(metres, 1000))
        elsewhere = np.eye(4) + np.eye(4, k=3)
        frames[f"frame_{i:06}"] = {
            "timestamp": PLUS_STAMPS[i],
            "pose": (elsewhere @ pose).tolist(),
            "aligned_pose": pose.tolist(),
            "intrinsic": MATRIX.tolist(),
            "imu": [],
        }
    (folder / "pose_intrinsic_imu.json").write_text(json.dumps(frames))


POLYCAM_STAMPS = [round(7123.456789 + i / 30, 6) for i in range(4)]


def polycam(folder: Path) -> None:
    """Its `keyframes/`: names are microseconds; the corrected poses are better than the others."""
    for stamp, grey, metres, pose in zip(POLYCAM_STAMPS, GREYS, METRES, POSES, strict=True):
        name = str(round(stamp * 1e6))
        image(folder / f"images/{name}.jpg", grey)
        image(folder / f"depth/{name}.png", raw(metres, 1000))
        image(folder / f"confidence/{name}.png", np.full((120, 160), 255, np.uint8))
        for kind, shift in (("cameras", 1.0), ("corrected_cameras", 0.0)):
            matrix = pose @ np.diag([1.0, -1.0, -1.0, 1.0]) + shift * np.eye(4, k=3)
            values = {f"t_{row}{column}": matrix[row, column] for row in range(3) for column in range(4)}
            camera = {"fx": 131.0, "fy": 131.0, "cx": 79.5, "cy": 59.5, "width": 160, "height": 120}
            (folder / kind).mkdir(exist_ok=True)
            (folder / f"{kind}/{name}.json").write_text(json.dumps({**camera, **values, "blur_score": 90.0}))


SCANNER_STAMPS = [round(5123.25 + i / 15, 6) for i in range(4)]


def scanner_app(folder: Path) -> None:
    """As 3D Scanner App exports all data: depth and cameras of frames without an image, too."""
    for i, (grey, metres, pose) in enumerate(zip(GREYS, METRES, POSES, strict=True)):
        image(folder / f"frame_{i:05}.jpg", grey)
        image(folder / f"depth_{i:05}.png", raw(metres, 1000))
        image(folder / f"conf_{i:05}.png", np.full((120, 160), 2, np.uint8))
        matrix = pose @ np.diag([1.0, -1.0, -1.0, 1.0])
        said = {"cameraPoseARFrame": matrix.ravel().tolist(), "intrinsics": MATRIX.ravel().tolist(), "frame_index": i}
        (folder / f"frame_{i:05}.json").write_text(json.dumps({**said, "time": SCANNER_STAMPS[i], "motionQuality": 1}))
    image(folder / "depth_00004.png", raw(METRES[0], 1000))
    (folder / "info.json").write_text(json.dumps({"device": "iPhone", "title": "a scan"}))


def bop(folder: Path) -> None:
    """A scene of the BOP challenge: millimetres all over, and the world in the camera."""
    said = {}
    for i, (grey, metres, pose) in enumerate(zip(GREYS, METRES, POSES, strict=True), 1):
        image(folder / f"rgb/{i:06}.png", grey)
        image(folder / f"depth/{i:06}.png", raw(metres, 10000))
        camera_T_world = np.linalg.inv(pose)
        turn, shift = camera_T_world[:3, :3].ravel().tolist(), (1000 * camera_T_world[:3, 3]).tolist()
        said[str(i)] = {"cam_K": MATRIX.ravel().tolist(), "depth_scale": 0.1, "cam_R_w2c": turn, "cam_t_w2c": shift}
    (folder / "scene_camera.json").write_text(json.dumps(said))


def neural_rgbd(folder: Path) -> None:
    """Its cameras look along -z; the third frame has no pose."""
    blocks = []
    for i, (grey, metres, pose) in enumerate(zip(GREYS, METRES, POSES, strict=True)):
        image(folder / f"images/img{i}.png", grey)
        image(folder / f"depth_filtered/depth{i}.png", raw(metres, 1000))
        image(folder / f"depth_with_noise/depth{i}.png", raw(metres + 0.1, 1000))
        blocks.append(pose @ np.diag([1.0, -1.0, -1.0, 1.0]) if i != 2 else np.full((4, 4), np.nan))
    (folder / "focal.txt").write_text("131.0\n")
    np.savetxt(folder / "poses.txt", np.concatenate(blocks))
    np.savetxt(folder / "trainval_poses.txt", np.concatenate(blocks)[::-1])


def semantic_replica(folder: Path) -> None:
    """Rendered by another camera than Replica's own, which a file says."""
    for i, (grey, metres) in enumerate(zip(GREYS, METRES, strict=True)):
        image(folder / f"rgb/rgb_{i}.png", grey)
        image(folder / f"depth/depth_{i}.png", raw(metres, 1000))
    np.savetxt(folder / "traj_w_c.txt", POSES.reshape(4, 16))
    (folder / "camera.toml").write_text(CAMERA_TOML)


CAMERA_TOML = "fx = 131\nfy = 131\ncx = 79.5\ncy = 59.5\nwidth = 160\nheight = 120\n"


def tum(folder: Path) -> None:
    write_tum(ROOM, folder)


def associations(folder: Path) -> None:
    rows = []
    for i, (grey, depth) in enumerate(zip(GREYS, DEPTHS, strict=True)):
        image(folder / f"rgb/{i}.png", grey)
        image(folder / f"depth/{i}.png", depth)
        rows.append(f"{i} depth/{i}.png {i} rgb/{i}.png")
    (folder / "associations.txt").write_text("\n".join(rows) + "\n")
    (folder / "calibration.txt").write_text("131 131 79.5 59.5\n")


LORIS_STAMPS = [f"{1560004885.446172 + i / 30:.6f}" for i in range(4)]
BASE_T_LASER, LASER_T_COLOR = np.eye(4), np.eye(4)
BASE_T_LASER[:3, 3] = 0.1, 0.0, 0.9
LASER_T_COLOR[:3] = [[0, 0, 1, 0.3], [-1, 0, 0, 0.05], [0, -1, 0, 0.4]]


def storage(folder: Path, name: str, **values: object) -> None:
    """A file of OpenCV's FileStorage, of matrices and what else it writes, with the head of its older versions."""
    file = cv2.FileStorage(str(folder / name), cv2.FILE_STORAGE_WRITE)
    for key, value in values.items():
        _store(file, key, value)
    file.release()
    (folder / name).write_text((folder / name).read_text().replace("%YAML 1.2", "%YAML:1.0"))


def _store(file: cv2.FileStorage, name: str, value: object) -> None:
    if isinstance(value, dict | list):
        file.startWriteStruct(name, cv2.FileNode_MAP if isinstance(value, dict) else cv2.FileNode_SEQ)
        for key, part in value.items() if isinstance(value, dict) else (("", part) for part in value):
            _store(file, key, part)
        file.endWriteStruct()
    else:
        file.write(name, value)  # pyright: ignore[reportArgumentType, reportCallIssue]


def loris_sensors(folder: Path, order: str = "fx cx fy cy", **changed: object) -> None:
    color: dict[str, float] = {"fx": 131.0, "fy": 131.0, "cx": 79.5, "cy": 59.5}
    depth: dict[str, float] = {"fx": 90.0, "fy": 90.0, "cx": 80.5, "cy": 58.5}
    sensors = {
        name: {
            "sensor_type": "camera",
            "sensor_name": name,
            "fps": 30,
            "width": 160,
            "height": 120,
            "model": "pinhole",
            "intrinsics": np.array([[numbers[key] for key in order.split()]]),
            "distortion_model": "radial-tangential",
            "distortion_coefficients": np.zeros((1, 5)),
        }
        for name, numbers in (("d400_color_optical_frame", color), ("d400_depth_optical_frame", depth))
    }
    sensors["d400_color_optical_frame"] |= changed
    imu = {"sensor_type": "imu", "sensor_name": "d400_gyroscope", "imu_intrinsic": np.eye(3, 4).reshape(1, 12)}
    storage(folder, "sensors.yaml", **sensors, d400_gyroscope=imu)


def loris_transforms(folder: Path, moves: list[tuple[str, str, np.ndarray]] | None = None) -> None:
    moves = moves or [
        ("base_link", "laser", BASE_T_LASER),
        ("laser", "d400_color_optical_frame", LASER_T_COLOR),
        ("d400_color_optical_frame", "d400_depth_optical_frame", np.eye(4)),
    ]
    rows = [{"parent_frame": parent, "child_frame": child, "matrix": matrix} for parent, child, matrix in moves]
    storage(folder, "trans_matrix.yaml", trans_matrix=rows)


def open_loris(folder: Path) -> None:
    """Depth of its own camera lies beside that which is registered; the true poses are of the robot's body."""
    color_T_base = np.linalg.inv(BASE_T_LASER @ LASER_T_COLOR)
    rows: dict[str, list[str]] = {"color": [], "aligned_depth": [], "depth": [], "groundtruth": []}
    rows["groundtruth"].append("#Time px py pz qx qy qz qw")
    for stamp, grey, metres, pose in zip(LORIS_STAMPS, GREYS, METRES, POSES, strict=True):
        later = f"{float(stamp) + 0.004:.6f}"
        for kind, name, pixels in (
            ("color", stamp, grey),
            ("aligned_depth", later, raw(metres, 1000)),
            ("depth", later, np.full((120, 160), 500, np.uint16)),
        ):
            image(folder / f"{kind}/{name}.png", pixels)
            rows[kind].append(f"{name} {kind}/{name}.png")
        base = pose @ color_T_base
        numbers = [*base[:3, 3], *quaternion_from_rotation(base[:3, :3])]
        rows["groundtruth"].append(f"{stamp} {' '.join(map(str, numbers))}")
    for name, lines in rows.items():
        (folder / f"{name}.txt").write_text("\n".join(lines) + "\n")
    loris_sensors(folder)
    loris_transforms(folder)


NED_T_CAMERA = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""A camera's axes (right, down, forward) in those of a body that counts forward, right and down."""


def packed(metres: np.ndarray) -> np.ndarray:
    """Floats as the four channels of an image of 8 bits, as OpenCV has them in memory: blue first."""
    return metres.astype("<f4")[..., None].view(np.uint8)


def tartan_poses(folder: Path, camera: str) -> None:
    bodies = [pose @ np.linalg.inv(NED_T_CAMERA) for pose in POSES]
    rows = [[*body[:3, 3], *quaternion_from_rotation(body[:3, :3])] for body in bodies]
    np.savetxt(folder / f"pose_{camera}.txt", rows)


def tartan_air(folder: Path) -> None:
    """Of its first version, but for the size of the images."""
    for i, (grey, metres) in enumerate(zip(GREYS, METRES, strict=True)):
        image(folder / f"image_left/{i:06}_left.png", grey)
        image(folder / f"depth_left/{i:06}_left_depth.npy", metres.astype(np.float32))
    tartan_poses(folder, "left")
    (folder / "camera.yaml").write_text("fx: 131\nfy: 131\ncx: 79.5\ncy: 59.5\nwidth: 160\nheight: 120\n")


def tartan_air_2(folder: Path) -> None:
    """Of its second version, at 10 Hz."""
    for i, (grey, metres) in enumerate(zip(GREYS, METRES, strict=True)):
        image(folder / f"image_lcam_front/{i:06}_lcam_front.png", grey)
        image(folder / f"depth_lcam_front/{i:06}_lcam_front_depth.png", packed(metres))
    tartan_poses(folder, "lcam_front")
    (folder / "camera.yaml").write_text("fx: 131\nfy: 131\ncx: 79.5\ncy: 59.5\nwidth: 160\nheight: 120\n")


def kitti_rows(folder: Path, name: str, rows: list[str]) -> None:
    """A file of Virtual KITTI 2: a row for each frame and camera below the names of the columns."""
    columns = "K[0,0] K[1,1] K[0,2] K[1,2]" if name == "intrinsic.txt" else "r1,1 r1,2 r1,3 t1 r2,1 r2,2 r2,3 t2 r3,1"
    lines = [f"{i} {camera} {row}" for i, row in enumerate(rows) for camera in (0, 1)]
    (folder / name).write_text("\n".join([f"frame cameraID {columns}", *lines]) + "\n")


def virtual_kitti(folder: Path) -> None:
    """A variation of a scene of Virtual KITTI 2, in centimetres; the poses are those of the world in the camera."""
    for i, (grey, metres) in enumerate(zip(GREYS, METRES, strict=True)):
        image(folder / f"frames/rgb/Camera_0/rgb_{i:05}.jpg", grey)
        image(folder / f"frames/depth/Camera_0/depth_{i:05}.png", raw(metres, 100, 65535))
        image(folder / f"frames/rgb/Camera_1/rgb_{i:05}.jpg", grey[:, ::-1])
    kitti_rows(folder, "intrinsic.txt", ["131 131 79.5 59.5"] * 4)
    kitti_rows(folder, "extrinsic.txt", [" ".join(map(str, np.linalg.inv(pose).ravel())) for pose in POSES])


AIRSIM_STAMPS = [1643000.5 + i / 20 for i in range(4)]
AIRSIM_COLUMNS = "VehicleName\tTimeStamp\tPOS_X\tPOS_Y\tPOS_Z\tQ_W\tQ_X\tQ_Y\tQ_Z\tImageFile"


def pfm_from_top(path: Path, metres: np.ndarray) -> None:
    """As AirSim writes PFM: from the top, where the format runs from the bottom."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(f"Pf\n{metres.shape[1]} {metres.shape[0]}\n-1\n".encode() + metres.astype("<f4").tobytes())


def airsim(folder: Path) -> None:
    """Labels lie there, too; the poses are those of the vehicle."""
    rows = [AIRSIM_COLUMNS]
    for i, (stamp, grey, metres) in enumerate(zip(AIRSIM_STAMPS, GREYS, METRES, strict=True)):
        names = [f"img_SimpleFlight_0_{kind}_{1643000123456789000 + 50000000 * i + kind}" for kind in (0, 1, 5)]
        image(folder / f"images/{names[0]}.png", grey)
        pfm_from_top(folder / f"images/{names[1]}.pfm", metres)
        image(folder / f"images/{names[2]}.png", np.full((120, 160, 3), i, np.uint8))
        files = f"{names[0]}.png;{names[1]}.pfm;{names[2]}.png"
        rows.append(f"SimpleFlight\t{round(1000 * stamp)}\t{i}\t0\t-1.5\t1\t0\t0\t0\t{files}")
    (folder / "airsim_rec.txt").write_text("\n".join(rows) + "\n")
    (folder / "camera.toml").write_text(CAMERA_TOML)


RTABMAP_STAMPS = [f"{1786504901.920936 + i / 30:.6f}" for i in range(4)]
OPTICAL = np.array([[0.0, 0, 1, 0.1], [-1, 0, 0, 0], [0, -1, 0, 0.9]])
"""A camera's axes in those of a robot's body, and where it lies on it."""


def rtabmap_camera(folder: Path, name: str, fx: float = 131.0, **more: object) -> None:
    """As RTAB-Map writes a camera, with a lens that its images do not have."""
    folder.mkdir(exist_ok=True)

    def matrix(values: np.ndarray) -> dict[str, object]:
        return {"rows": values.shape[0], "cols": values.shape[1], "data": values.ravel().tolist()}

    camera = np.array([[fx, 0, 79.5, 0], [0, 131.0, 59.5, 0], [0, 0, 1, 0]])
    values: dict[str, object] = {
        "camera_name": name,
        "image_width": 160,
        "image_height": 120,
        "camera_matrix": matrix(camera[:, :3] + np.diag([9.0, 9.0, 0.0])),
        "distortion_coefficients": matrix(np.array([[0.1, -0.2, 0.0, 0.0, 0.0]])),
        "distortion_model": "plumb_bob",
        "rectification_matrix": matrix(np.eye(3)),
        "projection_matrix": matrix(camera),
        "local_transform": matrix(OPTICAL),
    }
    storage(folder, f"{name}.yaml", **{**values, **more})


def rtabmap(folder: Path, prefix: str = "", poses: str = "poses.txt", ids: bool = False) -> None:
    """As its database viewer exports it; its estimate lies there, too."""
    rows = ["#timestamp x y z qx qy qz qw id"]
    for i, (stamp, grey, metres, pose) in enumerate(zip(RTABMAP_STAMPS, GREYS, METRES, POSES, strict=True)):
        name = str(i + 1) if ids else stamp
        image(folder / f"{prefix}rgb/{name}.jpg", grey)
        image(folder / f"{prefix}depth/{name}.png", raw(metres, 1000))
        rtabmap_camera(folder / f"{prefix}calib", name)
        numbers = [*(pose[:3, 3] + 0.01 * i), *quaternion_from_rotation(pose[:3, :3])]
        rows.append(f"{stamp} {' '.join(map(str, numbers))} {i + 1}")
    (folder / poses).write_text("\n".join(rows) + "\n")


def rtabmap_export(folder: Path) -> None:
    """As the command exports it with the ids of nodes for names."""
    rtabmap(folder, "map_", "map_camera_poses.txt", ids=True)


LAYOUTS: dict[str, tuple[str, Callable[[Path], None]]] = {
    "tum": ("TUM RGB-D folder", tum),
    "associations": ("TUM RGB-D folder", associations),
    "seven_scenes": ("7-Scenes sequence", seven_scenes),
    "scannet": ("ScanNet scan", scannet),
    "replica": ("Replica room", replica),
    "open3d": ("Open3D reconstruction folder", open3d),
    "open3d_image": ("Open3D reconstruction folder", open3d_image),
    "plain": ("folder of colour and depth images", plain),
    "one_folder": ("folder of colour and depth images", one_folder),
    "stray": ("scan of Stray Scanner", stray),
    "arkit_scenes": ("scan of ARKitScenes", arkit_scenes),
    "scannet_plus_plus": ("scan of ScanNet++", scannet_plus_plus),
    "polycam": ("scan of Polycam", polycam),
    "scanner_app": ("scan of 3D Scanner App", scanner_app),
    "bop": ("BOP scene", bop),
    "neural_rgbd": ("scene of Neural RGB-D", neural_rgbd),
    "semantic_replica": ("Replica room of Semantic-NeRF", semantic_replica),
    "open_loris": ("OpenLORIS-Scene sequence", open_loris),
    "tartan_air": ("TartanAir trajectory", tartan_air),
    "tartan_air_2": ("TartanAir trajectory", tartan_air_2),
    "virtual_kitti": ("drive of Virtual KITTI 2", virtual_kitti),
    "airsim": ("recording of AirSim", airsim),
    "rtabmap": ("export of RTAB-Map", rtabmap),
    "rtabmap_export": ("export of RTAB-Map", rtabmap_export),
    "nerf": ("folder of colour and depth images", nerf),
    "nerfstudio": ("nerfstudio folder", nerfstudio),
}
"""By name: what the layout is recognised as, and who writes it."""
