"""Ground truth files of a sequence's bodies: `bodies_truth.csv`, and one label image per frame."""

from collections.abc import Iterable
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
from jaxtyping import UInt8

from gavo_jax.datasets.rendered.moving import BodyTruth, body_of_part
from gavo_jax.trajectory import format_tum_row

TRUTH, MASKS = "bodies_truth.csv", "masks"
COLUMNS = "timestamp,body,part,tx,ty,tz,qx,qy,qz,qw,share"


class WithBodies(Protocol):
    """A sequence of frames that also has ground truth of its bodies."""

    @property
    def bodies_truth(self) -> tuple[BodyTruth, ...]:
        """Exact poses of every body at the stamps of all frames."""
        ...

    def part_labels(self, index: int) -> UInt8[np.ndarray, "height width"]:
        """Which rigid part of a body each pixel of a frame shows; 0 for none."""
        ...


def write_mask(sequence: WithBodies, index: int, timestamp: float, stamp: str, folder: Path) -> list[str]:
    """Write masks/STAMP.png, 8 bit: the label of the body at each pixel, 0 where there is none.

    Args:
        sequence: the frames.
        index: of the frame.
        timestamp: of the frame, seconds.
        stamp: the timestamp as written in file names.
        folder: parent of the existing folder `masks`.

    Returns:
        One row of bodies_truth.csv (`COLUMNS`) per rigid part: the labels of its body and of the part, `world_T_part`
        (m; the quaternion's real part last) and the share of the image that it covers.

    Raises:
        OSError: the file cannot be written.
    """
    labels = sequence.part_labels(index)
    body = body_of_part(sequence.bodies_truth)[labels]
    (folder / MASKS / f"{stamp}.png").write_bytes(cv2.imencode(".png", body)[1].tobytes())
    rows = []
    for truth in sequence.bodies_truth:
        place = int(np.argmin(np.abs(truth.timestamps - timestamp)))
        for part, world_T_part in zip(truth.part_labels, truth.world_T_part[:, place], strict=True):
            pose = format_tum_row(timestamp, world_T_part).split()[1:]
            rows.append(",".join([stamp, str(truth.label), str(part), *pose, f"{np.mean(labels == part):.6f}"]))
    return rows


def write_truth(rows: Iterable[str], folder: Path) -> None:
    """Write the rows returned by `write_mask` to bodies_truth.csv; raises OSError."""
    (folder / TRUTH).write_text("\n".join([COLUMNS, *rows]) + "\n", encoding="utf-8")
