"""A map of a few small frames; where Open3D is not installed, its refusals alone."""

import importlib.util
import sys

import numpy as np
import pytest
from small import CAMERA

from gavo_jax.datasets.synthetic import NONE, SyntheticSequence
from gavo_jax.errors import GavoError
from gavo_jax.odometry.run import OdometryRun
from gavo_jax.scene_map import MapBuilder, build_map, check_map, check_voxel, import_open3d

needs_open3d = pytest.mark.skipif(importlib.util.find_spec("open3d") is None, reason="Open3D is not installed")


@pytest.mark.parametrize(
    ("name", "shape", "holds"),
    [("a.ply", None, "cloud"), ("a.PCD", None, "cloud"), ("a.obj", None, "mesh"), ("a.ply", "mesh", "mesh")],
)
def test_the_ending_says_what_is_written(name, shape, holds):
    assert check_map(name, shape) == holds


@pytest.mark.parametrize(
    ("name", "shape", "words"),
    [
        ("a.xyz", None, "ends in .ply, .pcd, .obj, not in '.xyz'"),
        ("a", None, "not in 'nothing'"),
        ("a.pcd", "mesh", ".pcd holds no mesh: .ply or .obj does"),
    ],
)
def test_other_endings_are_refused(name, shape, words):
    with pytest.raises(GavoError, match=words):
        check_map(name, shape)


def test_absurd_voxels_are_refused():
    for voxel in (0.0, -1.0, float("nan"), 2.0):
        with pytest.raises(GavoError, match="voxel"):
            check_voxel(voxel)


def test_without_open3d_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(GavoError, match=r"install 'gavo-jax\[map\]'"):
        import_open3d()


def test_a_run_without_its_sequence_has_no_map():
    with pytest.raises(GavoError, match="does not hold the sequence"):
        OdometryRun(None, [], None).map()  # pyright: ignore


@needs_open3d
def test_cloud_and_mesh_lie_on_the_surfaces_that_were_seen(tmp_path):
    sequence = SyntheticSequence(4, noise=NONE, camera=CAMERA, color=True)
    poses = sequence.ground_truth.world_T_camera
    builder = MapBuilder(CAMERA, voxel=0.03)
    for frame, pose in zip(sequence, poses, strict=True):
        builder.add(frame, pose)
    frame = sequence[2]
    v, u = np.nonzero((frame.depth > 0) & (frame.depth < 3.5 * CAMERA.depth_scale))
    seen = CAMERA.back_project(np.stack([u, v], -1).astype(float), frame.depth[v, u] / CAMERA.depth_scale)
    seen = seen @ poses[2][:3, :3].T + poses[2][:3, 3]
    open3d = import_open3d()
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


@needs_open3d
def test_nothing_seen_is_an_empty_map():
    sequence = SyntheticSequence(2, noise=NONE, camera=CAMERA)
    assert len(build_map(sequence, [], farthest=0.1).points) == 0
