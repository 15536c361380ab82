"""A map of a few small frames; where Open3D cannot be imported, its refusals alone."""

import resource
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from small import CAMERA

from gavo_jax import map_fusion
from gavo_jax.alignment.result import no_alignment, with_finding
from gavo_jax.datasets.base import Frame, FrameError
from gavo_jax.datasets.rendered.sensor_noise import NONE
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.errors import GavoError
from gavo_jax.libusb import import_open3d
from gavo_jax.map_fusion import LiveMap, MapBuilder, build_map
from gavo_jax.odometry.driver import Step
from gavo_jax.odometry.run import OdometryRun
from gavo_jax.scene_map import LARGEST, SceneMap, check_map, check_voxel
from gavo_jax.status import AlignmentStatus
from gavo_jax.trajectory import Trajectory

FILES = {"a.ply": "cloud", "a.pcd": "cloud", "b.ply": "mesh", "b.obj": "mesh"}


@pytest.mark.parametrize(
    ("name", "shape", "holds"),
    [("a.ply", None, "cloud"), ("a.PCD", None, "cloud"), ("a.obj", None, "mesh"), ("a.ply", "mesh", "mesh")],
)
def test_the_ending_says_what_is_written(name, shape, holds):
    assert check_map(name, shape) == holds


@pytest.mark.parametrize(
    ("name", "shape", "words"),
    [
        ("a.xyz", None, "end in .ply, .pcd, .obj, not in '.xyz'"),
        ("a", None, "not in 'nothing'"),
        ("a.pcd", "mesh", ".pcd cannot store a mesh: use .ply or .obj"),
    ],
)
def test_other_endings_are_refused(name, shape, words):
    with pytest.raises(GavoError, match=words):
        check_map(name, shape)


@pytest.mark.parametrize("voxel", [0.0, -1.0, float("nan"), 2.0, "1cm", None, [0.01], True])
def test_absurd_voxels_are_refused(voxel: Any) -> None:
    with pytest.raises(GavoError, match="voxel: must be from"):
        check_voxel(voxel)


def test_a_map_of_something_else_is_refused() -> None:
    with pytest.raises(GavoError, match="expected a Camera, got str"):
        MapBuilder("fr1")  # pyright: ignore[reportArgumentType]
    with pytest.raises(GavoError, match="expected a Sequence, got NoneType"):
        build_map(None, ())  # pyright: ignore[reportArgumentType]
    sequence: Any = SyntheticSequence(2, camera=CAMERA)
    other: Any = None
    none: tuple[Any, ...] = (None, [None], OdometryRun(other, [], other))
    for steps in none:
        with pytest.raises(GavoError, match="expected the steps of a run, run.steps"):
            build_map(sequence, steps)
    with pytest.raises(GavoError, match="expected a Trajectory, got str"):
        build_map(sequence, [], trajectory="trajectory.txt")  # pyright: ignore[reportArgumentType]


@pytest.mark.usefixtures("open3d")
@pytest.mark.parametrize("farthest", [-1.0, 0, float("nan"), float("inf"), "4 m", None])
def test_absurd_depths_are_refused(farthest: Any) -> None:
    """All readings were left out without a word, or the first frame ended in a traceback."""
    with pytest.raises(GavoError, match="farthest: "):
        MapBuilder(CAMERA, farthest=farthest)


def test_without_open3d_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(GavoError, match=r"install 'gavo-jax\[map\]'"):
        import_open3d("map")


def test_a_run_without_its_sequence_has_no_map():
    with pytest.raises(GavoError, match="does not contain the sequence"):
        OdometryRun(None, [], None).map()  # pyright: ignore


class Fused:
    """In place of what fuses frames: which ones it was given, and where they were."""

    def __init__(self, *_: object) -> None:
        self.frames: list[float] = []
        self.x: list[float] = []
        self.known: list[float] = []

    def add(self, frame: Frame, world_T_camera: np.ndarray) -> None:
        self.known.append(float(np.mean(frame.depth > 0)))
        self.frames.append(frame.timestamp)
        self.x.append(float(world_T_camera[0, 3]))

    def extract(self, _: str, left_out: list[str]) -> tuple[list[float], list[float], list[str]]:
        return self.frames, self.x, left_out


def fused(steps: list[Step], trajectory: Trajectory | None = None) -> Any:
    """What a map is made of: stamps and places of its frames, and what it lacks."""
    return build_map(WALK, steps, trajectory=trajectory)


WALK = SyntheticSequence(8, noise=NONE, camera=CAMERA)


