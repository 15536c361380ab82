"""Bodies for the rendered room: swaying boxes and a walking figure, with seeded appearance, size and phase."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from gavo_jax.datasets.rendered.moving import MovingBody, MovingPart, Path
from gavo_jax.datasets.rendered.room import Box
from gavo_jax.errors import GavoError, as_number, shown

_STREAM = 3
BOX_PLACES = ((0.0, 1.0), (0.75, 1.0), (-0.75, 1.0), (0.4, 1.6), (-0.4, 1.6), (1.1, 1.6))
"""Positions of the boxes: to the right of the first view's optical axis and along it, metres."""
MOST_BODIES = len(BOX_PLACES) + 1
_LOOKS = (
    ("picture", (1.2, 0.95, 0.8)),
    ("checker", (0.8, 1.15, 0.9)),
    ("carton", (1.25, 0.98, 0.65)),
    ("books", (1.0, 1.0, 1.0)),
    ("fabric", (0.75, 0.95, 1.3)),
    ("plain", (1.1, 1.0, 0.9)),
)
_TALL, _GROWN_UP = 1.05, 1.75
_LOOK = ("yaw", "tint")
"""Fields of `Box` that a moving box may be given."""
_BOX_SPEED, _WALK_SPEED = 0.35, 0.4


def turn(angle: Float[np.ndarray, " n"], axis: int) -> Float[np.ndarray, "n 3 3"]:
    """Rotations about a coordinate axis by angles in radians."""
    matrix = np.tile(np.eye(3), (len(angle), 1, 1))
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix[:, i, i] = matrix[:, j, j] = np.cos(angle)
    matrix[:, j, i] = np.sin(angle)
    matrix[:, i, j] = -matrix[:, j, i]
    return matrix


