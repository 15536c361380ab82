"""How the frames of a device lie to each other, from the transforms that ROS publishes and that never change."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from jaxtyping import Float

from gavo_jax.trajectory import inverse, rotation_from_quaternion

TRANSFORMS = "tf2_msgs/msg/TFMessage"
FIXED_TOPIC, ANY_TOPIC = "/tf_static", "/tf"
"""Topics of transforms that are published once, and of those that are published over and over, changed or not."""

LONGEST_OFF = 0.01
"""How far a quaternion's length may be off 1, as ROS's own library has it: zeros and what was never filled in are no
rotation."""

STILL = 1e-6
"""Difference of a transform's numbers, metres among them, above which it has changed."""


def fixed_transforms(messages: Iterable[Any]) -> dict[tuple[str, str], Float[np.ndarray, "4 4"]]:
    """Return `a_T_b` by the names (a, b) of frames, both ways, of messages of the type `TRANSFORMS`.

    Those that change are left out, and those that are no transforms.
    """
    found, moving = {}, set()
    for message in messages:
        for entry in message.transforms:
            shift, turn = entry.transform.translation, entry.transform.rotation
            quaternion, position = np.array([turn.x, turn.y, turn.z, turn.w]), np.array([shift.x, shift.y, shift.z])
            if not abs(np.linalg.norm(quaternion) - 1) < LONGEST_OFF or not np.isfinite(position).all():
                continue
            parent_T_child = np.eye(4)
            parent_T_child[:3, :3], parent_T_child[:3, 3] = rotation_from_quaternion(quaternion), position
            parent, child = (name.strip("/") for name in (entry.header.frame_id, entry.child_frame_id))
            if not np.allclose(found.setdefault((parent, child), parent_T_child), parent_T_child, rtol=0, atol=STILL):
                moving |= {(parent, child), (child, parent)}
            found.setdefault((child, parent), inverse(parent_T_child))
    return {names: transform for names, transform in found.items() if names not in moving}


def between(
    transforms: dict[tuple[str, str], Float[np.ndarray, "4 4"]], a: str, b: str
) -> Float[np.ndarray, "4 4"] | None:
    """Return `a_T_b` along a chain of transforms, the shortest that there is; None where there is none."""
    a, b = a.strip("/"), b.strip("/")
    reached, edge = {a: np.eye(4)}, [a]
    while edge and b not in reached:
        steps = [(name, near, step) for (name, near), step in transforms.items() if name in edge]
        edge = []
        for name, near, step in steps:
            if near not in reached:
                reached[near] = reached[name] @ step
                edge.append(near)
    return reached.get(b)
