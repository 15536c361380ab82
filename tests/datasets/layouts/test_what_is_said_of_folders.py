"""What is said of folders whose lists, times or units are not those of their images."""

from pathlib import Path

import numpy as np
import pytest
from written_folders import CAMERA_TOML, GREYS, METRES, image, raw

from gavo_jax.datasets.registry import open_source
from gavo_jax.datasets.selection import open_part
from gavo_jax.errors import GavoError


def tum(folder: Path, scale: float, listed: str = "{kind}/{i}.png", ending: str = "png") -> Path:
    for kind, images in (("rgb", GREYS), ("depth", [raw(metres, scale) for metres in METRES])):
        for i, pixels in enumerate(images):
            image(folder / f"{kind}/{i}.{ending if kind == 'rgb' else 'png'}", pixels)
        rows = [f"{1000 + i / 30:.6f} {listed.format(kind=kind, i=i)}\n" for i in range(len(images))]
        (folder / f"{kind}.txt").write_text("".join(rows))
    (folder / "camera.toml").write_text(CAMERA_TOML)
    return folder


def test_the_unit_of_tums_layout_is_doubted_where_another_is_usual(tmp_path: Path) -> None:
    """Recorders write that layout in millimetres; unless a Kinect's, they were taken for fifths of one."""
    folder = tum(tmp_path, 1000 / np.median(METRES))
    with pytest.raises(GavoError, match=r"5000 per metre, a guess, has a median of 0\.2.*--depth-scale 1000\) it is"):
        open_part(str(folder))
    (folder / "camera.toml").write_text(CAMERA_TOML + "depth_scale = 5000\n")
    assert open_part(str(folder)).camera.depth_scale == 5000


@pytest.mark.parametrize(("listed", "ending"), [("{kind}/{i}.png", "jpg"), ("{kind}/{i}", "png")])
def test_an_image_of_another_ending_is_named(tmp_path: Path, listed: str, ending: str) -> None:
    """As where somebody has compressed the images, and not touched the lists."""
    folder = tum(tmp_path, 5000, listed, ending)
    with pytest.raises(
        GavoError, match=rf"rgb/0(\.png)?: image is missing, but 0\.{ending} is there: correct the list"
    ):
        open_part(str(folder))


def test_images_in_folders_of_their_own_are_told(tmp_path: Path) -> None:
    image(tmp_path / "rgb/cam0/0.png", GREYS[0])
    image(tmp_path / "depth/cam0/0.png", raw(METRES[0], 1000))
    with pytest.raises(GavoError, match=r"no colour images in rgb \(cam0\): if they are in cam0/, link it as rgb/"):
        open_source(tmp_path)
