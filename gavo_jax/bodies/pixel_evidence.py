"""How well a motion explains a whole image, pixel by pixel, against other images of the same scene.

A search weighs a few points, the steepest ones. Here every pixel of one level counts, as a body is known by its area
and not by its contrast.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64, UInt32

from gavo_jax.bodies.lighting import light_change
from gavo_jax.camera import Camera, to_ray
from gavo_jax.image.levels import Levels, image_plane
from gavo_jax.image.sampling import INVERSE_DEPTH_STEP, GreySample, Target, look_up, sample_depth, sample_grey
from gavo_jax.image.shutter import row_time
from gavo_jax.image.warp import Points, Warped, warp
from gavo_jax.objective.error import Residuals
from gavo_jax.objective.estimates import LARGE_DEPTH_RESIDUAL, estimate_brightness, lit_in_both
from gavo_jax.objective.points import SATURATED, swept

WIDEST = 160
"""Width in pixels: bodies are seen on the finest searched level that is no wider."""


class View(NamedTuple):
    """One level of a frame, packed as a `Target`, and the camera's motion while its rows were exposed."""

    image: Target
    """The level's grey and depth, [h, w]."""
    sweep: Float[Array, "*v 6"]
    """Twist of the points in the camera during one readout. It is 0 for a global shutter, and NaN in the first frame,
    which has no predecessor.
    """

    def moving_as(self, other: Float[Array, " 6"]) -> "View":
        """The view with another view's sweep where its own is unknown."""
        return self._replace(sweep=jnp.where(jnp.isnan(self.sweep), jnp.nan_to_num(other), self.sweep))


def seen_level(levels: Levels) -> int:
    """Index, among the searched levels, of the one that bodies are seen on."""
    narrow = [place for place, (_, width) in enumerate(levels.sizes) if width <= WIDEST]
    return narrow[-1] if narrow else 0


def view_of(packed: Target, levels: Levels, sweep: Float[Array, " 6"]) -> View:
    """Cut the level that bodies are seen on from all packed levels of a frame."""
    place = seen_level(levels)
    (row, column), (height, width) = levels.layout.corners[place], levels.sizes[place]
    cut: list[UInt32[Array, "h w"]] = [channel[row : row + height, column : column + width] for channel in packed]
    return View(Target(*cut), sweep)


def inverse_depth_of(view: View) -> Float64[np.ndarray, "h w"]:
    """1/z of a view's pixels, on the host; 0 where there is no reading."""
    return (np.asarray(view.image.depth) & 65535) * INVERSE_DEPTH_STEP


class PixelEvidence(NamedTuple):
    """Evidence on a motion from every pixel of a view, by each of V other views."""

    grey: Float[Array, "v h w"]
    """Grey residual over what noise and a small shift of the image would cause; 0 where it cannot be told."""
    grey_around: Float[Array, "v h w"]
    """The same for the surface within a square of `AROUND` pixels, root mean square. Where texture finer than the
    allowed shift moves, the area tells, though hardly any of its pixels does.
    """
    unlike: Float[Array, "v h w"]
    """Mean square of its grey residual over the contrast of both views: 1 where these have nothing in common."""
    depth: Float[Array, "v h w"]
    """Inverse-depth residual in the same units: positive where the pixel shows a surface nearer than the one seen there
    before.
    """
    texture: Float[Array, "v h w"]
    """How clearly grey would reveal a wrong motion: its gradient over the noise."""
    seen: Float[Array, "v h w"]
    """1 where the pixel has depth and lies inside the other view, else 0."""
    measured: Float[Array, "v h w"]
    """1 where the other view has depth there as well."""
    inverse_depth: Float[Array, "h w"]
    """Inverse depth of the pixels, 1/m; 0 where there is no reading."""
    place: Float[Array, "v 2 h w"]
    """Column and row where the pixel lies in the other view."""


