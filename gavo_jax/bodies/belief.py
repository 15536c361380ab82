"""Which pixels belong to moving bodies: evidence gathered over time and area, and smoothed along surfaces.

Each pixel has a belief between -1 (static) and +1 (moving on its own). It is carried along with the pixel's surface,
updated from each new image, and smoothed among neighbours that no depth edge separates.

A body that stops looks like the scene, and drags the camera along when it starts again. So a surface on which a body
was seen stays suspected for about half a second, unless it is clearly at rest. The same holds for parts of it that come
into view.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from gavo_jax.bodies.pixel_evidence import DEPTH_AGREES, PixelEvidence, View, box, gather_evidence
from gavo_jax.camera import Camera
from gavo_jax.image.pyramid import halve_grey, halve_inverse_depth

BELIEF_DECAY = 0.85
"""Factor by which a belief decays per frame where nothing new is known."""
MIN_MOVING_SHARE = 0.004
"""Share of the image known to move below which no body is looked for, as smoothing takes longer than all else."""
FAR = 12.0
"""Depth evidence above which a pixel shows another surface, rather than the same one moved."""
SAME = 5.0
"""Depth evidence below which a pixel shows the same surface as before."""
FOREIGN = 3.0
"""Grey evidence about a pixel above which more of it says no more."""
FADING = 0.4
"""Seconds in which a suspicion decays to 1/e."""
RELEASED = -0.57
"""Belief below which a surface is clearly at rest, and no longer suspected."""
TIED = 0.5
"""Tie above which two neighbours lie on one surface; see `_links`."""
ENTERING = 10
"""Pixels by which a suspicion spreads per frame, into areas that were not seen in the last one."""


class Belief(NamedTuple):
    """What is known and concluded about every pixel of a view."""

    known: Float[Array, "h w"]
    """Belief from -1, static, to 1, moving, from the pixel's own evidence and its past."""
    moving: Float[Array, "h w"]
    """Belief smoothed along surfaces: positive where the pixel is taken to be a body's."""
    support: Float[Array, ""]
    """Share of what was known to be static that is seen at rest."""
    contradicted: Float[Array, ""]
    """Share of what was known to be static that moves."""
    hidden: Bool[Array, "h w"]
    """Pixels that are occluded in the first of the other views."""
    carried_belief: Float[Array, "h w"]
    """Belief before this frame, carried over to the same surfaces."""
    suspected: Float[Array, "h w"]
    """How recently a body was seen on the pixel's surface, before this frame; from 0 to 1."""
    in_view: Float[Array, " v"]
    """Share of what was known to be static that lies inside each of the other views."""