def stepped(index: int, *findings: AlignmentStatus, segment: int = 0, **values: Any) -> Step:
    """A step to a frame of the walk."""
    result = no_alignment(AlignmentStatus.OK)
    for finding in findings:
        result = with_finding(result, finding)
    stamps = WALK.timestamps
    pose = np.eye(4)
    pose[0, 3] = index
    lost = values.pop("lost", False)
    return Step(index, stamps[index - 1], stamps[index], result, pose, 1.0, lost, "", segment, **values)


def test_a_map_is_made_of_frames_that_can_be_trusted(monkeypatch):
    """Of frozen or foreign depth, and of guessed poses, the map was made, too."""
    monkeypatch.setattr("gavo_jax.map_fusion.MapBuilder", Fused)
    doubts = (AlignmentStatus.FROZEN, AlignmentStatus.DEPTH_MISMATCH, AlignmentStatus.NO_DEPTH)
    steps = [stepped(1), *(stepped(2 + i, doubt) for i, doubt in enumerate(doubts)), stepped(5, origin="guessed")]
    steps += [stepped(6, lost=True, origin="guessed"), stepped(7, AlignmentStatus.PARTIAL_DEPTH)]
    frames, x, left_out = fused(steps)
    assert frames == [WALK.timestamps[i] for i in (0, 1, 7)] and x == [0, 1, 7]
    assert left_out == ["3 frames: with doubtful depth", "1 frame: with a guessed pose", "1 frame: lost"]


def test_a_map_goes_through_segments_that_loops_have_joined(monkeypatch):
    """They were left out by the steps' segments, although the trajectory said that they lie in one world."""
    monkeypatch.setattr("gavo_jax.map_fusion.MapBuilder", Fused)
    steps = [stepped(i, segment=int(i > 4)) for i in range(1, 8)]
    poses = np.stack([np.eye(4)] * 8)
    poses[:, 0, 3] = 10 * np.arange(8)
    trajectory = Trajectory(WALK.timestamps, poses)
    assert fused(steps)[1] == [0, 1, 2, 3, 4]
    assert fused(steps, trajectory)[1] == list(range(0, 80, 10))


def test_a_stamp_that_comes_again_has_a_pose_of_its_own(monkeypatch):
    """A clock that was set back: both frames of a stamp were put where the second one was."""
    monkeypatch.setattr("gavo_jax.map_fusion.MapBuilder", Fused)
    stamps = [*WALK.timestamps[:4], *WALK.timestamps[1:4]]
    steps = [stepped(1), stepped(2), stepped(3), *(stepped(i, segment=1) for i in (1, 2, 3))]
    poses = np.stack([np.eye(4)] * 7)
    poses[:, 0, 3] = 10 * np.arange(7)
    frames, x, _ = fused(steps, Trajectory(np.array(stamps), poses, np.array([0, 0, 0, 0, 1, 1, 1])))
    assert frames == list(WALK.timestamps[:4]) and x == [0, 10, 20, 30]


def test_frames_before_the_first_reference_are_no_part_of_a_map(monkeypatch):
    monkeypatch.setattr("gavo_jax.map_fusion.MapBuilder", Fused)
    steps = [stepped(1, AlignmentStatus.NO_REFERENCE, segment=1, lost=True)]
    steps += [stepped(i, segment=1) for i in (2, 3)]
    frames, _, left_out = fused(steps)
    assert frames == [WALK.timestamps[i] for i in (2, 3)] and left_out == ["2 frames: lost"]


