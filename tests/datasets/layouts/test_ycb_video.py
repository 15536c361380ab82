"""YCB-Video: images of one folder whose depth is in tenths of a millimetre."""

from pathlib import Path

import numpy as np
import pytest
from written_folders import CAMERA_TOML, GREYS, METRES, image, raw

from gavo_jax.datasets.files import FileSequence, Reading
from gavo_jax.datasets.registry import open_source


@pytest.mark.parametrize(
    ("stated", "given", "expected"), [("", None, 10000), ("depth_scale = 1000\n", None, 1000), ("", 5000.0, 5000)]
)
def test_depth_is_in_tenths_of_a_millimetre(tmp_path: Path, stated: str, given: float | None, expected: float) -> None:
    """It was read in millimetres, ten times too far."""
    for i, (grey, metres) in enumerate(zip(GREYS, METRES, strict=True), 1):
        image(tmp_path / f"{i:06}-color.png", grey)
        image(tmp_path / f"{i:06}-label.png", grey)
        image(tmp_path / f"{i:06}-depth.png", raw(metres, expected))
        (tmp_path / f"{i:06}-meta.mat").write_bytes(b"MATLAB 5.0")
        (tmp_path / f"{i:06}-box.txt").write_text("002_master_chef_can 1 2 3 4\n")
    (tmp_path / "camera.toml").write_text(CAMERA_TOML + stated)
    sequence = open_source(tmp_path, Reading(depth_scale=given))
    assert isinstance(sequence, FileSequence) and len(sequence) == len(GREYS)
    assert sequence.kind == "YCB-Video sequence" and not sequence.unit_is_assumed
    assert sequence.camera.depth_scale == expected
    np.testing.assert_allclose(sequence[1].depth / expected, METRES[1], atol=1e-3)