@partial(jax.jit, static_argnames="carried")
def form_belief(
    here: View,
    others: View,
    others_T_here: Float[Array, "v 4 4"],
    camera: Camera,
    before: Float[Array, "h w"],
    suspected: Float[Array, "h w"] | None = None,
    *,
    carried: bool,
) -> Belief:
    """Form the belief that a motion implies for every pixel of a view.

    Args:
        here: The view.
        others: V views to compare it with; the first is its neighbour in time, the others are further off.
        others_T_here: Motions into the other views.
        camera: Camera of the views' level.
        before: Earlier belief, for the pixels of the first other view if `carried`, else for those of `here`.
        suspected: Earlier suspicion, for the pixels of the first other view; ignored unless `carried`.
        carried: Whether to carry `before` and `suspected` over from the first other view.
    """
    suspicion = suspected if carried else None
    by_area = False if suspicion is None else jnp.any(suspicion > 0)
    evidence = gather_evidence(here, others, others_T_here, camera, by_area)
    known = _carry(before, evidence, _seen_before(evidence, SAME)) if carried else before
    grey = (here.image.grey & 255).astype(jnp.int32).astype(jnp.float32)
    suspected_here = jnp.zeros_like(before) if suspicion is None else _after(suspicion, evidence, grey)
    moves, rests = _weigh(evidence, suspected_here > 0)
    moves, rests = box(moves), box(rests)
    news = jnp.clip((moves - 0.25 - rests) * 4.0, -1.0, 1.0) * jnp.clip(moves + rests, 0.0, 1.0)
    after = jnp.clip(BELIEF_DECAY * known + 0.5 * news, -1.0, 1.0)
    moving = jax.lax.cond(
        jnp.mean(jnp.maximum(after, 0.0)) > MIN_MOVING_SHARE,
        lambda: share_out(after, grey, evidence.inverse_depth),
        lambda: -jnp.ones_like(after),
    )
    has = (evidence.inverse_depth > 0).astype(jnp.float32)
    credit = jnp.clip(0.1 - known, 0.0, 1.0) * has
    hidden = evidence.depth[0] < -FAR
    at_rest = (moving < 0) & ~hidden & (evidence.seen[0] > 0)
    total = jnp.maximum(jnp.sum(credit), 1.0)
    return Belief(
        known=after,
        moving=moving,
        support=jnp.sum(credit * at_rest) / total,
        contradicted=jnp.sum(credit * (moving > 0)) / total,
        hidden=hidden,
        carried_belief=known,
        suspected=suspected_here,
        in_view=jnp.sum(credit * evidence.seen, (1, 2)) / total,
    )


def suspect(
    belief: Belief, bodies: Bool[np.ndarray, "h w"], elapsed: float, *, trusted: bool
) -> Float[np.ndarray, "h w"]:
    """Suspicions after a frame: its bodies, and earlier suspicions, which fade.

    Args:
        belief: Belief about the frame's pixels.
        bodies: Where the frame shows bodies.
        elapsed: Seconds since the last frame.
        trusted: Whether the camera's motion is trusted. If not, nothing is learnt: under a wrong motion the scene seems
            to move, and a body to be at rest.
    """
    if not trusted:
        return np.asarray(belief.suspected, np.float32)
    before = np.where(np.asarray(belief.known) < RELEASED, 0.0, np.asarray(belief.suspected))
    return np.asarray(np.maximum(np.exp(-elapsed / FADING) * before, bodies), np.float32)


def _weigh(e: PixelEvidence, was_body: Bool[Array, "h w"]) -> tuple[Float[Array, "h w"], Float[Array, "h w"]]:
    """How strongly each pixel indicates motion, and how strongly rest; both from 0 to 1.

    Where a body was seen, the area about a pixel counts, too: its texture may be too fine for single pixels, and it may
    move too little from frame to frame.

    Args:
        e: Evidence of the pixels.
        was_body: Whether a body was seen on the pixel's surface.
    """
    views = e.grey.shape[0]
    lenient = jnp.where(jnp.arange(views) > 0, 2.0, 1.0)[:, None, None]
    jump = jnp.abs(e.depth)
    small = e.depth > 0
    small |= jump < FAR * lenient
    consistent = (jump < DEPTH_AGREES * lenient) | (e.measured == 0)
    by_pixel = jnp.clip(e.grey / (1.5 * lenient) - 1.0, 0.0, 1.0)
    by_area = jnp.clip((e.grey_around / lenient - 1.25) / 0.75, 0.0, 1.0) * jnp.clip(4.0 * e.unlike - 2.0, 0.0, 1.0)
    by_grey = consistent * jnp.maximum(by_pixel, by_area * was_body)
    by_depth = small * jnp.clip(jump / (DEPTH_AGREES * lenient) - 1.0, 0.0, 1.0)
    moves = jnp.max(e.seen * jnp.maximum(by_grey, by_depth), axis=0)
    at_rest = e.seen[0] * consistent[0] * (e.grey[0] < 1.0) * ~(was_body & _differs(e, ~was_body))
    told = 0.1 + 0.4 * jnp.clip(e.texture[0] / 6.0, 0.0, 1.0)
    rests = at_rest * told * (1.0 - moves)
    return moves, rests