GREY_NOISE = 4.0
"""Noise of grey in grey levels, interpolation and compression included."""
DEPTH_NOISE = 0.006
"""Noise of inverse depth, 1/m: twice the quantisation of a structured-light sensor."""
SLACK = 0.4
"""Pixels by which a correct motion may seem off, because of shutter, timestamps and registration of depth."""
SLACK_OF_FLOW = 0.04
"""Additional slack for each pixel of image motion between neighbouring frames."""
DEPTH_AGREES = 3.0
"""Depth evidence below which depth agrees with the motion."""
AROUND = 5
"""Side of the square over which evidence is averaged, pixels."""
BRIGHTNESS_STRIDE = 16
"""One pixel in this many is used to estimate brightness."""


def gather_evidence(
    here: View, others: View, others_T_here: Float[Array, "v 4 4"], camera: Camera, by_area: Any = True
) -> PixelEvidence:
    """Gather the evidence of every pixel of a view against V other views.

    Args:
        here: The view whose pixels are tested.
        others: The views they are compared with, a leading axis V on every leaf.
        others_T_here: Maps points of the camera here into the cameras of the others.
        camera: Camera of the views' level.
        by_area: Whether to gather `grey_around` and `unlike`, too, which are 0 otherwise; it may be traced.
    """
    width, height = camera.width, camera.height
    compared = compare(here, others, others_T_here, camera)
    r, grey, q, (u, v), *_ = compared
    residual = jnp.abs(r.grey)
    views = r.grey.shape[0]
    own = jnp.hypot(grey.along_u, grey.along_v)
    steep = jnp.maximum(own, jnp.hypot(r.grey_sample.along_u, r.grey_sample.along_v))
    slope = jnp.hypot(r.depth_sample.along_u, r.depth_sample.along_v)
    flow = jnp.hypot(r.warped.u[0] - u, r.warped.v[0] - v) * r.inside[0]
    slack = SLACK + SLACK_OF_FLOW * flow
    shape = (views, height, width)
    told = lit_in_both(r)
    jump = r.depth / (DEPTH_NOISE + slack * slope)

    same = told * r.inside * (jnp.abs(jump) < DEPTH_AGREES)
    images = grey.value, r.grey_sample.value
    of_area = [image.reshape(-1, height, width) for image in (residual, slack * steep, same, *images)]
    nothing = jnp.zeros(shape)
    grey_around, unlike = jax.lax.cond(by_area, lambda: _around(*of_area), lambda: (nothing, nothing))
    return PixelEvidence(
        grey=(told * residual / (GREY_NOISE + slack * steep)).reshape(shape),
        grey_around=grey_around,
        unlike=unlike,
        depth=jump.reshape(shape),
        texture=(told * steep / GREY_NOISE).reshape(shape),
        seen=r.inside.reshape(shape),
        measured=r.depth_valid.reshape(shape),
        inverse_depth=q.reshape(height, width),
        place=jnp.stack([r.warped.u, r.warped.v], axis=1).reshape(views, 2, height, width),
    )


def _around(
    residual: Float[Array, "v h w"],
    shift: Float[Array, "v h w"],
    same: Float[Array, "v h w"],
    *images: Float[Array, "#v h w"],
) -> tuple[Float[Array, "v h w"], Float[Array, "v h w"]]:
    """Return `grey_around` and `unlike` of `PixelEvidence`.

    Args:
        residual: Residuals, grey levels.
        shift: What a small shift of the image would cause, grey levels.
        same: 1 where both views show the same surface, else 0.
        images: Grey of the view itself and of the others.
    """
    left, share = box(same * jnp.square(residual)), jnp.maximum(box(same), 0.5)
    allowed = box(same * (GREY_NOISE**2 + jnp.square(shift)))
    contrast = 2.0 * GREY_NOISE**2 * share
    for image in images:
        contrast += box(same * jnp.square(image)) - jnp.square(box(same * image)) / share
    return jnp.sqrt(left / jnp.maximum(allowed, 0.5 * GREY_NOISE**2)), left / jnp.maximum(contrast, GREY_NOISE**2)