def test_what_moves_on_its_own_is_no_part_of_a_map(monkeypatch):
    fuser = Fused()
    monkeypatch.setattr("gavo_jax.map_fusion.MapBuilder", lambda *_: fuser)
    mask = np.zeros((CAMERA.height, CAMERA.width), bool)
    mask[:, : CAMERA.width // 2] = True
    build_map(WALK, [stepped(1), stepped(2)], moving=lambda step: mask if step.index == 2 else None)
    assert fuser.known[2] < 0.6 * fuser.known[1] and fuser.known[1] == pytest.approx(fuser.known[0], abs=0.02)


@pytest.mark.parametrize("begins", [0, 1, 2])
def test_a_live_map_begins_with_the_first_frame_that_is_of_use(begins):
    fuser: Any = Fused()
    scene: Any = LiveMap(fuser)
    scene.watch(WALK[0], None)
    for i in range(1, 6):
        lost = (AlignmentStatus.NO_REFERENCE,) if i <= begins else ()
        scene.watch(WALK[i], stepped(i, *lost, segment=int(begins > 0), lost=bool(lost)))
    frames, x, left_out = scene.finish("cloud")
    assert frames == [WALK.timestamps[i] for i in range(begins, 6)] and x == list(range(begins, 6))
    assert left_out == ([f"{begins} frame{'s' * (begins > 1)}: lost"] if begins else [])


@pytest.mark.parametrize(("second", "begins"), [(AlignmentStatus.BLANK, 2), (AlignmentStatus.HIGH_ERROR, 0)])
def test_a_live_map_waits_for_a_frame_that_fits_its_first_one(second, begins):
    """The first of several dark frames was fused as the map's origin, and the frame that the poses are of was not."""
    scene: Any = LiveMap(Fused())  # pyright: ignore[reportArgumentType]
    scene.watch(WALK[0], None)
    scene.watch(WALK[1], stepped(1, second, lost=True))
    if begins:
        scene.watch(WALK[2], stepped(2, AlignmentStatus.NO_REFERENCE, lost=True))
    else:
        scene.watch(WALK[2], stepped(2))
    scene.watch(WALK[3], stepped(3))
    frames, _, left_out = scene.finish("cloud")
    assert frames == [WALK.timestamps[i] for i in (0, 2, 3) if i >= begins]
    assert left_out == [f"{1 + (begins > 0)} frame{'s' * (begins > 0)}: lost"]


@pytest.mark.parametrize("name", ["a.ply", "a.pcd", "a.obj"])
def test_an_empty_map_is_not_written(tmp_path, name):
    triangles = np.zeros((0, 3), int) if name == "a.obj" else None
    nothing = SceneMap(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros((0, 3)), triangles)
    with pytest.raises(GavoError, match="not written: nothing near enough \\(4 m by default\\)"):
        nothing.write(tmp_path / name)


def test_cloud_and_mesh_lie_on_the_surfaces_that_were_seen(tmp_path, open3d):
    sequence = SyntheticSequence(4, noise=NONE, camera=CAMERA, color=True)
    poses = sequence.ground_truth.world_T_camera
    builder = MapBuilder(CAMERA, voxel=0.03)
    for frame, pose in zip(sequence, poses, strict=True):
        builder.add(frame, pose)
    frame = sequence[2]
    v, u = np.nonzero((frame.depth > 0) & (frame.depth < 3.5 * CAMERA.depth_scale))
    seen = CAMERA.back_project(np.stack([u, v], -1).astype(float), frame.depth[v, u] / CAMERA.depth_scale)
    seen = seen @ poses[2][:3, :3].T + poses[2][:3, 3]
    cloud, mesh = builder.extract("cloud"), builder.extract("mesh")
    for scene, reach in ((cloud, 0.02), (mesh, 0.02)):
        tree = open3d.core.nns.NearestNeighborSearch(open3d.core.Tensor(scene.points))
        tree.knn_index()
        _, squares = tree.knn_search(open3d.core.Tensor(seen[::20]), 1)
        assert np.sqrt(np.median(squares.numpy())) < reach
        assert scene.colors.std() > 5 and scene.frames == 4 and not scene.left_out
    for scene, name in ((cloud, "a.ply"), (cloud, "a.pcd"), (mesh, "b.ply"), (mesh, "b.obj")):
        scene.write(tmp_path / name)
    assert len(open3d.io.read_point_cloud(str(tmp_path / "a.pcd")).points) == len(cloud.points)
    assert len(open3d.io.read_triangle_mesh(str(tmp_path / "b.ply")).triangles) == len(np.asarray(mesh.triangles))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.pcd", "a.ply", "b.obj", "b.ply"]


@pytest.mark.usefixtures("open3d")
@pytest.mark.parametrize(("name", "share"), [(name, share) for name in FILES for share in (0.1, 0.99)])
def test_a_full_disk_leaves_no_part_of_a_map(tmp_path, capfd, name, share):
    """Open3D does not notice; its library of PLY says so once for each value, and it goes on."""
    corners = np.random.default_rng(0).uniform(size=(900, 3))
    triangles = np.arange(900).reshape(-1, 3) if FILES[name] == "mesh" else None
    scene = SceneMap(corners, np.zeros((900, 3), np.uint8), corners, triangles)
    scene.write(tmp_path / name)
    whole = (tmp_path / name).read_bytes()
    assert len(whole) < 1000 + 900 * LARGEST[name[1:]][0] + 300 * LARGEST[name[1:]][1]
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(share * len(whole)), hard))
    try:
        with pytest.raises(GavoError, match=f"{name}: cannot be written: File too large"):
            scene.write(tmp_path / name)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert [path.name for path in tmp_path.iterdir()] == [name] and (tmp_path / name).read_bytes() == whole
    assert capfd.readouterr() == ("", "")


