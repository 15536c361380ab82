"""Images in odd guises: grey written as colour, and what lies in a file in place of an image."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from written_folders import CAMERA_TOML, GREYS, METRES, image, raw

from gavo_jax.datasets.base import FrameError
from gavo_jax.datasets.images import read_color, read_depth
from gavo_jax.datasets.registry import open_source

RAW = raw(METRES[0], 1000)
FLOATS = METRES[0].astype(np.float32)
OPAQUE = np.full_like(RAW, 65535)
GREY_AS_COLOUR = {
    "16 bits": (".png", [RAW] * 3),
    "with transparency": (".png", [RAW] * 3 + [OPAQUE]),
    "floats": (".tiff", [FLOATS] * 3),
    "NaN": (".tiff", [np.where(FLOATS > 2, np.nan, FLOATS)] * 3),
    "an array": (".npy", [RAW] * 3),
    "the bottom row first": (".pfm", [FLOATS] * 3),
}


@pytest.mark.parametrize("name", GREY_AS_COLOUR)
def test_depth_in_three_equal_channels_is_one(tmp_path: Path, name: str) -> None:
    """As Blender writes it, and whatever saves every image as RGB."""
    ending, channels = GREY_AS_COLOUR[name]
    image(tmp_path / f"depth{ending}", np.dstack(channels))
    np.testing.assert_array_equal(read_depth(tmp_path / f"depth{ending}"), channels[0])


@pytest.mark.parametrize(("depth", "found"), [(RAW, "16 bits"), ((RAW >> 8).astype(np.uint8), "8 bits")])
def test_depth_in_other_channels_is_refused(tmp_path: Path, depth: np.ndarray, found: str) -> None:
    image(tmp_path / "depth.png", np.dstack([depth, depth, depth + depth.dtype.type(found == "16 bits")]))
    with pytest.raises(FrameError, match=rf"depth\.png: not a depth image: .*found 3 channels of {found}"):
        read_depth(tmp_path / "depth.png")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:4d\nsize 9\n", r"a Git LFS pointer.*git lfs pull"),
        (b"<!DOCTYPE html><html>", "a web page instead of an image: download or copy the file again"),
        (b"\n<html><body>404", "a web page instead of an image: download or copy the file again"),
        (b"something", r"not an image that OpenCV can decode \(begins with b'somethin'\)"),
    ],
)
def test_what_lies_in_place_of_an_image_is_said(tmp_path: Path, content: bytes, words: str) -> None:
    (tmp_path / "1.png").write_bytes(content)
    for read in (read_color, read_depth):
        with pytest.raises(FrameError, match=rf"1\.png: {words}"):
            read(tmp_path / "1.png")


def test_colour_may_be_avif(tmp_path: Path) -> None:
    if not cv2.haveImageWriter("1.avif"):
        pytest.skip("this OpenCV writes none")
    for i in range(2):
        image(tmp_path / f"rgb/{i}.avif", np.dstack([GREYS[i]] * 3))
        image(tmp_path / f"depth/{i}.png", raw(METRES[i], 1000))
    (tmp_path / "camera.toml").write_text(CAMERA_TOML)
    sequence = open_source(tmp_path)
    assert np.abs(sequence[0].grey.astype(int) - GREYS[0]).mean() < 4
