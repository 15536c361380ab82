"""Fixed transforms between the coordinate frames of a device, from ROS's tf messages."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from jaxtyping import Float

from gavo_jax.trajectory import inverse, rotation_from_quaternion

TRANSFORMS = "tf2_msgs/msg/TFMessage"
FIXED_TOPIC, ANY_TOPIC = "/tf_static", "/tf"
"""Topics of transforms that are published once, and of those published repeatedly, whether they change or not."""

LONGEST_OFF = 0.01
"""Tolerance of a quaternion's norm around 1, as in ROS's own library: excludes zeros and uninitialised values."""

STILL = 1e-6
"""Largest difference of a transform's elements (metres for the translation) at which it counts as unchanged."""


def fixed_transforms(messages: Iterable[Any]) -> dict[tuple[str, str], Float[np.ndarray, "4 4"]]:
    """Return `a_T_b`, in both directions, by frame names (a, b), from messages of type `TRANSFORMS`.

    Transforms that change and invalid ones are left out.
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
    """Return `a_T_b` along the shortest chain of transforms; None if there is none."""
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
