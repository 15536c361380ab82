"""Which images of a folder are depth, where others lie beside it that were made from it."""

from pathlib import Path

import numpy as np
import pytest
from written_folders import CAMERA_TOML, GREYS, METRES, image, raw

from gavo_jax.datasets.files import FileSequence
from gavo_jax.datasets.registry import open_source
from gavo_jax.errors import GavoError

EIGHT_BITS = [np.round(metres * 40).astype(np.uint8) for metres in METRES]
DISPARITIES = [np.where(metres > 0, 8 / np.maximum(metres, 0.1), 0) for metres in METRES]


def write(folder: Path, name: str, images: list[np.ndarray]) -> None:
    for i, pixels in enumerate(images):
        image(folder / name.format(i=i), pixels)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write(tmp_path, "rgb/{i:04}.png", GREYS)
    (tmp_path / "camera.toml").write_text(CAMERA_TOML)
    return tmp_path


def check(folder: Path) -> FileSequence:
    sequence = open_source(folder)
    assert isinstance(sequence, FileSequence) and len(sequence) == len(GREYS)
    for frame, metres in zip(sequence, METRES, strict=True):
        np.testing.assert_allclose(frame.depth / sequence.camera.depth_scale, metres, atol=1e-3)
    return sequence


@pytest.mark.parametrize(
    "name", ["depth_disparity", "depth_disp", "depth_inverse", "depth_colormap", "depth_8bit", "Depth_Visualization"]
)
def test_depth_goes_before_what_was_made_from_it(folder, name):
    """The first folder in alphabetical order was read, and disparity taken for depth."""
    write(folder, name + "/{i:04}.png", [raw(disparity, 1000) for disparity in DISPARITIES])
    write(folder, "depth_mm/{i:04}.png", [raw(metres, 1000) for metres in METRES])
    assert check(folder).left_out == (f"{name}/: not read, depth comes from depth_mm/",)


@pytest.mark.parametrize("name", ["depth_disparity", "depth_inv", "depth_8-bit"])
def test_a_folder_of_depth_alone_is_read_whatever_its_name(folder, name):
    write(folder, name + "/{i:04}.png", [raw(metres, 1000) for metres in METRES])
    assert open_source(folder).name == folder.name and len(open_source(folder)) == len(GREYS)


@pytest.mark.parametrize(
    ("depth", "other"),
    [
        ("{i:04}_depth.png", "{i:04}_conf.png"),
        ("{i:04}.png", "{i:04}_disparity.png"),
        ("{i:04}.npy", "{i:04}.png"),
        ("{i:04}.tiff", "{i:04}.png"),
    ],
)
def test_depth_is_told_from_what_lies_in_its_folder(folder, depth, other):
    """They had the same number, and one of them was to be removed."""
    images = [raw(metres, 1000) if depth.endswith(".png") else metres.astype(np.float32) for metres in METRES]
    write(folder, f"depth/{depth}", images)
    write(folder, f"depth/{other}", EIGHT_BITS if other == "{i:04}.png" else [raw(metres, 100) for metres in METRES])
    why = f"{len(GREYS)} images in depth/: derived from depth beside them, such as {other.format(i=0)}"
    assert check(folder).left_out == (why,)


def test_pictures_beside_depth_in_one_folder_are_left_out(tmp_path):
    """Those of disparity were taken for depth."""
    write(tmp_path, "left_{i}.png", GREYS)
    write(tmp_path, "depth_{i}.tiff", [metres.astype(np.float32) for metres in METRES])
    write(tmp_path, "depth_disp_{i}.tiff", [disparity.astype(np.float32) for disparity in DISPARITIES])
    (tmp_path / "camera.toml").write_text(CAMERA_TOML)
    check(tmp_path)


def test_depth_of_16_bits_beside_arrays_is_still_ambiguous(folder):
    write(folder, "depth/{i:04}.npy", [metres.astype(np.float32) for metres in METRES])
    write(folder, "depth/{i:04}.png", [raw(metres, 100) for metres in METRES])
    with pytest.raises(GavoError, match=r"has the same number as 0000\.npy: keep only one"):
        open_source(folder)