@pytest.mark.usefixtures("open3d")
def test_nothing_seen_is_an_empty_map():
    sequence = SyntheticSequence(2, noise=NONE, camera=CAMERA)
    assert len(build_map(sequence, [], farthest=0.1).points) == 0


@pytest.mark.usefixtures("open3d")
def test_frames_that_do_not_fit_are_refused_and_no_reading_is_a_surface():
    """Images of another size were fused by the wrong pixels, poses that are not-a-number counted, the number of 16 bits
    that stands for no reading was a wall, and another shape was taken for a mesh.
    """
    frame = SyntheticSequence(1, camera=CAMERA)[0]
    builder = MapBuilder(CAMERA, 0.1)
    for pose in (np.full((4, 4), np.nan), np.eye(4)[:3]):
        with pytest.raises(GavoError, match="world_T_camera"):
            builder.add(frame, pose)
    with pytest.raises(FrameError, match="of shape"):
        builder.add(replace(frame, grey=frame.grey[:50], depth=frame.depth[:50]), np.eye(4))
    for color in (np.zeros((50, 160, 3), np.uint8), np.zeros((120, 160, 3), np.float32)):
        with pytest.raises(FrameError, match="color image is .*: expected uint8 of"):
            builder.add(replace(frame, color=color), np.eye(4))
    with pytest.raises(GavoError, match="expected a Frame, got tuple"):
        builder.add((frame.grey, frame.depth), np.eye(4))  # pyright: ignore[reportArgumentType]
    with pytest.raises(GavoError, match="cloud or mesh, not 'sphere'"):
        builder.extract("sphere")  # pyright: ignore[reportArgumentType]
    assert builder.frames == 0
    fine = MapBuilder(replace(CAMERA, depth_scale=50000.0))
    fine.add(replace(frame, depth=np.full_like(frame.depth, 65535)), np.eye(4))
    assert len(fine.extract().points) == 0


def wall(metres: float, voxel: float, missing: slice = slice(0)) -> SceneMap:
    """The map of a wall straight ahead that fills the image but for some rows without a reading."""
    depth = np.full((CAMERA.height, CAMERA.width), round(metres * CAMERA.depth_scale), np.uint16)
    depth[missing] = 0
    builder = MapBuilder(CAMERA, voxel)
    for _ in range(3):
        builder.add(Frame(np.full(depth.shape, 100, np.uint8), depth, 0.0), np.eye(4))
    return builder.extract()


@pytest.mark.usefixtures("open3d")
@pytest.mark.parametrize("row", [0, 3])
def test_a_map_does_not_need_the_rows_that_are_looked_at(row):
    """Open3D looks at every fourth row for the blocks of a frame: where all of those were empty it raised an error."""
    points = wall(2.02, 0.05, slice(row, None, 4)).points
    assert len(points) > 100 and np.abs(points[:, 2] - 2.02).max() < 0.05


@pytest.mark.usefixtures("open3d")
@pytest.mark.parametrize("voxel", [0.02, 0.005])
def test_small_voxels_leave_no_holes(voxel: float) -> None:
    """A third of the wall was missing, without a word, where blocks are smaller than four pixels."""
    metres = 3.0 + 0.3 * voxel
    points = wall(metres, voxel).points
    half = 0.8 * metres * np.array([CAMERA.width / CAMERA.fx, CAMERA.height / CAMERA.fy]) / 2
    inner = points[np.all(np.abs(points[:, :2]) < half, axis=1), :2]
    cells, size = np.floor(inner / (4 * voxel)), 2 * half / (4 * voxel)
    assert len(np.unique(cells, axis=0)) > 0.95 * np.prod(size)


@pytest.mark.usefixtures("open3d")
def test_a_wall_that_lies_on_the_voxels_is_seen() -> None:
    """It had no side, and the map was empty."""
    points = wall(2.0, 0.05).points
    assert len(points) > 100 and np.abs(points[:, 2] - 2.0).max() < 1e-3


@pytest.mark.usefixtures("open3d")
def test_a_full_map_keeps_what_is_near(monkeypatch) -> None:
    """The first frame that went beyond was left out as a whole."""
    far = np.linalg.norm(wall(2.01, 0.02).points, axis=1).max()
    monkeypatch.setattr(map_fusion, "MOST_BLOCKS", 300)
    seen = wall(2.01, 0.02)
    assert 2.0 < np.linalg.norm(seen.points, axis=1).max() < far - 0.1
    assert "more than 300 blocks" in seen.left_out[0]
