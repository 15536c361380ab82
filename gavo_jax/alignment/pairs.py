"""`align` and `align_batch`: from images to `Alignment` in one compiled program."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64, PRNGKeyArray

from gavo_jax.alignment.result import Alignment
from gavo_jax.alignment.review import review
from gavo_jax.alignment.search import align_views
from gavo_jax.alignment.stacking import Images, require_untraced, stacked_pairs, stacked_sides, typed_keys
from gavo_jax.alignment.visits import levels_of, prepare_pair
from gavo_jax.camera import Camera
from gavo_jax.compilation.precision import in_32_bits
from gavo_jax.compilation.programs import CachedProgram
from gavo_jax.datasets.base import Frame
from gavo_jax.errors import GavoError, shown
from gavo_jax.features import FeatureKind, feature_motion
from gavo_jax.image.pyramid import LEVELS, build_pyramid
from gavo_jax.se3 import is_rigid, rigid
from gavo_jax.settings import AlignmentOptions, Settings, as_settings
from gavo_jax.solvers.base import Solver
from gavo_jax.status import AlignmentStatus


def _align_images(
    reference: Images,
    target: Images,
    camera: Camera,
    solver: Solver,
    options: AlignmentOptions,
    key: PRNGKeyArray,
    guesses: Float[Array, "g 4 4"],
) -> Alignment:
    before, after = (
        build_pyramid(frame.grey, frame.depth, camera.depth_scale, LEVELS) for frame in (reference, target)
    )
    levels = levels_of(camera, solver, options)
    view, packed, exchanged = prepare_pair(before, after, camera, levels, options)
    guess, hypotheses = guesses[:1], guesses[1:]
    found, _ = align_views(
        (view,), packed, camera, levels, solver, options, key, guess, exchanged=exchanged, hypotheses=hypotheses
    )
    return found


POINTS_SIDE_BY_SIDE = 2**20
"""Number of points of a level, over all pairs that an accelerator aligns at once: some 200 pairs with most presets. A
pair takes memory for its pyramids (some 10 MB) and its candidates' residuals. Estimated, not measured."""


