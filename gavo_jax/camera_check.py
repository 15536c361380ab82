"""Whether a value is a camera whose images can be aligned: the kinds of its parameters, and lenses that cannot be."""

from typing import Any

import numpy as np

from gavo_jax.camera import MIN_SIDE, Camera, to_ray, undistortion_maps, vignetting_gain
from gavo_jax.errors import GavoError

DISTORTION_COUNTS = {"pinhole": (4, 5, 8, 12, 14), "fisheye": (4,)}
"""Numbers of distortion coefficients that OpenCV accepts, by model."""

LEAST_GAIN, MOST_GAIN = 0.5, 10.0
"""Smallest and largest factor by which vignetting is undone."""

MOST_TANGENTIAL = 0.1
"""Largest p1 and p2; those of lenses are below 0.02."""

LEAST_SEEN = 0.5
"""Least share of an undistorted image that the recorded one shows."""

LOOKED_AT = 64
"""Number of pixels along each side at which a lens is looked at."""


def require_camera(camera: Camera) -> None:
    """Check that a value is a camera with valid parameters and images large enough for a pyramid.

    Raises:
        GavoError: It is not: a side has fewer than `MIN_SIDE` pixels or a focal length is not positive, say.
    """
    if not isinstance(camera, Camera):
        raise GavoError(f"expected a Camera, got {type(camera).__name__}: gavo.Camera(…) or gavo.Camera.preset(name)")
    for name, least in {"fx": 0.0, "fy": 0.0, "cx": -np.inf, "cy": -np.inf, "depth_scale": 0.0}.items():
        if not (_is_number(value := getattr(camera, name)) and value > least):
            raise GavoError(f"camera: {name}: expected a {'positive ' * (least == 0)}number, got {value!r}")
    if not (_is_number(camera.readout) and 0 <= camera.readout <= 1):
        raise GavoError(f"camera: readout: expected seconds from 0 to 1, got {camera.readout!r}")
    if min(camera.width, camera.height) < MIN_SIDE:
        size = f"{camera.width}x{camera.height}"
        raise GavoError(f"images of {size} are too small: the search needs at least {MIN_SIDE} pixels per side")
    _require_lens(camera)


def _require_lens(camera: Camera) -> None:
    if camera.model not in DISTORTION_COUNTS:
        raise GavoError(f"camera: model: expected one of {', '.join(DISTORTION_COUNTS)}, got {camera.model!r}")
    counts, distortion = DISTORTION_COUNTS[camera.model], camera.distortion
    if not (isinstance(distortion, tuple) and len(distortion) in (0, *counts) and all(map(_is_number, distortion))):
        raise GavoError(
            f"camera: distortion: expected a tuple of {', '.join(map(str, counts))} numbers, got {distortion!r}"
        )
    if not (isinstance(camera.vignetting, tuple) and all(map(_is_number, camera.vignetting))):
        raise GavoError(f"camera: vignetting: expected a tuple of numbers, got {camera.vignetting!r}")
    if any(camera.vignetting) and (doubt := doubt_about_gain(camera)):
        raise GavoError(f"camera: vignetting: {doubt}")
    if doubt := doubt_about_lens(camera):
        raise GavoError(f"camera: distortion: {doubt}")


def _is_number(value: Any) -> bool:
    """Whether a value is a finite real number of Python, NumPy or JAX."""
    array = np.asarray(value)
    return array.ndim == 0 and array.dtype.kind in "iuf" and bool(np.isfinite(array))


def doubt_about_gain(camera: Camera) -> str:
    """Return why the coefficients of vignetting must be meant for another unit of radius, pixels say; else nothing."""
    with np.errstate(over="ignore", invalid="ignore"):
        gain = vignetting_gain(camera.on_host())
    if gain.min() >= LEAST_GAIN and gain.max() <= MOST_GAIN:
        return ""
    spread = f"multiplies parts of the image by {gain.min():.3g} to {gain.max():.3g}"
    return f"{spread}, more than a lens does; is r the tangent of the angle to the axis?"


def doubt_about_lens(camera: Camera) -> str:
    """Return why the coefficients of distortion must be meant in another order or unit; else nothing."""
    order = "are they k1, k2, p1, p2, k3 in this order?"
    tangential = max(map(abs, camera.distortion[2:4]), default=0.0) if camera.model == "pinhole" else 0.0
    if tangential > MOST_TANGENTIAL:
        return f"p1 or p2 is {tangential:.3g}, more than a lens has; {order}"
    if not camera.is_distorted:
        return ""
    small = camera.resized(min(camera.width, LOOKED_AT), min(camera.height, LOOKED_AT)).on_host()
    u, v = np.moveaxis(undistortion_maps(small)[0], -1, 0)
    x, y = to_ray(small, *np.meshgrid(np.arange(small.width), np.arange(small.height)))
    seen = (u >= 0) & (u < small.width) & (v >= 0) & (v < small.height) & (np.hypot(x, y) <= small.reach)
    if (share := float(seen.mean())) < LEAST_SEEN:
        return f"{1 - share:.0%} of the undistorted image would lie outside the recorded one; {order}"
    return ""