def _differs(e: PixelEvidence, scene: Bool[Array, "h w"]) -> Bool[Array, "h w"]:
    """Find where the grey around a pixel differs from that in an older view.

    Where all of the `scene` differs, the view's pose or sharpness is to blame, and the limit is higher.
    """
    weight, around = e.seen[1:] * scene, e.grey_around[1:]
    usual = jnp.sum(weight * jnp.minimum(around, FOREIGN), (1, 2)) / jnp.maximum(jnp.sum(weight, (1, 2)), 1.0)
    differs = (around > jnp.maximum(1.0, 2.0 * usual)[:, None, None]) & (e.unlike[1:] > 0.3)
    return jnp.any(differs, axis=0)


def _carry(before: Float[Array, "h w"], e: PixelEvidence, same: Bool[Array, "h w"]) -> Float[Array, "h w"]:
    """Earlier values on the surfaces that the pixels show; 0 where the first other view lacks the `same` surface."""
    height, width = before.shape
    u, v = jnp.round(e.place[0]).astype(jnp.int32)
    u, v = jnp.clip(u, 0, width - 1), jnp.clip(v, 0, height - 1)
    return jnp.where(same, before[v, u], 0.0)


def _seen_before(e: PixelEvidence, limit: float) -> Bool[Array, "h w"]:
    """Pixels whose surface the first other view shows, too: depth evidence is missing or below a limit."""
    return (e.seen[0] > 0) & ((e.measured[0] == 0) | (jnp.abs(e.depth[0]) < limit))


def _after(suspected: Float[Array, "h w"], e: PixelEvidence, grey: Float[Array, "h w"]) -> Float[Array, "h w"]:
    return jax.lax.cond(jnp.any(suspected > 0), lambda: follow(suspected, e, grey), lambda: jnp.zeros_like(suspected))


def follow(suspected: Float[Array, "h w"], e: PixelEvidence, grey: Float[Array, "h w"]) -> Float[Array, "h w"]:
    """Carry suspicions along with their surfaces, moved ones included, and spread them to newly visible parts."""
    same = _seen_before(e, 2.0 * FAR) & (e.measured[0] > 0)
    across, down = (tie > TIED for tie in _links(grey, e.inverse_depth))

    def spread(_: int, s: jax.Array) -> jax.Array:
        right, below = jnp.pad(s, ((0, 0), (0, 1)))[:, 1:] * across, jnp.pad(s, ((0, 1), (0, 0)))[1:] * down
        left = jnp.pad(across * s, ((0, 0), (1, 0)))[:, :-1]
        above = jnp.pad(down * s, ((1, 0), (0, 0)))[:-1]
        around = jnp.maximum(jnp.maximum(left, right), jnp.maximum(above, below))
        return jnp.where(same, s, jnp.maximum(s, around))

    return jax.lax.fori_loop(0, ENTERING, spread, _carry(suspected, e, same))


ROUNDS = (8, 12, 50)
"""Rounds of smoothing at each resolution, finest first; each resolution is half the one before."""
DATA_WEIGHT = 0.3
DEPTH_EDGE = 0.015
"""Relative step of inverse depth across which neighbours are hardly tied."""
GREY_EDGE = 25.0
"""Step of grey, grey levels, across which neighbours are hardly tied where depth is missing."""
NO_DEPTH_TIE, HALF_DEPTH_TIE = 0.3, 0.03
"""Ties of neighbours that both lack depth, and of neighbours of which one has it: a body ends where its depth does."""


