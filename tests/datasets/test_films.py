"""Colour in a film beside images of depth: the same frames as from images, in whatever order they are asked for."""

import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from written_folders import GREYS, LAYOUTS, STRAY_STAMPS, image

from gavo_jax.datasets import films
from gavo_jax.datasets.base import FrameError
from gavo_jax.datasets.files import FileSequence, Reading
from gavo_jax.datasets.registry import open_source
from gavo_jax.errors import GavoError


def film(path: Path, images: list[np.ndarray], rate: float = 25.0, kind: str = "FFV1") -> None:
    """Write a film; without loss, unless another kind is said."""
    height, width = images[0].shape
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*kind), rate, (width, height))
    assert writer.isOpened()
    for pixels in images:
        writer.write(cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGR))
    writer.release()


def filmed(folder: Path, layout: str, name: str = "rgb.mkv") -> FileSequence:
    """A layout's folder with a film in place of its folder of colour."""
    folder.mkdir()
    LAYOUTS[layout][1](folder)
    shutil.rmtree(folder / "rgb")
    film(folder / name, GREYS)
    sequence = open_source(folder)
    assert isinstance(sequence, FileSequence)
    return sequence


@pytest.mark.parametrize("layout", ["stray", "plain", "scannet_plus_plus"])
def test_a_film_gives_the_frames_of_images(tmp_path, layout):
    sequence = filmed(tmp_path / "clip", layout)
    sequence.check()
    assert len(sequence) == 4
    for index in (0, 1, 2, 3, 1, 3, 0):
        assert np.abs(sequence[index].grey.astype(int) - GREYS[index]).max() <= 1
    again = sequence[2:]
    assert np.abs(again[0].grey.astype(int) - GREYS[2]).max() <= 1
    assert sequence.files[3][0] == tmp_path / "clip" / "rgb.mkv"


def test_stamps_are_the_recorders_else_by_the_films_rate(tmp_path):
    np.testing.assert_allclose(filmed(tmp_path / "a", "stray").timestamps, STRAY_STAMPS)
    plain = filmed(tmp_path / "b", "plain")
    np.testing.assert_allclose(plain.timestamps, np.arange(4) / 25)
    assert plain.times_guessed == "as the film says"
    said = open_source(tmp_path / "b", Reading(rate=10.0))
    np.testing.assert_allclose(said.timestamps, np.arange(4) / 10)


def test_images_go_before_a_film(tmp_path):
    filmed(tmp_path / "clip", "plain")
    for i, grey in enumerate(GREYS):
        image(tmp_path / f"clip/rgb/{i}.png", 255 - grey)
    np.testing.assert_array_equal(open_source(tmp_path / "clip")[0].grey, 255 - GREYS[0])


def test_another_film_in_its_place_is_read_anew(tmp_path):
    sequence = filmed(tmp_path / "clip", "plain")
    assert np.abs(sequence[1].grey.astype(int) - GREYS[1]).max() <= 1
    film(tmp_path / "clip" / "rgb.mkv", [255 - grey for grey in GREYS])
    os.utime(tmp_path / "clip" / "rgb.mkv", ns=(1, 1))
    assert np.abs(sequence[2].grey.astype(int) - (255 - GREYS[2])).max() <= 1


def test_a_film_that_ends_early_lacks_frames(tmp_path, monkeypatch):
    sequence = filmed(tmp_path / "clip", "plain")
    film(tmp_path / "clip" / "rgb.mkv", GREYS[:2])
    os.utime(tmp_path / "clip" / "rgb.mkv", ns=(2, 2))
    with pytest.raises(FrameError, match=r"rgb\.mkv: frame 3: the film cannot be decoded that far"):
        sequence[3]
    assert np.abs(sequence[1].grey.astype(int) - GREYS[1]).max() <= 1
    (tmp_path / "clip" / "rgb.mkv").unlink()
    with pytest.raises(GavoError, match="image is missing"):
        sequence.check()


def test_what_is_no_film_is_refused_and_prints_nothing(tmp_path, capfd):
    filmed(tmp_path / "clip", "plain")
    (tmp_path / "clip" / "rgb.mkv").write_bytes(b"no film")
    with pytest.raises(GavoError, match=r"rgb\.mkv: a film or .*extract its images"):
        open_source(tmp_path / "clip")
    assert capfd.readouterr() == ("", "")


def test_a_film_that_was_cut_off_says_where_it_ends(tmp_path, capfd):
    many = [np.roll(GREYS[0], 2 * i, axis=1) for i in range(40)]
    (tmp_path / "depth").mkdir()
    film(tmp_path / "rgb.avi", many, kind="MJPG")
    whole = (tmp_path / "rgb.avi").read_bytes()
    (tmp_path / "rgb.avi").write_bytes(whole[: len(whole) // 2])
    places = films.frames_of(tmp_path / "rgb.avi")
    assert films.read_frame(places[0]).shape == (120, 160, 3)
    with pytest.raises(FrameError, match="the film cannot be decoded that far"):
        films.read_frame(tmp_path / "rgb.avi" / "000039")
    assert capfd.readouterr() == ("", "")


def test_a_film_alone_is_no_source(tmp_path):
    film(tmp_path / "rgb.mkv", GREYS)
    with pytest.raises(GavoError, match="a film"):
        open_source(tmp_path)
