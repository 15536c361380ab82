"""Depth scales that are wrong by 5 or 1000 are noticed; right ones never are, near or far."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from written_folders import CAMERA, LAYOUTS, METRES, image, kinect, raw

from gavo_jax.camera import Camera
from gavo_jax.camera_files.calibration import Calibration
from gavo_jax.datasets.depth_doubts import doubt_of_depth
from gavo_jax.datasets.depth_unit import (
    better_scale,
    doubt_of_guess,
    doubt_of_scale,
    is_unusual,
    lack_of_depth,
    sample_depth,
)
from gavo_jax.datasets.files import Entry, FileSequence, Reading
from gavo_jax.datasets.images import read_depth
from gavo_jax.datasets.registry import open_source
from gavo_jax.datasets.rendered.sensor_noise import KINECT
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.datasets.selection import open_part
from gavo_jax.errors import GavoError

FR1 = Camera.preset("fr1")
OWN = Camera(520.0, 520.0, 319.5, 239.5, 640, 480)
RNG = np.random.default_rng(0)
CLIPS = ("fr1_xyz", "fr1_desk", "fr1_rpy")


def depths(low: float, high: float) -> np.ndarray:
    return np.exp(RNG.uniform(np.log(low), np.log(high), (240, 320)))


def stereo(metres: np.ndarray, scale: float, step: float) -> np.ndarray:
    """As another stereo camera returns it, in finer steps of disparity."""
    return np.round(scale / (np.round(1 / metres / step) * step)).astype(np.uint16)


def smooth(metres: np.ndarray, scale: float) -> np.ndarray:
    """As a time-of-flight camera returns it."""
    return np.round(scale * metres).astype(np.uint16)


def proposed(image: np.ndarray, scale: float, camera: Camera, is_kinect: bool) -> float | None:
    sample = sample_depth([image])
    assert sample is not None
    return better_scale(sample, scale, camera, is_kinect)


SCENES = [(0.37, 0.5), (0.36, 0.8), (0.4, 1.2), (1.0, 3.0), (2.0, 6.0), (5.0, 9.5), (7.5, 9.0)]


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("scale", [1000.0, 5000.0])
@pytest.mark.parametrize("sensor", [kinect, smooth])
def test_right_scales_are_never_doubted(scene, scale, sensor):
    image = sensor(depths(*scene), scale)
    assert proposed(image, scale, OWN, False) is None
    assert proposed(image, scale, FR1, True) is None


@pytest.mark.parametrize("step", [3.3e-4, 5.1e-4, 5.7e-4, 6.8e-4, 1.04e-3, 2e-3])
@pytest.mark.parametrize("scene", [*SCENES, (0.15, 0.4)])
def test_other_sensors_are_never_taken_for_a_kinect(scene, step):
    """RealSense cameras, by the step of their disparity; their lenses see wider or narrower."""
    image = stereo(depths(*scene), 1000.0, step)
    for focal in (425.0, 640.0):
        assert proposed(image, 1000.0, Camera(focal, focal, 424, 240, 848, 480), False) is None


@pytest.mark.parametrize("scene", [(0.6, 1.5), (1.0, 3.0), (1.5, 4.0)])
@pytest.mark.parametrize(("scale", "said"), [(5000.0, 1000.0), (1000.0, 5000.0)])
def test_a_kinects_steps_tell_a_factor_of_five(scene, scale, said):
    image = kinect(depths(*scene), scale)
    assert proposed(image, said, OWN, False) == scale
    assert proposed(image, said, FR1, True) == scale


def test_a_kinect_sees_nothing_nearer_than_it_can():
    assert proposed(smooth(depths(0.8, 1.5), 1000.0), 5000.0, FR1, True) == 1000
    assert proposed(smooth(depths(0.8, 1.5), 1000.0), 5000.0, OWN, False) is None


@pytest.mark.parametrize(("scale", "said"), [(1000.0, 1.0), (5000.0, 1.0), (5000.0, 5e6), (1000.0, 1e6)])
@pytest.mark.parametrize("sensor", [kinect, smooth])
def test_a_factor_of_a_thousand_is_told_by_the_range(scale, said, sensor):
    better = proposed(sensor(depths(1.0, 3.0), scale), said, FR1, True)
    assert better == (scale if sensor is kinect else better) and better in (1000, 5000)


@pytest.mark.parametrize("said", [1000.0, 5000.0])
def test_a_kinects_steps_tell_of_tenths_of_a_millimetre(said):
    image = kinect(depths(1.0, 3.0), 10000.0)
    assert proposed(image, said, OWN, False) == proposed(image, said, FR1, True) == 10000
    assert proposed(image, 10000.0, OWN, False) is None


def test_centimetres_read_as_millimetres():
    image = smooth(depths(0.8, 2.0), 100.0)
    assert proposed(image, 1000.0, OWN, False) == proposed(image, 1000.0, FR1, True) == 100
    assert proposed(image, 100.0, OWN, False) is None


def test_metres_read_as_millimetres():
    metres = depths(1.0, 3.0).astype(np.float32)
    assert proposed(metres, 1000.0, FR1, True) == 1
    assert proposed(metres, 1.0, FR1, True) is None
    assert sample_depth([np.zeros((4, 4), np.uint16)]) is None


@pytest.mark.parametrize(("scale", "words"), [(5000.0, r"in millimetres \(--depth-scale 1000\) it is"), (1000.0, None)])
def test_a_depth_that_is_unusually_near_is_set_beside_another_unit(tmp_path, scale, words):
    """It was only said to be `depth_units`, of each frame."""
    for i, metres in enumerate(METRES):
        image(tmp_path / f"rgb/{i}.png", np.full((120, 160), 99, np.uint8))
        image(tmp_path / f"depth/{i}.png", raw(0.5 * metres, 1000))
    doubt = doubt_of_scale(open_source(tmp_path, Reading(CAMERA, depth_scale=scale)))
    assert doubt is None if words is None else doubt and re.search(words, doubt) and "fractions" not in doubt


def test_of_two_units_the_one_that_gives_an_ordinary_room_is_proposed():
    """Catches the one that brings everything nearest: fifths of a millimetre would be 0.6 m, millimetres are 3 m."""
    assert proposed(smooth(depths(2.5, 3.5), 1000.0), 1e6, OWN, False) == 1000
    assert proposed(smooth(depths(0.9, 1.1), 5000.0), 1e7, OWN, False) == 5000


@pytest.mark.parametrize(
    ("median", "farthest", "scale", "unusual"),
    [
        (1.0, 3.0, 1000.0, False),
        (0.2, 0.5, 1000.0, False),  # a wrist's camera: in no other unit is it usual
        (0.2, 0.5, 5000.0, True),  # 1 m in millimetres
        (0.1, 0.5, 1000.0, True),
        (200.0, 900.0, 1000.0, True),
        (30.0, 90.0, 1.0, False),  # a street
        (0.3, 1.0, 1.0, True),  # shares of a greatest distance
        (0.3, 1.1, 1.0, False),
    ],
)
def test_depth_is_unusual_where_another_unit_would_make_it_usual(median, farthest, scale, unusual):
    assert is_unusual(median, farthest, scale) == unusual


@pytest.mark.parametrize("recorded", [True, False])
def test_depth_that_misses_the_colour_image_is_told_from_none_at_all(recorded):
    """Catches the wrong advice: an inverted transform between the cameras leaves nothing, though all was read."""
    sequence = SyntheticSequence(frames=3, camera=CAMERA)

    class Missed:
        camera, calibration = CAMERA, None

        def __len__(self):
            return 3

        def __getitem__(self, index):
            return replace(sequence[index], depth=np.zeros_like(sequence[index].depth))

        def raw_depth(self, index):
            return sequence[index].depth * recorded

    lack = lack_of_depth(Missed())  # pyright: ignore[reportArgumentType]
    words = "no depth reading of the 3 frames sampled falls into the colour image" if recorded else "no depth readings"
    assert lack and lack.startswith(words)
    assert lack_of_depth(sequence) is None


def tum_folder(folder: Path, metres: np.ndarray, scale: float, sensor=smooth, stated: str = "") -> Path:
    image(folder / "rgb/0.png", np.full(metres.shape, 99, np.uint8))
    image(folder / "depth/0.png", sensor(metres, scale))
    for name in ("rgb", "depth"):
        (folder / f"{name}.txt").write_text(f"1.000000 {name}/0.png\n")
    (folder / "camera.toml").write_text(f"fx=260\nfy=260\ncx=159.5\ncy=119.5\nwidth=320\nheight=240\n{stated}")
    return folder


@pytest.mark.parametrize("is_run", [False, True])
def test_millimetres_in_the_layout_of_tum_are_doubted(tmp_path, is_run):
    """A room of 2 to 7 m was read as one of 0.4 to 1.4 m, without a word but that the unit is a guess."""
    told = doubt_of_guess if is_run else doubt_of_depth
    folder = tum_folder(tmp_path, depths(1.95, 7.0), 1000.0)
    assert re.match(r"its unit is a guess, .* in millimetres \(--depth-scale 1000\)", told(open_source(folder)) or "")
    assert told(open_source(folder, Reading(depth_scale=5000.0))) is None


@pytest.mark.parametrize(
    ("scene", "sensor", "stated"),
    [
        ((0.5, 1.5), kinect, ""),
        ((1.95, 7.0), smooth, ""),
        ((0.5, 1.5), smooth, "depth_scale=5000"),
    ],
)
def test_a_unit_that_is_known_or_likely_is_not_doubted(tmp_path, scene, sensor, stated):
    folder = tum_folder(tmp_path, depths(*scene), 5000.0, sensor, stated)
    assert doubt_of_guess(open_source(folder)) is None


@pytest.mark.parametrize(("reach", "is_told"), [(40.0, True), (4.0, False)])
def test_floats_that_may_be_shares_of_a_greatest_distance_are_told(tmp_path, reach, is_told):
    """As Habitat normalises depth: it was a scene of a few centimetres, without a word but for each frame's."""
    for i, metres in enumerate(METRES):
        image(tmp_path / f"rgb/{i}.png", np.full((120, 160), 99, np.uint8))
        image(tmp_path / f"depth/{i}.npy", (metres / reach).astype(np.float32))
    doubt = doubt_of_scale(open_source(tmp_path, Reading(CAMERA)))
    assert (doubt is not None and "fractions of a largest distance: pass --depth-scale 0.1 if" in doubt) == is_told


