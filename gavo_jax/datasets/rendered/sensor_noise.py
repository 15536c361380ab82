"""Noise model of a structured-light RGB-D camera."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import cv2
import numpy as np
from jaxtyping import Float

from gavo_jax.errors import GavoError, as_number


@dataclass(frozen=True)
class SensorNoise:
    """Noise that a structured-light RGB-D camera adds to exact images and depth; none by default (all zeros).

    Depth noise and quantisation live in disparity, hence in inverse depth: both grow with z^2 (Khoshelham & Oude
    Elberink, "Accuracy and Resolution of Kinect Depth Data for Indoor Mapping Applications", Sensors 2012).

    Attributes:
        depth_sigma: standard deviation of inverse depth, 1/m: sigma_z = depth_sigma z^2.
        depth_step: quantisation of inverse depth, 1/m: neighbouring depths differ by depth_step z^2.
        depth_nearest: nearest depth with a reading, metres.
        depth_furthest: furthest depth with a reading, metres; 0 for no limit.
        baseline: from the camera to the pattern's projector along +x, metres. Where an object keeps the projector's
            light from the surface behind, there is no depth: a strip to the left of the object.
        edge_dropout: probability that a pixel beside a jump in depth has no reading.
        grey_sigma: standard deviation of grey, grey levels.
        gain_drift: amplitude of the slow change in gain (0.03: three per cent either way).
        bias_drift: amplitude of the slow change in bias, grey levels.
        drift_period: of the change in exposure, seconds.
    """

    depth_sigma: float = 0.0
    depth_step: float = 0.0
    depth_nearest: float = 0.0
    depth_furthest: float = 0.0
    baseline: float = 0.0
    edge_dropout: float = 0.0
    grey_sigma: float = 0.0
    gain_drift: float = 0.0
    bias_drift: float = 0.0
    drift_period: float = 3.0

    def __post_init__(self) -> None:
        """Refuse values that are negative or not finite."""
        for field in fields(self):
            value = as_number(f"sensor noise: {field.name}", getattr(self, field.name))
            if not (math.isfinite(value) and value >= 0):
                raise GavoError(f"sensor noise: {field.name}: must be finite, and at least 0, not {value!r}")
        if self.drift_period == 0:
            raise GavoError("sensor noise: drift_period: must be above 0")

    def disturb_grey(
        self,
        grey: Float[np.ndarray, "height width"],
        seconds: float,
        phases: Float[np.ndarray, " 2"],
        rng: np.random.Generator,
    ) -> Float[np.ndarray, "height width"]:
        """Drift of exposure at a time (phases of gain and bias, radians), then pixel noise; grey levels in and out."""
        turn = 2 * math.pi * seconds / self.drift_period
        gain = 1 + self.gain_drift * math.sin(turn + phases[0])
        bias = self.bias_drift * math.sin(0.7 * turn + phases[1])
        noise = rng.standard_normal(grey.shape, dtype=np.float32) if self.grey_sigma else np.float32(0)
        return np.float32(gain) * grey + np.float32(bias) + np.float32(self.grey_sigma) * noise

    def disturb_depth(
        self, depth: Float[np.ndarray, "height width"], focal: float, rng: np.random.Generator
    ) -> Float[np.ndarray, "height width"]:
        """Noise, quantisation and missing readings (0); depth in metres in and out, focal length along x in pixels."""
        seen = (depth > self.depth_nearest) & (depth < (self.depth_furthest or np.inf))
        if self.baseline:
            seen &= ~_projector_shadow(depth, focal * self.baseline)
        if self.edge_dropout:
            lost = rng.random(depth.shape, dtype=np.float32) < self.edge_dropout
            seen &= ~(lost & _depth_jumps(depth))
        if self.depth_sigma or self.depth_step:
            inverse = 1 / np.maximum(depth, np.float32(1e-3))
            inverse += np.float32(self.depth_sigma) * rng.standard_normal(depth.shape, dtype=np.float32)
            if self.depth_step:
                inverse = np.rint(inverse / np.float32(self.depth_step)) * np.float32(self.depth_step)
            seen &= inverse > 0
            depth = 1 / np.where(seen, inverse, np.float32(1))
        return np.where(seen, depth, np.float32(0))


NONE = SensorNoise()
"""No noise at all; grey and depth are still rounded to 8 and 16 bit."""
KINECT = SensorNoise(
    depth_sigma=1.4e-3,
    depth_step=2.85e-3,
    depth_nearest=0.4,
    depth_furthest=8.0,
    baseline=0.075,
    edge_dropout=0.3,
    grey_sigma=2.0,
    gain_drift=0.03,
    bias_drift=3.0,
)
"""About the first Kinect: disparity in eighths of a pixel (7.5 cm baseline, 580 pixels), readings from 0.4 to 8 m."""


def _projector_shadow(depth: np.ndarray, focal_baseline: float) -> np.ndarray:
    """Pixels that a projector to the right, at the same height, cannot light: bool [H, W].

    A pixel's column in the projector is x - f b / z; something further right in the image that lies further left in the
    projector stands in the light.
    """
    x = np.arange(depth.shape[1], dtype=np.float32)
    projected = x - np.float32(focal_baseline) / np.maximum(depth, np.float32(1e-3))
    leftmost = np.minimum.accumulate(projected[:, ::-1], axis=1)[:, ::-1]
    shadow = np.zeros(depth.shape, bool)
    shadow[:, :-1] = projected[:, :-1] > leftmost[:, 1:]
    return shadow


def _depth_jumps(depth: np.ndarray) -> np.ndarray:
    """Pixels whose 3 x 3 neighbourhood spans more than a twentieth of its nearest depth: bool [H, W]."""
    kernel = np.ones((3, 3), np.uint8)
    nearest = cv2.erode(depth, kernel)
    return cv2.dilate(depth, kernel) - nearest > np.float32(0.05) * nearest
