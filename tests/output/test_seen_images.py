"""Whether the images of a run are still those that it has seen, whatever their format."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from gavo_jax.output.seen_images import SeenImages


@pytest.mark.parametrize("ending", [".png", ".pgm", ".tiff"])
def test_other_depth_with_the_same_last_row_is_noticed(tmp_path: Path, ending: str) -> None:
    """Only a PNG ends with a checksum of its pixels."""
    depth = np.random.default_rng(0).integers(1000, 9000, (120, 160)).astype(np.uint16)
    depth[-1] = 0
    paths = [tmp_path / f"{name}{ending}" for name in ("one", "same", "halved", "constant")]
    for path, image in zip(paths, [depth, depth, depth // 2, np.where(depth > 0, 5000, 0)], strict=True):
        assert cv2.imwrite(str(path), image.astype(np.uint16), [cv2.IMWRITE_TIFF_COMPRESSION, 1])
    one, same, halved, constant = (SeenImages([(path,)]).up_to(0) for path in paths)
    assert one == same and len({one, halved, constant}) == 3


def test_files_of_a_recording_count_with_its_first_frame(tmp_path: Path) -> None:
    recording = tmp_path / "bag"
    data = np.random.default_rng(0).integers(0, 256, 300_000).astype(np.uint8)
    data.tofile(recording)
    before = SeenImages([(recording,), (), ()])
    assert before.up_to(0) == before.up_to(2)
    (data // 2).tofile(recording)
    assert SeenImages([(recording,), (), ()]).up_to(0) != before.up_to(2)


def test_a_missing_file_is_another_than_an_empty_one(tmp_path: Path) -> None:
    (tmp_path / "empty").touch()
    assert SeenImages([(tmp_path / "empty",)]).up_to(0) != SeenImages([(tmp_path / "missing",)]).up_to(0)
    assert SeenImages().up_to(0) == SeenImages([()]).up_to(0)