@pytest.mark.parametrize("is_packed", [True, False])
def test_floats_of_16_bits_in_png_are_told(tmp_path, is_packed):
    """Mid-Air keeps depth so; as millimetres it is a plausible street."""
    for i, metres in enumerate(METRES):
        image(tmp_path / f"rgb/{i}.png", np.full((120, 160), 99, np.uint8))
        depth = np.maximum(metres, 0.5) + 3
        image(tmp_path / f"depth/{i}.png", depth.astype(np.float16).view(np.uint16) if is_packed else raw(depth, 7000))
    doubt = doubt_of_scale(open_source(tmp_path, Reading(CAMERA, depth_scale=1000.0)))
    middle = f"{np.median(np.concatenate(METRES[:3])) + 3:.1f}"
    assert doubt and ("as bits of floats, as in PNG of Mid-Air" in doubt) == is_packed
    assert not is_packed or f"it is {middle}" in doubt


def test_a_wrong_scale_is_refused_in_one_line_unless_forced(tmp_path):
    (tmp_path / "clip").mkdir()
    LAYOUTS["plain"][1](tmp_path / "clip")
    for i, metres in enumerate(METRES):
        (tmp_path / f"clip/depth/{i}.tiff").unlink()
        image(tmp_path / f"clip/depth/{i}.png", kinect(np.maximum(metres, 0.5), 1000))
    assert CAMERA.depth_scale == 5000
    wrong = tmp_path / "wrong.toml"
    wrong.write_text("fx=131\nfy=131\ncx=79.5\ncy=59.5\nwidth=160\nheight=120\ndepth_scale=5000\n")
    with pytest.raises(
        GavoError, match=r"clip: .*millimetres; set --depth-scale 1000, or continue with --force"
    ) as caught:
        open_part(str(tmp_path / "clip"), str(wrong))
    assert len(str(caught.value).splitlines()) == 1
    assert open_part(str(tmp_path / "clip"), str(wrong), force=True).camera.depth_scale == 5000
    assert open_part(str(tmp_path / "clip")).camera.depth_scale == 1000


