"""`gavo run` over a live device: a stand-in that plays a few rendered frames."""

import importlib.util
import json
from collections.abc import Iterable
from dataclasses import replace

import pytest
from command import runner
from small import CAMERA, NEWTON

from gavo_jax import presets
from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame
from gavo_jax.datasets.live.devices import register_device
from gavo_jax.datasets.live.frames import LiveImages
from gavo_jax.datasets.rendered.sensor_noise import NONE
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.errors import GavoError
from gavo_jax.map_fusion import build_map
from gavo_jax.odometry.run import run_odometry
from gavo_jax.trajectory import Trajectory

WIDE = replace(CAMERA, width=320)
LENS = replace(CAMERA, distortion=(0.1, -0.1, 0.0, 0.0, 0.0))
FRAMES = SyntheticSequence(5, noise=NONE, camera=CAMERA, color=True)


class Player:
    """Gives a frame when the one before was tracked, so that none is dropped; then the end, Ctrl-C or nothing more."""

    name = "player"

    def __init__(self, camera: Camera = CAMERA, frames: Iterable[Frame] = FRAMES):
        self.camera, self.coming = camera, iter(frames)

    def read(self):
        frame = next(self.coming, None)
        if frame is None:
            return None
        assert frame.color is not None
        return LiveImages(frame.color, frame.depth, frame.timestamp, None)

    def close(self):
        pass


@pytest.fixture(autouse=True)
def _method():
    presets.register("small-newton", NEWTON)


@pytest.mark.parametrize(
    ("name", "opened", "words"),
    [
        ("", Player, "name: expected a word, got ''"),
        (None, Player, "name: expected a word, got None"),
        ([], Player, "name: expected a word"),
        ("player", None, "'player': expected a function that opens it, got None"),
    ],
)
def test_what_is_no_device_is_refused_at_once(name, opened, words):
    with pytest.raises(GavoError, match=f"^live device: {words}|^live device {words}"):
        register_device(name, opened)