def share_out(
    known: Float[Array, "h w"], grey: Float[Array, "h w"], inverse_depth: Float[Array, "h w"]
) -> Float[Array, "h w"]:
    """Smooth beliefs among neighbours on one surface, from coarse to fine.

    This minimises Σ c (m − b)² + Σ w (m − m')² over the pixels' m and pairs of neighbours m, m'. Here c is the strength
    of a pixel's own belief b, and w is small across a depth edge.
    """
    stack = [(known, jnp.abs(known) + 0.01, grey, inverse_depth)]
    while len(stack) < len(ROUNDS) and min(stack[-1][0].shape) >= 16:
        b, c, g, q = stack[-1]
        stack.append((_mean(b), _mean(c), halve_grey(g), halve_inverse_depth(q)))
    m = stack[-1][0]
    for (b, c, g, q), rounds in zip(reversed(stack), reversed(ROUNDS[: len(stack)]), strict=True):
        if m.shape != b.shape:
            m = _enlarge(m, b.shape)
        m = _settle(m, b, DATA_WEIGHT * c, _links(g, q), rounds)
    return m


def _settle(
    m: Float[Array, "h w"],
    b: Float[Array, "h w"],
    c: Float[Array, "h w"],
    links: tuple[Float[Array, "h w"], Float[Array, "h w"]],
    rounds: int,
) -> Float[Array, "h w"]:
    """Run some iterations of Jacobi's method."""
    across, down = links
    data = c * jnp.clip(3.0 * b, -1.0, 1.0)
    weight = c + across + jnp.pad(across, ((0, 0), (1, 0)))[:, :-1] + down + jnp.pad(down, ((1, 0), (0, 0)))[:-1]

    def smooth(_: int, m: jax.Array) -> jax.Array:
        right, below = jnp.pad(m, ((0, 0), (0, 1)))[:, 1:], jnp.pad(m, ((0, 1), (0, 0)))[1:]
        from_left = jnp.pad(across * m, ((0, 0), (1, 0)))[:, :-1]
        from_above = jnp.pad(down * m, ((1, 0), (0, 0)))[:-1]
        return (data + across * right + down * below + from_left + from_above) / weight

    return jax.lax.fori_loop(0, rounds, smooth, m)


def _links(grey: Float[Array, "h w"], q: Float[Array, "h w"]) -> tuple[Float[Array, "h w"], Float[Array, "h w"]]:
    """How firmly each pixel is tied to its right and its lower neighbour; 0 at the image's border."""

    def tie(axis: int) -> jax.Array:
        end = [(0, 0), (0, 0)]
        end[axis] = (0, 1)
        first = [slice(None), slice(None)]
        first[axis] = slice(1, None)
        after_q, after_grey = (jnp.pad(a, end)[tuple(first)] for a in (q, grey))
        both = (q > 0) & (after_q > 0)
        nearest = jnp.maximum(jnp.maximum(q, after_q), 1e-3)
        by_depth = jnp.exp(-(((q - after_q) / (DEPTH_EDGE * nearest + 0.003)) ** 2))
        alike = jnp.where((q > 0) == (after_q > 0), NO_DEPTH_TIE, HALF_DEPTH_TIE)
        by_grey = alike * jnp.exp(-(((grey - after_grey) / GREY_EDGE) ** 2))
        place = jax.lax.broadcasted_iota(jnp.int32, q.shape, axis)
        return jnp.where(place < q.shape[axis] - 1, jnp.where(both, by_depth, by_grey) + 1e-3, 0.0)

    return tie(1), tie(0)


def _mean(image: Float[Array, "h w"]) -> Float[Array, "h2 w2"]:
    height, width = (size // 2 * 2 for size in image.shape)
    return image[:height, :width].reshape(height // 2, 2, width // 2, 2).mean((1, 3))


def _enlarge(image: Float[Array, "h w"], shape: tuple[int, ...]) -> Float[Array, "h2 w2"]:
    doubled = jnp.repeat(jnp.repeat(image, 2, axis=0), 2, axis=1)
    return jnp.pad(doubled, [(0, size - had) for size, had in zip(shape, doubled.shape, strict=True)], mode="edge")