@partial(CachedProgram, returns=(Alignment,))
def _align_pairs(count, references, targets, camera, solver, options, keys, guesses):
    """Align the first `count` of B pairs: one by one on a CPU, which a single pair keeps busy, else side by side.

    Side by side `POINTS_SIDE_BY_SIDE` limits the number. The count is an input, so that XLA compiles the same loop body
    for one pair and for many, and their results agree to the last bit. Unrolled, a single pair would round differently.
    """

    @jax.jit  # traced once, for the shapes of its results and for the loop
    def one(i):
        reference, target, key, own = jax.tree.map(lambda leaf: leaf[i], (references, targets, keys, guesses))
        return _align_images(reference, target, camera, solver, options, key, own)

    if jax.default_backend() != "cpu":
        at_once = max(1, POINTS_SIDE_BY_SIDE // levels_of(camera, solver, options).most_points)
        return jax.lax.map(one, jnp.arange(keys.shape[0]), batch_size=at_once)
    empty = jax.tree.map(lambda leaf: jnp.zeros((keys.shape[0], *leaf.shape), leaf.dtype), jax.eval_shape(one, count))

    def add(i, results):
        return jax.tree.map(lambda all, new: all.at[i].set(new), results, one(i))

    return jax.lax.fori_loop(jnp.int32(0), count, add, empty)


FEATURE_KINDS: dict[str, tuple[FeatureKind, ...]] = {
    "off": (),
    "sift": ("sift",),
    "orb": ("orb",),
    "both": ("sift", "orb"),
}


def starts_of(
    guesses: Float[Array | np.ndarray, "b 4 4"] | None, sides: Any, camera: Camera, settings: Settings
) -> Float[Array, "b g 4 4"]:
    """Return each pair's guess (by default the identity) and the motions from its features, one per kind.

    Feature motions are NaN where none was found.

    Raises:
        GavoError: The guesses are not rigid motions, or not as many as there are pairs.
    """
    shape = (len(sides[0].grey), 4, 4)
    if guesses is None:
        guesses = np.broadcast_to(np.eye(4, dtype=np.float32), shape)
    elif np.shape(guesses) != shape:
        raise GavoError(f"guesses have shape {np.shape(guesses)}: expected target_T_reference, {shape}")
    else:
        guesses = _rigid_guesses(np.asarray(guesses, np.float64))
    kinds = FEATURE_KINDS[settings.alignment.features] if settings.alignment.refine else ()
    found = np.full((len(sides[0].grey), len(kinds), 4, 4), np.nan, np.float32)
    for row, pair in enumerate(zip(*sides[0], *sides[1], strict=True) if kinds else ()):
        before, after = ((np.asarray(grey), np.asarray(depth)) for grey, depth in (pair[:2], pair[2:]))
        for place, kind in enumerate(kinds):
            motion = feature_motion(before, after, camera.rectified(), kind)
            if motion is not None:
                found[row, place] = motion.target_T_reference
    return jnp.concatenate([jnp.asarray(guesses, jnp.float32)[:, None], found], axis=1)


def _as_numbers(guesses: Any) -> Float64[np.ndarray, "*b 4 4"]:
    try:
        return np.asarray(guesses, np.float64)
    except (TypeError, ValueError):
        raise GavoError(f"guess: expected target_T_reference, a matrix of numbers, got {shown(guesses)}") from None


def _rigid_guesses(guesses: Float64[np.ndarray, "b 4 4"]) -> Float64[np.ndarray, "b 4 4"]:
    """Make guesses exactly rigid, as the result of a search that starts from one is rigid only then.

    Raises:
        GavoError: One is not a rigid motion, or not finite.
    """
    broken = np.flatnonzero(~is_rigid(guesses))
    if len(broken):
        which = f"guess {broken[0]}" if len(guesses) > 1 else "the guess"
        raise GavoError(f"{which} is not a rigid motion: expected target_T_reference, a rotation and a translation")
    return rigid(guesses)


def align_rows(sides, camera, settings, keys, guesses, count: int | None = None) -> Alignment:
    """Align stacked images from the guesses of `starts_of`, with results on the device.

    If `count` is given, only the first `count` rows are computed.
    """
    rows = len(guesses)
    count = rows if count is None else count
    if rows == 1:  # padded to two rows, of which one is computed
        sides, keys, guesses = jax.tree.map(lambda leaf: jnp.concatenate([leaf, leaf]), (sides, keys, guesses))
    result = _align_pairs(
        jnp.int32(count),
        *sides,
        camera.rectified(),
        settings.solver,
        settings.alignment,
        keys,
        guesses,
    )
    return jax.tree.map(lambda leaf: leaf[:rows], result)


@in_32_bits
def align(
    reference: Frame | tuple[Any, Any],
    target: Frame | tuple[Any, Any],
    camera: Camera,
    settings: Settings | Solver | None = None,
    *,
    key: PRNGKeyArray | None = None,
    guess: Float[Array | np.ndarray, "4 4"] | None = None,
    solver: Solver | None = None,
    options: AlignmentOptions | None = None,
) -> Alignment:
    """Estimate the motion of the camera between two RGB-D frames.

    The search takes each image, with its depth, as exposed at one instant. With a rolling shutter (`Camera.readout`) or
    a delay of depth (a `Frame`'s stamps), the camera's velocity is needed, too. The motion between frames far apart
    doesn't give it. The preset `wide` estimates it at the end (`alignment.own_motion`); `error`, `overlap` and
    `explained` are then those of the motion before. The driver knows the velocity from earlier frames.

    Args:
        reference: Frame t: a `Frame`, or a pair of arrays (grey, depth) of [H, W]; depth in units of
            `camera.depth_scale` per metre, 0 = no reading.
        target: Frame t + 1.
        camera: Their camera. Any lens distortion is removed first.
        settings: Solver and objective; a solver alone stands for the default settings with that solver.
        key: Random key; `jax.random.key(0)` by default. The same key gives the same result, bit for bit.
        guess: A motion target_T_reference to start from; the identity by default.
        solver: Replaces the settings' solver.
        options: Deprecated: `alignment` of the settings.

    Returns:
        `Alignment`; the camera's own motion is the inverse of its `target_T_reference`.

    Raises:
        GavoError: The images are not of the camera's size or do not hold grey levels; the key is not a key; the guess
            is not a rigid motion; or the call is traced, by `jax.jit` for instance.
    """
    require_untraced(reference, target, camera, settings, solver, key, guess)
    settings = as_settings(settings, solver, alignment=options)
    sides = stacked_sides([reference], [target], camera)
    keys = (jax.random.key(0) if key is None else typed_keys(key, ()))[None]
    expected = None if guess is None else _as_numbers(guess).astype(np.float32)[None]
    found = align_rows(sides, camera, settings, keys, starts_of(expected, sides, camera, settings))
    result = review(found, ([reference], [target]), sides, camera, settings, expected)
    row = jax.tree.map(lambda leaf: leaf[0], result)
    return row._replace(status=AlignmentStatus(int(row.status)))


@in_32_bits
def align_batch(
    references: Any,
    targets: Any,
    camera: Camera,
    settings: Settings | Solver | None = None,
    *,
    keys: PRNGKeyArray | None = None,
    guesses: Float[Array | np.ndarray, "b 4 4"] | None = None,
    solver: Solver | None = None,
    options: AlignmentOptions | None = None,
) -> Alignment:
    """Align B pairs in one compiled call; apart from the images, memory use does not grow with a large B.

    Args:
        references: B frames: a list of `Frame` or of (grey, depth), or a pair of arrays of [B, H, W] from a camera
            without distortion.
        targets: The other B frames, likewise.
        camera: Their camera.
        settings: As in `align`.
        keys: [B] random keys; `jax.random.split(jax.random.key(0), B)` by default.
        guesses: [B, 4, 4] motions to start from; the identity by default.
        solver: As in `align`.
        options: As in `align`.

    Returns:
        An `Alignment` of NumPy arrays with a leading axis B; `status` is an integer array.

    Raises:
        GavoError: As for `align`, or the two sides differ in number, or there are no pairs.
    """
    require_untraced(references, targets, camera, settings, solver, keys, guesses)
    settings = as_settings(settings, solver, alignment=options)
    guesses = None if guesses is None else _as_numbers(guesses)
    sides, keys = stacked_pairs(references, targets, camera, keys)
    found = align_rows(sides, camera, settings, keys, starts_of(guesses, sides, camera, settings))
    return review(found, (references, targets), sides, camera, settings, guesses)