def box(image: Float[Array, "*v h w"]) -> Float[Array, "*v h w"]:
    """Mean over the square of `AROUND` pixels about each pixel."""
    height, width = image.shape[-2:]
    ends = [(0, 0)] * (image.ndim - 2) + [(AROUND // 2, AROUND // 2)] * 2
    padded = jnp.pad(image, ends, mode="edge")
    first, *others = (padded[..., k : k + height, :] for k in range(AROUND))
    columns = sum(others, first) / AROUND
    first, *others = (columns[..., k : k + width] for k in range(AROUND))
    return sum(others, first) / AROUND


class Compared(NamedTuple):
    """Pixels of a view beside what V other views show there; flat arrays of N."""

    residuals: Residuals
    """Residuals [V, N]; those of grey are corrected for brightness and for local changes of light."""
    grey: GreySample
    """Grey of the view itself, with its slopes."""
    inverse_depth: Float[Array, " n"]
    place: tuple[Float[Array, " n"], Float[Array, " n"]]
    """Column and row of each pixel in the view."""
    as_bright: Float[Array, "v n"]
    """Grey of the view, adjusted to the overall brightness of the others."""
    light: Float[Array, "v n"]
    """How much brighter the others show each place than `as_bright`, as a share of it."""
    same: Float[Array, "v n"]
    """1 where both show the same surface, as far as depth tells, and neither is saturated, else 0."""


def compare(
    here: View, others: View, others_T_here: Float[Array, "v 4 4"], camera: Camera, stride: int = 1
) -> Compared:
    """Compare every pixel of a view, or one in `stride` along either side, with V others; see `gather_evidence`."""
    plane = image_plane(camera)
    here = here.moving_as(others.sweep[0])
    others = others.moving_as(here.sweep)
    height, width = here.image.grey.shape
    u, v = jnp.arange(0, width, stride, dtype=jnp.float32), jnp.arange(0, height, stride, dtype=jnp.float32)[:, None]
    u, v = (jnp.broadcast_to(a, (v.shape[0], u.shape[0])).reshape(-1) for a in (u, v))
    one = jnp.ones_like(u)
    itself = Warped(u, v, one, one)
    words = look_up(here.image, itself, plane)
    grey, depth = sample_grey(words, itself), sample_depth(words, itself)
    q = jnp.where((depth.valid > 0) & (u < width - 1) & (v < height - 1), depth.value, 0.0)
    points = swept(Points(*to_ray(plane, u, v), q), here.sweep, -row_time(v, plane))
    lit = (grey.value < SATURATED).astype(jnp.float32)

    def against(image: Target, sweep: Float[Array, " 6"], other_T_here: Float[Array, "4 4"]) -> Residuals:
        first = warp(points, other_T_here, plane)
        x, y = to_ray(plane, first.u, first.v)
        there = swept(Points(x, y, first.inverse_depth), sweep, row_time(first.v, plane) * first.inside)
        there = there._replace(q=jnp.where(first.inside > 0, there.q, 0.0))
        seen = warp(there, jnp.eye(4), plane)
        words = look_up(image, seen, plane)
        sample, surface = sample_grey(words, seen), sample_depth(words, seen)
        depth = (seen.inverse_depth - surface.value) * surface.valid * seen.inside
        return Residuals(
            grey=sample.value - grey.value,
            depth=depth,
            inside=seen.inside,
            lit=lit,
            depth_valid=surface.valid * seen.inside,
            warped=seen,
            grey_sample=sample,
            depth_sample=surface,
        )

    r = jax.vmap(against)(others.image, others.sweep, others_T_here)
    few: Residuals = jax.tree.map(lambda leaf: leaf[:, :: max(1, BRIGHTNESS_STRIDE // stride**2)], r)
    # pixels of other surfaces would lower the regression's gain, and dark parts of the scene would seem to change
    few = few._replace(inside=few.inside * (jnp.abs(few.depth) < LARGE_DEPTH_RESIDUAL))
    seen_grey = jnp.broadcast_to(grey.value, r.grey.shape)
    brightness = estimate_brightness(seen_grey[:, :: max(1, BRIGHTNESS_STRIDE // stride**2)], few)
    as_bright = brightness.seen(seen_grey)
    residual = r.grey_sample.value - as_bright
    same = lit_in_both(r) * (jnp.abs(r.depth) < LARGE_DEPTH_RESIDUAL)
    shape = (-1, -(-height // stride), -(-width // stride))
    light = light_change(*(one.reshape(shape) for one in (residual, as_bright, same))).reshape(residual.shape)
    r = r._replace(grey=residual - as_bright * light)
    return Compared(r, grey, q, (u, v), as_bright, light, same)
