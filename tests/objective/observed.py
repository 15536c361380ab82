"""Pairs of images, what the objective makes of them, and compiled ways to ask it."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import oracle
from hypothesis import strategies as st

from gavo_jax.camera import Camera
from gavo_jax.image.levels import Levels, image_plane
from gavo_jax.image.pyramid import PyramidLevel, make_atlas
from gavo_jax.image.sampling import INVERSE_DEPTH_STEP, Target, pack_target
from gavo_jax.objective.error import Objective, Scales
from gavo_jax.objective.losses import Loss, l2
from gavo_jax.objective.points import Reference, make_references
from gavo_jax.se3 import exp

SMALL = Camera(24.0, 23.0, 11.3, 8.8, 24, 18)
CAMERA = Camera(60.0, 58.0, 31.2, 24.1, 64, 48)


@partial(jax.jit, static_argnames="cell")
def make_reference(level: PyramidLevel, camera: Camera, cell: int = 1) -> Reference:
    """The points of one level, one a cell x cell block."""
    points = (camera.width // cell) * (camera.height // cell)
    return jax.tree.map(lambda leaf: leaf[0], make_references((level,), camera, Levels.of(camera, (0,), points)))


@cache
def random_pair(seed: int) -> oracle.Pair:
    """White-noise images, depth of a few planes and steps, a fifth of the readings missing on either side."""
    rng = np.random.default_rng(seed)
    shape = (SMALL.height, SMALL.width)

    def inverse_depth() -> np.ndarray:
        v, u = np.mgrid[: shape[0], : shape[1]]
        q = 0.5 + rng.uniform(-0.01, 0.01) * u + rng.uniform(-0.01, 0.01) * v + 0.4 * (u > rng.integers(5, 20))
        q = np.rint(q / INVERSE_DEPTH_STEP) * INVERSE_DEPTH_STEP
        return np.where(rng.random(shape) < 0.2, 0.0, q)

    greys = [rng.integers(0, 256, shape).astype(float) for _ in range(2)]
    return oracle.Pair(SMALL, greys[0], inverse_depth(), greys[1], inverse_depth())


def build(
    pair: oracle.Pair,
    loss: Loss = l2,
    scales: tuple[float, float, float] | None = None,
    min_overlap: float = 0.0,
    gain: float = 1.0,
    bias: float = 0.0,
    outside_cost: float = 0.0,
) -> Objective:
    """The objective of a pair; scales are those of grey and depth, and the depth weight. Without them: (2)."""
    reference, target = prepare(pair.camera, *(image.astype(np.float32) for image in pair[1:]))
    reference = reference._replace(grey=gain * reference.grey + bias)
    use_depth = scales is not None and scales[2] > 0
    values = Scales.unit() if scales is None else Scales(*(jnp.float32(s) for s in scales))
    return Objective(
        reference,
        target,
        image_plane(pair.camera),
        values,
        jnp.float32(min_overlap),
        jnp.float32(outside_cost),
        loss=loss,
        use_depth=use_depth,
    )


@jax.jit
def prepare(
    camera: Camera, grey: jax.Array, inverse_depth: jax.Array, target_grey: jax.Array, target_inverse_depth: jax.Array
) -> tuple[Reference, Target]:
    """What the objective keeps of either frame."""
    reference = make_reference(PyramidLevel(grey, inverse_depth), camera)
    return reference, pack_target(make_atlas([PyramidLevel(target_grey, target_inverse_depth)]))


jit_error = jax.jit(lambda objective, motion: objective.error(motion))
jit_residuals = jax.jit(lambda objective, motion: objective.residuals(motion))
jit_problem_score = jax.jit(lambda problem, x: problem.score(x))
jit_exp = jax.jit(exp)
jit_linearize = jax.jit(lambda problem, x: problem.linearize(x))


# metres and radians that move a point of SMALL by a few pixels
twist = st.tuples(*[st.floats(-0.2, 0.2)] * 3, *[st.floats(-0.1, 0.1)] * 3).map(np.array)


def random_motions(count: int, scale: float = 0.05) -> jax.Array:
    return jit_exp(np.random.default_rng(0).normal(0, scale, (count, 6)).astype(np.float32))


def smooth_image(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """A smooth texture of full contrast."""
    waves = np.sin(0.31 * u + 0.1 * v) + np.sin(0.23 * v - 0.13 * u + 1) + np.sin(0.17 * u + 0.29 * v + 2)
    return 128 + 40 * waves


def smooth_pair(shift: tuple[float, float] = (0.0, 0.0), rim: int = 6) -> oracle.Pair:
    """A tilted, textured plane; the target's image is shifted by some pixels. No readings near the reference's rim,
    so that small motions move no point out of view: what leaves is no part of the derivative."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    q = 0.6 + 0.002 * u - 0.003 * v
    q = np.rint(q / INVERSE_DEPTH_STEP) * INVERSE_DEPTH_STEP
    inner = np.zeros(q.shape, bool)
    inner[rim:-rim, rim:-rim] = True
    reference = np.rint(smooth_image(u, v))
    return oracle.Pair(CAMERA, reference, np.where(inner, q, 0), np.rint(smooth_image(u - shift[0], v - shift[1])), q)


def exchanged(pair: oracle.Pair) -> oracle.Pair:
    return oracle.Pair(pair.camera, *pair[3:], *pair[1:3])


def noisy_pair(noise: np.ndarray, gain: float = 1.0, bias: float = 0.0) -> oracle.Pair:
    pair = smooth_pair(rim=1)
    return pair._replace(target_grey=np.clip(gain * pair.reference_grey + bias + noise, 0, 255))


def staircase(s: jax.Array) -> jax.Array:
    """Flat nearly everywhere: its derivative tells nothing."""
    return jnp.ceil(jnp.minimum(s, 9.0))
