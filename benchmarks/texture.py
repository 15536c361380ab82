"""Results on poorly constrained scenes: stripes, edges, plain and periodic walls, corridors, cylinders.

Each scene is rendered twice, a centimetre and a fraction of a degree apart, with grey noise (standard deviation in grey
levels) and with or without a Kinect's depth noise, and aligned by each method. A result is fine if its error is small
(within 5 mm and 0.3 degrees) or within three deviations by its covariance. Axes that it reports as undetermined may be
left out of the error. It is also fine if its status is high error, ambiguous or no depth. Prints one row per method and
scene: pairs that are fine, the largest error of an `ok` pair, and the statuses; then every pair that is not fine.

    python benchmarks/texture.py
    python benchmarks/texture.py --methods gauss-newton --noise 0,1 --json texture.json

On 2 cores the defaults take about 10 minutes.
"""

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import common
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from gavo_jax import se3
from gavo_jax.alignment.pairs import align_batch
from gavo_jax.alignment.result import Alignment
from gavo_jax.camera import Camera
from gavo_jax.status import AlignmentStatus
from gavo_jax.trajectory import inverse

CAMERA = Camera(fx=525.0, fy=525.0, cx=319.5, cy=239.5, width=640, height=480, depth_scale=5000.0)
MOTION = (0.01, 0.003, 0.004, 0.004, -0.003, 0.002)
"""Twist of target_T_reference, metres and radians."""
RIGHT = (0.005, np.radians(0.3))
"""Metres and radians within which a motion is right."""
DEVIATIONS = (3.0, 3.44, 3.76, 4.03, 4.27, 4.48)
"""Largest Mahalanobis distance for one to six unknowns: 99.73 % of normal errors lie within."""
SUPERSAMPLING = 3
"""Rays per pixel along each side."""

Texture = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Maps two coordinates on a surface, metres, to its grey level."""
Points = Float[np.ndarray, "n 3"]
Scene = Callable[[Points, Points], tuple[np.ndarray, np.ndarray]]
"""Maps rays (origins, directions) to the distance to the surface, in units of the directions, and its grey level."""


def _bumps(seed: int, size: float) -> Texture:
    """An aperiodic texture with smooth features of a given size, metres."""
    generator = np.random.default_rng(seed)
    waves = generator.normal(size=(24, 2)) / size
    phases = generator.uniform(0, 2 * np.pi, 24)

    def grey(s: np.ndarray, t: np.ndarray) -> np.ndarray:
        total = sum(np.sin(a * s + b * t + phase) for (a, b), phase in zip(waves, phases, strict=True))
        return 128 + 50 * np.clip(total / 4, -1, 1)

    return grey


def bands(degrees: float) -> Texture:
    """Stripes of irregular widths whose normal is turned by an angle from x."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    waves = _bumps(1, 0.04)
    return lambda x, y: waves(c * x + s * y, np.zeros_like(x))