def _poses(rotation: Float[np.ndarray, "n 3 3"], place: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 4 4"]:
    poses = np.tile(np.eye(4), (len(place), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotation, place
    return poses


@dataclass(frozen=True, eq=False)
class Sway:
    """A path that oscillates about a pose, in translation and rotation: one sinusoid per axis.

    Attributes:
        middle: `world_T_part` at the centre of the oscillation.
        reach: amplitudes along the middle's axes, metres.
        speed: mean speed along the first axis whose reach is not 0, m/s.
        turn: amplitudes about the middle's axes, degrees.
        phases: of the three axes, radians.
    """

    middle: Float[np.ndarray, "4 4"]
    reach: tuple[float, float, float] = (0.25, 0.1, 0.1)
    speed: float = _BOX_SPEED
    turn: tuple[float, float, float] = (10.0, 20.0, 14.0)
    phases: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __call__(self, seconds: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 4 4"]:
        """`world_T_part`."""
        widest = next((reach for reach in self.reach if reach), 1.0)
        angle = np.pi / 2 * self.speed / widest * seconds
        x, y, z = (np.sin(rate * angle + phase) for rate, phase in zip((1.0, 0.7, 0.5), self.phases, strict=True))
        about = [turn(np.radians(self.turn[axis]) * wave, axis) for axis, wave in enumerate((y, z, x))]
        return self.middle @ _poses(about[0] @ about[1] @ about[2], np.stack([x, y, z], axis=1) * self.reach)


@dataclass(frozen=True, eq=False)
class Walk:
    """A path around an ellipse on the floor, facing forwards: x ahead, y left, z up.

    Attributes:
        middle: centre of the ellipse on the floor, metres.
        along: direction of the longer axis, radians from the world's x to its y.
        axes: semi-axes of the ellipse, metres.
        speed: mean, m/s.
        phase: starting point on the ellipse, radians.
    """

    middle: tuple[float, float, float]
    along: float
    axes: tuple[float, float] = (0.35, 0.2)
    speed: float = _WALK_SPEED
    phase: float = 0.0

    def __call__(self, seconds: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 4 4"]:
        """`world_T_part`."""
        a, b = self.axes
        angle = self.speed / np.hypot(a, b) * np.sqrt(2) * seconds + self.phase
        place = np.stack([a * np.cos(angle), b * np.sin(angle), np.zeros_like(angle)], axis=1)
        heading = np.arctan2(b * np.cos(angle), -a * np.sin(angle)) + self.along
        return _poses(turn(heading, 2), place @ turn(np.array([self.along]), 2)[0].T + self.middle)


@dataclass(frozen=True, eq=False)
class Swing:
    """The path of a limb: it swings about the left-to-right axis (y) of a joint that another path carries.

    Attributes:
        carrier: path of the part that the limb is attached to.
        joint: position of the joint in the frame of the carrier, metres.
        degrees: amplitude.
        rate: swings per second.
        phase: radians.
    """

    carrier: Path
    joint: tuple[float, float, float]
    degrees: float
    rate: float
    phase: float = 0.0

    def __call__(self, seconds: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 4 4"]:
        """`world_T_part`; the limb's frame is at the joint."""
        angle = np.radians(self.degrees) * np.sin(2 * np.pi * self.rate * seconds + self.phase)
        joints = np.tile(np.array(self.joint), (len(angle), 1))
        return self.carrier(seconds) @ _poses(turn(angle, 1), joints)


def box(name: str, size: tuple[float, float, float], path: Path, texture: str = "picture", **look: Any) -> MovingBody:
    """A box about the origin of its own frame.

    Args:
        name: of the body.
        size: edge lengths, metres.
        path: of its centre.
        texture: one of `textures.TEXTURES`.
        look: further fields of `Box`, such as `tint`.

    Raises:
        GavoError: the size is not three numbers, or `Box` has no such field.
    """
    if np.shape(size) != (3,):
        raise GavoError(f"box {shown(name)}: size: expected three edge lengths, got {shown(size)}")
    if unknown := [field for field in look if field not in _LOOK]:
        raise GavoError(f"box {shown(name)}: {unknown[0]}: not one of {', '.join(_LOOK)}")
    return MovingBody(name, (MovingPart((Box((0.0, 0.0, -size[2] / 2), size, texture, **look),), path),))


def figure(name: str, walk: Walk, tall: float = _GROWN_UP, phase: float = 0.0) -> MovingBody:
    """A walking figure of six rigid parts: torso, head, swinging arms and legs.

    Args:
        name: of the body.
        walk: path of the point on the floor below it.
        tall: height, metres.
        phase: of the swing, radians.

    Raises:
        GavoError: the path is no `Walk`, or the height is not above 0.
    """
    if not as_number(f"figure {shown(name)}: tall", tall) > 0:
        raise GavoError(f"figure {shown(name)}: tall: must be above 0, not {tall}")
    if not hasattr(walk, "speed"):
        raise GavoError(f"figure {shown(name)}: expected a Walk, got {shown(walk)}")
    scale = tall / _GROWN_UP
    rate = walk.speed / (1.3 * scale)

    def limb(
        at: tuple[float, float, float], size: tuple[float, float, float], texture: str, *tint: float
    ) -> tuple[Box, ...]:
        place, edges = ((scale * v[0], scale * v[1], scale * v[2]) for v in (at, size))
        return (Box(place, edges, texture, 0.0, (tint[0], tint[1], tint[2])),)

    def hung(joint: tuple[float, float, float], degrees: float, shift: float) -> Swing:
        return Swing(walk, (scale * joint[0], scale * joint[1], scale * joint[2]), degrees, rate, phase + shift)

    arm, leg = ((0.0, 0.0, -0.62), (0.11, 0.1, 0.64)), ((0.0, 0.0, -0.86), (0.16, 0.15, 0.86))
    parts = [
        MovingPart(limb((0.0, 0.0, 0.84), (0.24, 0.4, 0.6), "checker", 1.3, 0.85, 0.8), walk),
        MovingPart(limb((0.0, 0.0, 0.0), (0.2, 0.18, 0.27), "wood", 1.2, 0.95, 0.85), hung((0.0, 0.0, 1.47), 6.0, 0.5)),
        *(
            MovingPart(limb(*arm, "fabric", 1.3, 0.85, 0.8), hung((0.0, side * 0.26, 1.4), 32.0, side * np.pi / 2))
            for side in (1, -1)
        ),
        *(
            MovingPart(limb(*leg, "fabric", 0.8, 0.95, 1.3), hung((0.0, side * 0.1, 0.86), 28.0, -side * np.pi / 2))
            for side in (1, -1)
        ),
    ]
    return MovingBody(name, tuple(parts))


def builtin_bodies(
    count: int, seed: int, world_T_first: Float[np.ndarray, "4 4"], half_extent: tuple[float, float]
) -> tuple[MovingBody, ...]:
    """Bodies in front of the first view: a box, a walking figure, then more boxes.

    Args:
        count: how many, at most `MOST_BODIES`.
        seed: of their appearance, sizes and phases.
        world_T_first: pose of the first camera.
        half_extent: of the room, metres.

    Raises:
        GavoError: `count` is negative or above `MOST_BODIES`.
    """
    if not 0 <= count <= MOST_BODIES:
        raise GavoError(f"synthetic: bodies: must be from 0 to {MOST_BODIES}, not {count}")
    boxes = [_swaying_box(place, seed, world_T_first) for place in range(count - (count > 1))]
    return (*boxes[:1], *([_walker(seed, world_T_first, half_extent)] if count > 1 else ()), *boxes[1:])


def _swaying_box(place: int, seed: int, world_T_first: np.ndarray) -> MovingBody:
    """The box at one of `BOX_PLACES`. Its z axis points up if the first camera is level."""
    rng = np.random.default_rng([seed, _STREAM, place])
    right, ahead = BOX_PLACES[place]
    middle = np.eye(4)
    middle[:3, :3] = world_T_first[:3, :3] @ np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    middle[:3, 3] = world_T_first[:3, :3] @ [right, -0.2 * ahead, ahead] + world_T_first[:3, 3]
    texture, tint = _LOOKS[(place + int(rng.integers(len(_LOOKS)))) % len(_LOOKS)]
    width, depth, tall = rng.uniform((0.3, 0.22, 0.26), (0.38, 0.3, 0.34)).round(3)
    phases = rng.uniform(0, 2 * np.pi, 3)
    path = Sway(middle, (0.22, 0.1, 0.08), phases=(phases[0], phases[1], phases[2]))
    return box(f"box {place + 1}", (width, depth, tall), path, texture, tint=tint)


def _walker(seed: int, world_T_first: np.ndarray, half_extent: tuple[float, float]) -> MovingBody:
    """A small figure on the free floor ahead, walking across the view and back."""
    rng = np.random.default_rng([seed, _STREAM, len(BOX_PLACES)])
    ahead, place = world_T_first[:2, 2], world_T_first[:2, 3]
    direction = float(np.arctan2(ahead[1], ahead[0]))
    floor = np.array(half_extent) - 1.65
    x, y = np.clip(place + 1.05 * np.array([np.cos(direction), np.sin(direction)]), -floor, floor)
    walk = Walk((float(x), float(y), 0.012), direction + np.pi / 2, phase=rng.uniform(0, 2 * np.pi))
    return figure("figure", walk, _TALL, rng.uniform(0, 2 * np.pi))
