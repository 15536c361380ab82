"""Numbers that are no depth are recognised, and real depth never is taken for such."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from written_folders import CAMERA, CAMERA_TOML, GREYS, METRES, image, kinect, raw

from gavo_jax.datasets.depth_doubts import doubt_of_depth, doubt_of_limit, fault_of_depth
from gavo_jax.datasets.depth_unit import first_depths
from gavo_jax.datasets.registry import open_source
from gavo_jax.datasets.selection import open_part
from gavo_jax.errors import GavoError

CLIPS = ("fr1_xyz", "fr1_desk", "fr1_rpy", "fr1_desk_loop", "redkitchen_7scenes")
HOLES = np.random.default_rng(0).random((120, 160)) < 0.2
KINECTS_DEPTH = [np.where(HOLES, 0, kinect(np.maximum(metres, 0.5), 1000)).astype(np.uint16) for metres in METRES]


def source(folder: Path, depths: list[np.ndarray], ending: str = ".png") -> Path:
    for i, (grey, depth) in enumerate(zip(GREYS, depths, strict=True)):
        image(folder / f"rgb/{i}.png", grey)
        image(folder / f"depth/{i}{ending}", depth)
    (folder / "camera.toml").write_text(CAMERA_TOML)
    return folder


def disparity(millimetres: np.ndarray) -> np.ndarray:
    """Kinect's 11 bits, larger where it is farther, 2047 where there is none."""
    some = np.maximum(millimetres, 1)
    return np.where(millimetres > 0, np.clip(1091 - 3.5e5 / some, 0, 2046), 2047).astype(np.uint16)


FAULTS: dict[str, tuple[Callable[[np.ndarray], np.ndarray], str]] = {
    "bytes": (lambda depth: depth.byteswap(), r"in the wrong byte order: swap them"),
    "a picture times 257": (
        lambda depth: (depth // 40 * 257).astype(np.uint16),
        "multiple of 257: an 8-bit picture of depth, stretched",
    ),
    "a picture times 256": (
        lambda depth: (depth // 40 * 256).astype(np.uint16),
        "multiple of 256: an 8-bit picture of depth, stretched",
    ),
    "raw disparity": (disparity, "2047 for missing readings: the raw disparity of a Kinect"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_numbers_that_are_no_depth_are_refused_in_one_line_unless_forced(tmp_path: Path, name: str) -> None:
    as_stored, words = FAULTS[name]
    folder = source(tmp_path, [as_stored(depth) for depth in KINECTS_DEPTH])
    with pytest.raises(GavoError, match=f"{folder}: .*{words}.*, or continue with --force$") as caught:
        open_part(str(folder))
    assert len(str(caught.value).splitlines()) == 1
    assert len(open_part(str(folder), force=True)) == len(METRES)


def test_integers_that_are_a_far_scene_in_a_guessed_unit_are_refused(tmp_path: Path) -> None:
    """Of a room they made one of forty metres, and a trajectory as large."""
    folder = source(tmp_path, [raw(8 * metres, 4000) for metres in METRES])
    with pytest.raises(
        GavoError, match=r"depth in millimetres, a guess, has a median of .* m: set --depth-scale, unit"
    ):
        open_part(str(folder))
    for said in (1000.0, 4000.0):
        (folder / "camera.toml").write_text(f"{CAMERA_TOML}depth_scale = {said}\n")
        assert open_part(str(folder)).camera.depth_scale == said


@pytest.mark.parametrize("ending", [".png", ".npy"])
@pytest.mark.parametrize(
    ("limit", "words"), [(10.0, "of the readings are 10 m, the farthest: if that is a limit"), (3.0, None)]
)
def test_a_limit_in_place_of_no_reading_is_told(tmp_path: Path, ending: str, limit: float, words: str | None) -> None:
    """A wall at three metres is none."""
    depths = [np.where(HOLES, limit, np.minimum(metres, 2.99)) for metres in METRES]
    as_stored = [raw(depth, 1000) if ending == ".png" else depth.astype(np.float32) for depth in depths]
    doubt = doubt_of_depth(open_source(source(tmp_path, as_stored, ending)))
    assert doubt is None if words is None else doubt and words in doubt


@pytest.mark.parametrize(("limit", "words"), [(1.5, "of the readings are 1.5 m, the farthest"), (2.8, None)])
def test_depth_that_was_cut_off_is_told(tmp_path: Path, limit: float, words: str | None) -> None:
    """What lay behind became a wall that moved with the camera: drift grew fivefold, and all pairs were ok."""
    sequence = open_source(source(tmp_path, [raw(np.minimum(metres, limit), 1000) for metres in METRES]))
    doubt = doubt_of_limit(sequence, first_depths(sequence))
    assert doubt is None if words is None else doubt and words in doubt


def test_depth_that_is_the_same_everywhere_is_told(tmp_path: Path) -> None:
    doubt = doubt_of_depth(open_source(source(tmp_path, [np.full((120, 160), 1500, np.uint16)] * 4)))
    assert doubt == "every reading is 1.5 m"


def slanted(slope: float) -> np.ndarray:
    """Depth, in millimetres, of a box with a floor and two walls that recede."""
    x = (np.arange(160) - CAMERA.cx) / CAMERA.fx
    y = (np.arange(120) - CAMERA.cy)[:, None] / CAMERA.fy
    floor = np.where(y > 0, 1.2 / np.maximum(y, 1e-6), np.inf)
    walls = 1.5 / np.maximum(np.abs(x), 1e-6) * slope
    return 1000 * np.minimum(np.minimum(floor, walls), 6.0)


INVERSES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "disparity": lambda depth: 1e7 / depth,
    "MiDaS": lambda depth: 1e7 / depth - 1e7 / depth.max() + 900,
}


@pytest.mark.parametrize("name", ["depth", *INVERSES])
def test_numbers_that_grow_with_nearness_are_told_by_flat_surfaces(tmp_path: Path, name: str) -> None:
    depths = [slanted(1 + 0.05 * i) for i in range(len(METRES))]
    as_stored = [np.round(INVERSES.get(name, lambda depth: depth)(depth)).astype(np.uint16) for depth in depths]
    doubt = doubt_of_depth(open_source(source(tmp_path, as_stored)))
    assert (doubt is not None and "this looks like disparity or inverse depth" in doubt) == (name != "depth")


@pytest.mark.parametrize("clip", CLIPS)
def test_real_clips_are_not_doubted(data_dir: Path, clip: str) -> None:
    sequence = open_part(str(data_dir / clip))
    for start in range(0, len(sequence) - 10, 20):
        part = sequence[start : start + 10]
        assert fault_of_depth(part) is None and doubt_of_depth(part) is None
