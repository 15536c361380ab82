"""Camera files of known kinds that cannot be read: how to convert them, by the keys or words in them."""

import re
from pathlib import Path

from gavo_jax.camera_files.words import FOCAL, LEAST_UNITS, REQUIRED, Table
from gavo_jax.errors import GavoError

ONE_FRAME = "metadata of a frame: omit --camera if it is beside the images, or write fx, fy, cx and cy"

BY_NAME: tuple[tuple[re.Pattern[str], str], ...] = (
    (
        re.compile("cameraData"),
        "DepthAI's calibration, for the whole sensors of an OAK: write fx, fy, cx and cy of the colour camera at the "
        "size of the images (getCameraIntrinsics(socket, width, height))",
    ),
    (
        re.compile("CalibrationInformation"),
        "Azure Kinect's raw calibration, in fractions of its sensors: use the intrinsic.json that Open3D's "
        "azure_kinect_mkv_reader.py writes",
    ),
    (
        re.compile("schema version"),
        "settings of RealSense's viewer, without intrinsics: write width, height, fx, fy, ppx, ppy, model and coeffs, "
        "which rs-enumerate-devices -c prints",
    ),
    (re.compile("cameraPoseARFrame|t_00|cam_K"), ONE_FRAME),
    (re.compile(r"\d+|frame_\d+"), f"one camera per frame: {ONE_FRAME}"),
    (
        re.compile(r"(?i).*(fov|aperture|angle|focal|sensor_?width).*"),
        "a lens or an angle of view in place of fx and fy: those are width / (2 tan(angle / 2)), or width * focal "
        "length / aperture, and the middle of an image is cx = (width - 1) / 2",
    ),
)
"""Keys, and what a file with such a key is, in the order in which they are tried."""

IN_TEXT: tuple[tuple[str, str], ...] = (
    (r"(?i)\bppx\b", "of RealSense: write width, height, fx, fy, ppx, ppy, model and coeffs into a .json"),
    (r"^(P\d|P_rect_\d\d|K_\d\d):", "of KITTI: write the first, sixth, third and seventh number of the images' P"),
    (r"^\s*fx\s*:", "if its values have names, rename it to .yaml"),
    (r"^\s*fx\s*=", "if its values have names, rename it to .toml"),
    (r"^\s*fx\s+[-+\d]", "if its values have names, put = behind each and rename it to .toml"),
)
"""Patterns in a text of numbers that cannot be read, and advice."""

BY_ENDING = {
    ".npy": "write it as text: numpy.savetxt('camera.txt', numpy.load(FILE))",
    ".npz": "write its matrix as text: numpy.savetxt('camera.txt', …)",
    ".conf": "a ZED's applies to unrectified images, which its SDK does not export: write the left camera of "
    "its calibration_parameters as .toml",
    ".ini": "rename it to .toml, with one camera's fx = …, fy = …, cx = … and cy = … in it",
    ".cfg": "rename it to .toml, or to .txt if it is a matrix or a row of numbers",
    ".bin": "COLMAP's: write it as cameras.txt (colmap model_converter --output_type TXT)",
}
"""Advice for other suffixes."""

DEEPEST = 3
"""Maximum depth of nested tables searched for cameras."""


def refuse_foreign(path: Path, values: Table) -> None:
    """Refuse a table of a known kind that cannot be read, or whose cameras are in nested tables; otherwise do nothing.

    Raises:
        GavoError: the message says what would help.
    """
    if {*FOCAL} & values.keys():
        return
    if within := _cameras_within(values, ""):
        names = ", ".join(within[:3])
        raise GavoError(f"{path}: a camera in {names}: write that of colour alone, its fx, fy, cx and cy at the top")
    for pattern, words in BY_NAME:
        if any(pattern.fullmatch(name) for name in values):
            raise GavoError(f"{path}: {words}")


def _cameras_within(values: Table, above: str) -> list[str]:
    """Paths of the nested tables that contain a camera, such as `color` or `Dataset.Calibration`."""
    found = []
    for name, inner in values.items():
        if not isinstance(inner, dict):
            continue
        place = f"{above}{name[:60]}"
        found += [place] if {"fx", "fy"} <= inner.keys() else []
        if place.count(".") + 1 < DEEPEST:
            found += _cameras_within({str(key): value for key, value in inner.items()}, f"{place}.")
    return found


def hint_of_text(text: str) -> str:
    """Advice for a text of numbers that cannot be read, after a colon; empty if there is none."""
    words = next((words for pattern, words in IN_TEXT if re.search(pattern, text, re.MULTILINE)), "")
    return words and f": {words}"


def hint_of_ending(path: Path) -> str:
    """Advice for a file of another suffix, after a colon; empty if there is none."""
    words = BY_ENDING.get(path.suffix.lower(), "")
    return words and f": {words}"


def refuse_bop_camera(path: Path, values: Table) -> None:
    """Refuse the `camera.json` of a BOP dataset: it has our keys, but its `depth_scale` is in millimetres per unit.

    Raises:
        GavoError: the message says what to write.
    """
    scale = values.get("depth_scale")
    if values.keys() == {*REQUIRED, "depth_scale"} and isinstance(scale, float) and LEAST_UNITS <= scale < 1:
        raise GavoError(
            f"{path}: depth_scale: {scale:g}: less than one unit per metre; BOP's is in millimetres per unit: write "
            f"{1000 / scale:g}, in units per metre"
        )
