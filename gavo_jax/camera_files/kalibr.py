"""Kalibr's camera chains: one camera, or colour and depth, told apart by their topics."""

import re
from pathlib import Path

import numpy as np

from gavo_jax.camera_files.words import Table, rest_of_camera
from gavo_jax.errors import GavoError, shown

OF_COLOR = re.compile(r"colou?r|rgb")
"""Matches topics of colour cameras."""

OF_DEPTH = re.compile(r"(?<![a-z])(?:depth|infra(?:red)?|ir)\d*(?![a-z])")
"""Matches topics of the camera that depth belongs to; infrared images show its pattern of corners."""

OF_SIDE = re.compile(r"(?<![a-z])(?:left|right)(?![a-z])")
"""Matches topics of a stereo pair."""


def is_kalibr(values: Table) -> bool:
    """Whether a file is a chain of cameras."""
    return "cam0" in values


def is_one_of_kalibr(values: Table) -> bool:
    """Whether a file is a single camera, as in a chain."""
    return isinstance(values.get("intrinsics"), list) and "resolution" in values


def read_kalibr(path: Path, values: Table) -> Table:
    """Looks like Kalibr's camera chain."""
    first = read_one_of_kalibr(path, values["cam0"])
    if "cam1" not in values:
        return first
    second = read_one_of_kalibr(path, values["cam1"])
    second_T_first = np.array(values["cam1"]["T_cn_cnm1"], float)
    if _is_depth_first(path, *(str(values[name].get("rostopic", "")) for name in ("cam0", "cam1"))):
        return {**second, "depth": first, "colour_T_depth": second_T_first.tolist()}
    return {**first, "depth": second, "colour_T_depth": np.linalg.inv(second_T_first).tolist()}


def _is_depth_first(path: Path, *topics: str) -> bool:
    """Whether the first of two topics is that of depth; colour is first where they do not say.

    Raises:
        GavoError: neither can be colour, or both are.
    """
    colors = [bool(OF_COLOR.search(topic.lower())) for topic in topics]
    depths = [bool(OF_DEPTH.search(topic.lower())) and not color for topic, color in zip(topics, colors, strict=True)]
    is_pair = all(OF_SIDE.search(topic.lower()) for topic in topics) and not any(colors + depths)
    if depths[0] and not colors[1] or all(colors) or is_pair:
        raise GavoError(
            f"{path}: cam0 and cam1 are {topics[0][:60]} and {topics[1][:60]}: expected colour and depth (or the "
            "infrared image of its camera); if depth is registered to colour, write the colour camera alone as cam0"
        )
    return depths[0]


def read_one_of_kalibr(path: Path, values: Table) -> Table:
    """Looks like a camera of Kalibr or of EuRoC."""
    if values.get("camera_model", "pinhole") != "pinhole":
        raise GavoError(f"{path}: camera_model {shown(values['camera_model'])}: only pinhole is supported")
    (fx, fy, cx, cy), (width, height) = values["intrinsics"], values["resolution"]
    size = {"width": width, "height": height}
    return {"fx": fx, "fy": fy, "cx": cx, "cy": cy, **size, **rest_of_camera(str(path), values)}
