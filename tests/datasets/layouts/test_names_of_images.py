"""What other programs call their colour and depth images, in one folder or in two."""

from pathlib import Path

import numpy as np
import pytest
from written_folders import CAMERA, GREYS, METRES, image, raw

from gavo_jax.datasets.files import FileSequence, Reading
from gavo_jax.datasets.registry import open_source
from gavo_jax.errors import GavoError


def named(folder: Path, color: str, depth: str) -> FileSequence:
    """Frames from 1 in files of some names; whole numbers are millimetres, arrays metres."""
    for i, (grey, metres) in enumerate(zip(GREYS, METRES, strict=True), 1):
        image(folder / color.format(i), grey)
        image(folder / depth.format(i), metres if depth.endswith(".npy") else raw(metres, 1000))
    sequence = open_source(folder, Reading(CAMERA))
    assert isinstance(sequence, FileSequence)
    return sequence


@pytest.mark.parametrize(
    ("color", "depth"),
    [
        ("desk_1_{}.png", "desk_1_{}_depth.png"),
        ("00019_indoors_{:03}.png", "00019_indoors_{:03}_depth.npy"),
        ("step{}.camera.png", "step{}.camera.Depth.png"),
        ("rgb_{:04}.png", "distance_to_image_plane_{:04}.npy"),
        ("rgb/rgb_{:04}.png", "distance_to_image_plane/distance_to_image_plane_{:04}.npy"),
        ("image/{:04}.png", "depth_map/{:04}.png"),
    ],
)
def test_images_as_programs_name_them(tmp_path: Path, color: str, depth: str) -> None:
    sequence = named(tmp_path, color, depth)
    assert [(e.color.name, e.depth and e.depth.name) for e in sequence.entries] == [
        (Path(color.format(i)).name, Path(depth.format(i)).name) for i in range(1, 5)
    ]


def test_masks_beside_depth_are_neither(tmp_path: Path) -> None:
    """RGB-D Object and DIODE have them; the colour image without depth is counted."""
    for i in range(1, 6):
        for kind in ("mask", "depth_mask"):
            image(tmp_path / f"apple_1_{i}_{kind}.png", GREYS[0])
    image(tmp_path / "apple_1_5.png", GREYS[0])
    sequence = named(tmp_path, "apple_1_{}.png", "apple_1_{}_depth.png")
    assert len(sequence) == 4 and list(sequence.left_out) == ["1 colour images: no depth image with the same number"]


def test_pictures_of_depth_beside_it_are_left_aside(tmp_path: Path) -> None:
    for i in range(1, 5):
        image(tmp_path / f"depth_colormap_{i}.png", np.dstack([GREYS[0]] * 3))
    assert len(named(tmp_path, "color_image_{}.png", "depth_image_{}.png")) == 4


def test_depth_that_azure_kinect_transforms_to_colour_goes_before_its_own(tmp_path: Path) -> None:
    for i in range(1, 5):
        image(tmp_path / f"depth/{i}.png", raw(METRES[0][::2, ::2], 1000))
    sequence = named(tmp_path, "color/{}.png", "transformed_depth/{}.png")
    assert sequence[0].depth.shape == (CAMERA.height, CAMERA.width)
    assert list(sequence.left_out) == ["depth/: not read, depth comes from transformed_depth/"]


def test_a_lone_pair_without_a_number_says_how_frames_are_named(tmp_path: Path) -> None:
    with pytest.raises(GavoError, match="; the two files of a frame need its number in their names"):
        named(tmp_path, "shot_Color.png", "shot_Depth.png")


@pytest.mark.parametrize(
    ("channels", "words"),
    [
        (1, "found 1 channel of 8 bits, a picture of depth: write depth as 16 bits or floats"),
        (
            3,
            "found 3 channels of 8 bits, a picture of depth or numbers packed into channels, as in CARLA: write",
        ),
    ],
)
def test_depth_of_8_bits_is_refused_with_what_it_may_be(tmp_path: Path, channels: int, words: str) -> None:
    for i in range(4):
        image(tmp_path / f"rgb/{i}.png", GREYS[0])
        image(tmp_path / f"depth/{i}.png", np.stack([GREYS[0]] * channels, axis=-1))
    with pytest.raises(GavoError, match=words):
        open_source(tmp_path, Reading(CAMERA))[0]