def test_a_live_run_writes_what_every_run_writes(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("gavo_jax.cli.live.Newest", Unhurried)
    register_device("player", Player)
    done = runner(capsys)(
        *("run", "player", "--method", "small-newton", "--output", tmp_path / "run", "--trajectory-format", "json")
    )
    assert done.status == 0, done.err
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert (metrics["frames"], metrics["frames_received"], metrics["frames_dropped"]) == (5, 5, 0)
    trajectory = Trajectory.read_tum(tmp_path / "run" / "trajectory.txt")
    expected = run_odometry(FRAMES, NEWTON).trajectory
    assert abs(trajectory.world_T_camera - expected.world_T_camera).max() < 1e-6
    assert (tmp_path / "run" / "trajectory.json").exists()
    assert "0 of 5 frames were dropped" in done.out


def test_a_camera_that_is_not_used_after_all_is_let_go(tmp_path, capsys):
    """It stayed open where its camera file was refused."""
    closed: list[bool] = []

    class Closed(Player):
        def close(self):
            closed.append(True)

    register_device("closed", Closed)
    done = runner(capsys)("run", "closed", "--method", "small-newton", "--camera", tmp_path / "none.toml")
    assert done.status == 2 and "none.toml" in done.err
    assert closed


class Stumbling(Player):
    """Its third image has another size; at the end it is unplugged, if it has a reason."""

    def __init__(self, reason: str = ""):
        super().__init__()
        self.reason, self.given = reason, 0

    def read(self):
        images, self.given = super().read(), self.given + 1
        if images is None and self.reason:
            raise GavoError(self.reason)
        return images and (images._replace(color=images.color[:-1]) if self.given == 3 else images)


@pytest.mark.parametrize("reason", ["", "player: unplugged"])
def test_what_was_tracked_outlives_a_wrong_image_and_a_device_that_is_gone(tmp_path, capsys, monkeypatch, reason):
    monkeypatch.setattr("gavo_jax.cli.live.Newest", Unhurried)
    register_device("player", lambda: Stumbling(reason))
    done = runner(capsys)("run", "player", "--method", "small-newton", "--output", tmp_path)
    assert done.status == (2 if reason else 0) and done.err.count("\n") == bool(reason) and reason in done.err
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert (metrics["frames"], metrics["lost_pairs"], metrics["complete"]) == (5, 1, not reason)
    assert "unreadable" in (tmp_path / "frames.csv").read_text().splitlines()[2]


def test_a_device_that_gives_one_frame_says_how_many_were_tracked(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("gavo_jax.cli.live.Newest", Unhurried)
    register_device("player", lambda: Player(frames=[FRAMES[0]]))
    done = runner(capsys)("run", "player", "--method", "small-newton", "--output", tmp_path)
    assert done.status == 2 and "player: ended after 1 frames: needs at least two" in done.err


@pytest.mark.skipif(importlib.util.find_spec("rerun") is None, reason="Rerun is not installed")
def test_a_live_run_can_be_watched_and_its_options_count(tmp_path, capsys, monkeypatch):
    """The viewer ended it, as there are no stamps of what is to come; these options were read and left aside."""
    monkeypatch.setattr("gavo_jax.cli.live.Newest", Unhurried)
    register_device("player", Player)
    options = ("--bodies", "off", "--on-lost", "predict", "--reference", "previous", "--viewer", "save")
    done = runner(capsys)("run", "player", "--method", "small-newton", "--output", tmp_path / "run", *options)
    assert done.status == 0, done.err
    assert (tmp_path / "run" / "run.rrd").stat().st_size > 10_000
    odometry = json.loads((tmp_path / "run" / "config.json").read_text())["odometry"]
    assert [odometry[name] for name in ("bodies", "on_lost", "reference")] == ["off", "predict", "previous"]


@pytest.mark.usefixtures("open3d")
def test_the_map_of_a_live_run_is_that_of_its_frames(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("gavo_jax.cli.live.Newest", Unhurried)
    register_device("player", Player)
    path = tmp_path / "seen.ply"
    done = runner(capsys)(
        *("run", "player", "--method", "small-newton", "--output", tmp_path / "run", "--map", path, "--voxel", "0.05")
    )
    assert done.status == 0, done.err
    again = build_map(FRAMES, run_odometry(FRAMES, NEWTON).steps, voxel=0.05)
    assert f"map of 5 frames, {len(again.points)} points" in done.out


class Unhurried:
    """As `Newest`, without the thread: every frame is taken."""

    def __init__(self, device):
        self.device, self.received, self.dropped = device, 0, 0

    def __enter__(self):
        return self

    def __exit__(self, *exception):
        self.device.close()

    def __iter__(self):
        while (images := self.device.read()) is not None:
            self.received += 1
            yield images


@pytest.mark.parametrize(("options", "scale"), [((), 1000.0), (("--depth-scale", "2000"), 2000.0)])
def test_a_lens_that_is_named_leaves_the_devices_unit_of_depth(tmp_path, capsys, monkeypatch, options, scale):
    """A camera file that says none stands for TUM's 5000: a trajectory five times too short."""
    monkeypatch.setattr("gavo_jax.cli.live.Newest", Unhurried)
    register_device("player", lambda: Player(replace(CAMERA, depth_scale=1000.0)))
    file = tmp_path / "lens.toml"
    file.write_text("fx = 131.0\nfy = 131.0\ncx = 79.5\ncy = 59.5\nwidth = 160\nheight = 120\n")
    done = runner(capsys)(
        *("run", "player", "--method", "small-newton", "--output", tmp_path / "run", "--camera", file, *options)
    )
    assert done.status == 0, done.err
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    assert config["sequence"]["camera"]["depth_scale"] == scale


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("player", "--rate", "15"), "--rate: not available for the live source 'player'"),
        (("player", "--resume"), "--resume: not available for the live source 'player'"),
        (("player", "--loops"), "--loops: not available for the live source 'player'"),
        (("player", "--map", "a.xyz"), "a.xyz: the name of a map must end in .ply"),
        (("player", "--frames", "1"), "at least 2"),
        (("empty",), "ended after 0 frames"),
        (("odd",), "colour image is uint8 of shape"),
    ],
)
def test_what_cannot_be_is_one_line(arguments, words, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    register_device("player", Player)
    register_device("empty", lambda: Player(frames=()))
    register_device("odd", lambda: Player(frames=SyntheticSequence(1, noise=NONE, camera=WIDE, color=True)))
    done = runner(capsys)("run", *arguments, "--method", "small-newton")
    assert done.status == 2
    assert words in done.err and done.err.count("\n") == 1


@pytest.mark.parametrize("command", [("compare", "player"), ("inspect", "player"), ("calibrate", "player")])
def test_other_commands_say_that_live_frames_are_not_for_them(command, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    register_device("player", Player)
    done = runner(capsys)(*command)
    assert done.status == 2 and "player: a live source, which only `gavo run` accepts" in done.err
