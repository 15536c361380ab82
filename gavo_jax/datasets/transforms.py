"""How the frames of a device lie to each other, from the fixed transforms that ROS publishes."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from jaxtyping import Float

from gavo_jax.trajectory import inverse, rotation_from_quaternion

TRANSFORMS = "tf2_msgs/msg/TFMessage"
FIXED_TOPIC = "/tf_static"


def fixed_transforms(messages: Iterable[Any]) -> dict[tuple[str, str], Float[np.ndarray, "4 4"]]:
    """Return `a_T_b` by the names (a, b) of frames, both ways, of messages of the type `TRANSFORMS`."""
    found = {}
    for message in messages:
        for entry in message.transforms:
            shift, turn = entry.transform.translation, entry.transform.rotation
            parent_T_child = np.eye(4)
            parent_T_child[:3, :3] = rotation_from_quaternion(np.array([turn.x, turn.y, turn.z, turn.w]))
            parent_T_child[:3, 3] = shift.x, shift.y, shift.z
            parent, child = (name.strip("/") for name in (entry.header.frame_id, entry.child_frame_id))
            found[parent, child], found[child, parent] = parent_T_child, inverse(parent_T_child)
    return found


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
