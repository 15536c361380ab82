"""Statuses of frames and pairs, each with a sentence for users."""

import enum
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp


class AlignmentStatus(enum.IntEnum):
    """Status of a pair's result; `sentence` explains it, and docs/frames.md says what becomes of the frame."""

    OK = 0
    LOW_OVERLAP = 1
    LOW_TEXTURE = 2
    AMBIGUOUS = 3
    HIGH_ERROR = 4
    NO_DEPTH = 5
    NOT_FINITE = 6
    UNREADABLE = 7
    BLANK = 8
    NOISE = 9
    FROZEN = 10
    DEPTH_UNITS = 11
    PARTIAL_DEPTH = 12
    BAD_TIMESTAMP = 13
    GAP = 14
    NO_REFERENCE = 15
    NOT_RIGID = 16
    IMPLAUSIBLE_MOTION = 17
    DEPTH_MISMATCH = 18
    MOVING_BODY = 19

    @property
    def sentence(self) -> str:
        """Explanation in one sentence."""
        return _SENTENCES[self]

    def __str__(self) -> str:
        """Return the name used in files."""
        return self.name.lower()


_SENTENCES = {
    AlignmentStatus.OK: "The motion was found.",
    AlignmentStatus.LOW_OVERLAP: "Too few of the reference's pixels land inside the target.",
    AlignmentStatus.LOW_TEXTURE: "The images leave at least one direction of the motion undetermined.",
    AlignmentStatus.AMBIGUOUS: "Distinct motions explain the images about equally well.",
    AlignmentStatus.HIGH_ERROR: "The best motion found does not explain the target image.",
    AlignmentStatus.NO_DEPTH: "A frame has too few depth readings.",
    AlignmentStatus.NOT_FINITE: "The error is not a finite number.",
    AlignmentStatus.UNREADABLE: "The frame could not be read.",
    AlignmentStatus.BLANK: "The image is black, white or saturated.",
    AlignmentStatus.NOISE: "The image is noise.",
    AlignmentStatus.FROZEN: "The image, or its depth, repeats the last one.",
    AlignmentStatus.DEPTH_UNITS: "The depth's range is unlikely: its units may not be the camera's.",
    AlignmentStatus.PARTIAL_DEPTH: "Much of the usual depth is missing.",
    AlignmentStatus.BAD_TIMESTAMP: "The time stamp is not later than the last one, or out of order.",
    AlignmentStatus.GAP: "Frames are missing before this one.",
    AlignmentStatus.NO_REFERENCE: "There is no usable frame before this one.",
    AlignmentStatus.NOT_RIGID: (
        "The result is not a rigid motion: this machine computes wrong numbers (see gavo doctor)."
    ),
    AlignmentStatus.IMPLAUSIBLE_MOTION: "A camera can hardly move like that: the image may not belong to its stamp.",
    AlignmentStatus.DEPTH_MISMATCH: "Depth does not agree with the motion that the images show.",
    AlignmentStatus.MOVING_BODY: "The motion may be that of a body that covers much of the image, not the camera's.",
}

BY_GRAVITY = (
    AlignmentStatus.AMBIGUOUS,
    AlignmentStatus.MOVING_BODY,
    AlignmentStatus.LOW_TEXTURE,
    AlignmentStatus.IMPLAUSIBLE_MOTION,
    AlignmentStatus.DEPTH_MISMATCH,
    AlignmentStatus.HIGH_ERROR,
    AlignmentStatus.LOW_OVERLAP,
    AlignmentStatus.NOT_FINITE,
    AlignmentStatus.NO_DEPTH,
    AlignmentStatus.NOT_RIGID,
)
"""Findings about a motion, the gravest last: of several, that one becomes the status."""


def bit(status: AlignmentStatus) -> int:
    """Return the bit that stands for a status among findings."""
    return 1 << status


def as_findings(criteria: Mapping[AlignmentStatus, Any]) -> Any:
    """Return the statuses whose criterion holds, as the bits of an integer; 0 if none does."""
    found = jnp.int32(0)
    for status, holds in criteria.items():
        found |= jnp.where(holds, bit(status), 0)
    return found


def gravest(findings: Any) -> Any:
    """Return the gravest of several findings, as an integer."""
    status = jnp.int32(AlignmentStatus.OK)
    for candidate in BY_GRAVITY:
        status = jnp.where(findings & bit(candidate), jnp.int32(candidate), status)
    return status