def edge(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A single step edge, a millimetre wide."""
    return 128 + 50 * np.tanh((x - 0.1) / 0.001)


def plain(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A uniform grey."""
    return np.full_like(x, 128.0)


def picture(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A picture of 30 by 25 cm on a plain wall."""
    return np.where((np.abs(x - 0.05) < 0.15) & (np.abs(y) < 0.125), _bumps(2, 0.02)(x, y), 128.0)


def tiles(period: float) -> Texture:
    """A tile that repeats every `period` metres."""

    def grey(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        a, b = 2 * np.pi * x / period, 2 * np.pi * y / period
        return 128 + 25 * np.sin(a) + 25 * np.sin(b) + 15 * np.sin(2 * a + b) + 15 * np.sin(a - 3 * b)

    return grey


def checks(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A chessboard with squares of 5 cm."""
    return 128 + 60 * np.sign(np.sin(np.pi * x / 0.05) * np.sin(np.pi * y / 0.05))


def wall(texture: Texture, distance: float = 1.5, slope: float = 0.0) -> Scene:
    """A plane in front of the camera, tilted by a slope along x."""

    def meet(origins: Points, rays: Points) -> tuple[np.ndarray, np.ndarray]:
        along = (distance + slope * origins[:, 0] - origins[:, 2]) / (rays[:, 2] - slope * rays[:, 0])
        x, y, _ = (origins + along[:, None] * rays).T
        return along, texture(x, y)

    return meet


def corridor(origins: Points, rays: Points) -> tuple[np.ndarray, np.ndarray]:
    """A square tunnel along z whose four walls differ in grey."""
    sides = np.stack([(np.sign(rays[:, i]) - origins[:, i]) / rays[:, i] for i in (0, 1)])
    along = sides.min(axis=0)
    nearest = sides.argmin(axis=0)
    negative = np.take_along_axis(rays[:, :2], nearest[:, None], axis=1)[:, 0] < 0
    return along, 70.0 + 40.0 * (2 * nearest + negative)


def cylinder(origins: Points, rays: Points) -> tuple[np.ndarray, np.ndarray]:
    """A tube along x, seen from inside, with stripes along its axis."""
    oy, oz, dy, dz = origins[:, 1], origins[:, 2], rays[:, 1], rays[:, 2]
    a, b, c = dy**2 + dz**2, oy * dy + oz * dz, oy**2 + oz**2 - 1.5**2
    along = (-b + np.sqrt(b**2 - a * c)) / a
    angle = np.arctan2(oy + along * dy, oz + along * dz)
    return along, _bumps(3, 0.04)(angle, np.zeros_like(angle))


SCENES: dict[str, Scene] = {
    "upright bands": wall(bands(0)),
    "level bands": wall(bands(90)),
    "oblique bands": wall(bands(37)),
    "oblique bands, slanted wall": wall(bands(37), slope=0.3),
    "one edge": wall(edge),
    "plain wall": wall(plain),
    "one picture": wall(picture),
    "textured wall": wall(_bumps(4, 0.03)),
    "corridor": corridor,
    "tiles": wall(tiles(0.15)),
    "small tiles": wall(tiles(0.03)),
    "checks": wall(checks),
    "cylinder": cylinder,
}


def render(scene: Scene, world_T_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Render grey (floating point) and depth in metres."""
    n = SUPERSAMPLING
    offsets = (np.arange(n) + 0.5) / n - 0.5
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width].astype(float)

    def look(du: float, dv: float) -> tuple[np.ndarray, np.ndarray]:
        x, y = (u + du - CAMERA.cx) / CAMERA.fx, (v + dv - CAMERA.cy) / CAMERA.fy
        rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3) @ world_T_camera[:3, :3].T
        along, grey = scene(np.broadcast_to(world_T_camera[:3, 3], rays.shape), rays)
        return along.reshape(u.shape), grey.reshape(u.shape)

    grey = np.mean([look(du, dv)[1] for du in offsets for dv in offsets], axis=0)
    return grey, look(0.0, 0.0)[0]


def photograph(grey: np.ndarray, depth: np.ndarray, noise: float, kinect: bool, seed: int) -> tuple[Any, Any]:
    """Images of a sensor: 8-bit grey with noise, and depth in the camera's units.

    A Kinect's disparity has steps of an eighth of a pixel (0.00287 1/m), and noise of half a step.
    """
    generator = np.random.default_rng(seed)
    image = np.clip(np.round(grey + noise * generator.normal(size=grey.shape)), 0, 255).astype(np.uint8)
    if kinect:
        step = 0.00287
        depth = 1.0 / np.maximum(np.round(1.0 / depth / step + 0.5 * generator.normal(size=depth.shape)) * step, 1e-3)
    units = np.round(depth * CAMERA.depth_scale)
    return image, np.where((depth > 0.4) & (depth < 10.0), units, 0).astype(np.uint16)


class Case(NamedTuple):
    """A pair and its result."""

    method: str
    scene: str
    noise: float
    kinect: bool
    status: str
    undetermined: str
    translation: float
    """Error of the translation, metres."""
    rotation: float
    """Error of the rotation, radians."""
    fine: bool


def judge(result: Alignment, truth: np.ndarray) -> tuple[bool, np.ndarray]:
    """Whether a result is fine, and its error as a twist."""
    error = np.asarray(se3.log(jnp.asarray(inverse(np.asarray(result.target_T_reference)) @ truth)), np.float64)
    if {AlignmentStatus.HIGH_ERROR, AlignmentStatus.AMBIGUOUS, AlignmentStatus.NO_DEPTH}.intersection(result.statuses):
        return True, error
    covariance = np.asarray(result.covariance, np.float64)
    named = np.array([f"{kind} {axis}" in result.undetermined for kind in KINDS for axis in "xyz"])
    left = np.where(named, 0.0, error)
    right = np.linalg.norm(left[:3]) < RIGHT[0] and np.linalg.norm(left[3:]) < RIGHT[1]
    return bool(right or is_likely(error, covariance) or is_likely(error[~named], covariance[~named][:, ~named])), error


def is_likely(error: np.ndarray, covariance: np.ndarray) -> bool:
    """Whether an error is within `DEVIATIONS` by its covariance; an empty one is."""
    if not error.size or not np.isfinite(covariance).all():
        return not error.size
    return bool(error @ np.linalg.solve(covariance, error) < DEVIATIONS[error.size - 1] ** 2)


KINDS = ("translation along", "rotation about")


def main(
    methods: str = "ga,pso,gauss-newton,adam,ga:wide",
    scenes: str = "all",
    noise: str = "0,0.3,1,3",
    json: Path | None = None,
) -> dict[str, Any]:
    """Measure, print and return the figures.

    Args:
        methods: comma-separated METHOD or METHOD:PRESET.
        scenes: semicolon-separated names, or all.
        noise: comma-separated standard deviations of the grey noise.
        json: file for the figures.
    """
    truth = np.asarray(se3.exp(jnp.array(MOTION)), np.float64)
    chosen = list(SCENES) if scenes == "all" else [name.strip() for name in scenes.split(";")]
    kinds: list[tuple[str, float, bool]] = []
    pairs = []
    for scene in chosen:
        views = [render(SCENES[scene], pose) for pose in (np.eye(4), inverse(truth))]
        for level in map(float, common.names(noise)):
            for kinect in (False, True):
                kinds.append((scene, level, kinect))
                pairs.append([photograph(*view, level, kinect, seed) for seed, view in enumerate(views)])
    cases = []
    for method in common.names(methods):
        references, targets = (list(side) for side in zip(*pairs, strict=True))
        batch = align_batch(references, targets, CAMERA, common.preset_of(method))
        for i, kind in enumerate(kinds):
            row = jax.tree.map(lambda leaf, i=i: leaf[i], batch)
            result = row._replace(status=AlignmentStatus(int(row.status)))
            fine, error = judge(result, truth)
            lengths = float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:]))
            cases.append(Case(method, *kind, result.status.name.lower(), result.undetermined, *lengths, fine))
    groups = dict.fromkeys((case.method, case.scene) for case in cases)
    cells = []
    for method, scene in groups:
        group = [case for case in cases if (case.method, case.scene) == (method, scene)]
        statuses = Counter(case.status for case in group)
        worst = max((case.translation for case in group if case.status == "ok"), default=0.0)
        text = ", ".join(f"{count} {name}" for name, count in statuses.items())
        cells.append([method, scene, f"{sum(case.fine for case in group)} of {len(group)}", f"{worst * 1e3:.1f}", text])
    common.print_table("surfaces that tell little", ("method", "scene", "fine", "worst ok, mm", "statuses"), cells)
    for case in cases:
        if not case.fine:
            error = f"{case.translation * 1e3:.1f} mm, {np.degrees(case.rotation):.2f} degrees off"
            kind = f"{case.method}, {case.scene}, noise {case.noise:g}, {'Kinect' if case.kinect else 'true'} depth"
            print(f"not fine: {kind}: {error}, {case.status} {case.undetermined}")
    common.tell(f"{sum(case.fine for case in cases)} of {len(cases)} are fine")
    results = {"cases": [case._asdict() for case in cases]}
    common.record(json, "texture", results)
    return results


if __name__ == "__main__":
    common.command(main)