@pytest.mark.parametrize("clip", CLIPS)
def test_real_clips(data_dir, clip):
    """In their units, none is doubted from any frame on; in others each is."""
    sequence = open_part(str(data_dir / clip))
    for start in range(0, len(sequence) - 2, 6):
        images = [sequence[i].depth for i in range(start, start + 3)]
        for camera, is_kinect in ((FR1, True), (OWN, False)):
            sample = sample_depth(images)
            assert sample is not None and better_scale(sample, 5000.0, camera, is_kinect) is None
            assert better_scale(sample, 1000.0, camera, is_kinect) == 5000
            metric = sample_depth([raw(image / 5000, 1000) for image in images])
            assert metric is not None and better_scale(metric, 1000.0, camera, is_kinect) is None
            assert better_scale(metric, 5000.0, camera, is_kinect) == 1000


def test_the_rendered_room():
    camera = replace(CAMERA, depth_scale=1000.0)
    for said, right in ((1000.0, None), (5000.0, 1000.0)):
        images = [frame.depth for frame in SyntheticSequence(frames=3, noise=KINECT, camera=camera)]
        sample = sample_depth(images)
        assert sample is not None and better_scale(sample, said, camera) == right


def test_a_source_that_reads_depth_in_its_own_way_is_sampled_so(tmp_path):
    """The unit was that of whole numbers, as the file holds them, and not of the metres that the source makes of it."""

    class Packed(FileSequence):
        @classmethod
        def depth_in(cls, file: Path) -> np.ndarray:
            return (read_depth(file) / 256).astype(np.float32)

    image(tmp_path / "colour.png", np.full((120, 160), 90, np.uint8))
    image(tmp_path / "depth.png", raw(METRES[0], 256))
    entries = [Entry(0.0, tmp_path / "colour.png", tmp_path / "depth.png")]
    sequence = Packed("packed", entries, Calibration(CAMERA, states_depth_scale=False))
    metres = sequence[0].depth / sequence.camera.depth_scale
    assert np.median(np.abs(metres - METRES[0])) < 0.01
