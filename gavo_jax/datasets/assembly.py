"""Assembly of a `Frame` from decoded images: 8-bit intensities, depth in frame units, registered to colour."""

import warnings
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Shaped, UInt16

from gavo_jax.camera import Camera
from gavo_jax.camera_files.calibration import MOST_DELAY, Calibration
from gavo_jax.datasets.base import Frame, FrameError
from gavo_jax.datasets.images import to_8_bits, white_of, without_invalid
from gavo_jax.datasets.registration import Registration
from gavo_jax.errors import GavoError, GavoWarning
from gavo_jax.number_types import NO_READING, Depth

FINE, COARSE = 5000.0, 1000.0
"""Units per metre of frames whose files hold floats; the finer one is used if its range suffices."""

FARTHEST_FINE = 12.0
"""Farthest readings, metres, for which the finer unit is used: 16 bits hold 13.1 m of it."""

MAX_EXCESS_SHARE = 0.02
"""Share of an image that may exceed its scale without a warning."""

METRES, MILLIMETRES = 1.0, 1000.0

FINER = 2
"""Fewest columns of binned colour per column of depth."""

METRE_MEDIANS, MILLIMETRE_MEDIANS = (0.05, 30.0), (300.0, 60000.0)
"""Ranges of the median of float depth that is taken for metres, or for millimetres; centimetres lie between them."""

Z_BUFFER = 0.9
"""Floats that all lie from here to 1 are what a renderer keeps to tell what is in front: 1 - near / z, nearly."""

STATED_MEDIANS = (0.05, 60.0)
"""Range of the median depth, metres, that confirms the depth scale of a camera file."""


class DepthUnit(NamedTuple):
    """Depth units per metre."""

    file: float
    """Units per metre in the files."""
    frame: float
    """Units per metre in frames: their camera's `depth_scale`."""
    of_floats: bool | None = None
    """Whether the unit holds for fractions only (True) or for whole numbers only (False); None where it was given for
    both, or is unknown."""


def recorded_as(sequence: Any) -> dict[str, Any]:
    """Describe the cameras and depth scale that a sequence was recorded with; empty if it has no `calibration`."""
    calibration: Calibration | None = getattr(sequence, "calibration", None)
    if calibration is None:
        return {}
    unit = getattr(sequence, "depth_unit", None)
    return {
        "color": calibration.color,
        "depth": calibration.depth,
        "color_T_depth": calibration.color_T_depth,
        "depth_delay": calibration.depth_delay,
        "depth_scale": None if unit is None else unit.file,
    }


class DepthImage(NamedTuple):
    """Raw depth with a name for messages."""

    raw: Depth
    name: str


def float_unit(samples: Iterable[DepthImage], calibration: Calibration, given: float | None) -> DepthUnit:
    """The unit of float depth, which is usually metres whatever the camera's `depth_scale`.

    Args:
        samples: depth images of the sequence, as stored.
        calibration: its `depth_scale` is used if a camera file states it and it gives a plausible median.
        given: units per metre, if the user gave them.

    Raises:
        GavoError: the values fit neither metres, millimetres nor the camera's `depth_scale`, or were normalised to the
            farthest; or some images hold whole numbers, which may be in another unit.
    """
    samples = list(samples)
    clean = [without_invalid(image.raw) for image in samples]
    kinds = [_is_of_floats(image) for image in clean]
    whole, floats = (
        [image.name for image, own in zip(samples, kinds, strict=True) if own is kind] for kind in (False, True)
    )
    if whole and floats and given is None:
        raise GavoError(f"{whole[0]}: depth in whole numbers, but floats in {floats[0]}: pass --depth-scale for both")
    readings = np.concatenate([image[image > 0] for image in clean]) if clean else np.empty(0)
    file = given or _likely_unit(readings, calibration, samples[0].name if samples else "")
    far = float(np.percentile(readings, 99)) / file if readings.size else 0.0
    return DepthUnit(file, FINE if far < FARTHEST_FINE else COARSE, True if floats and given is None else None)


def _is_of_floats(readings: np.ndarray) -> bool | None:
    """Whether depth has fractions (integers beyond 16 bits are stored as floats, too); None if it has no reading."""
    if not readings.any():
        return None
    return readings.dtype != np.uint16 and bool((readings % 1).any())


def _states_unit(calibration: Calibration) -> bool:
    """Whether a camera states the unit; a preset's holds for its own dataset only."""
    return calibration.preset is None and calibration.states_depth_scale


def _likely_unit(readings: Float[np.ndarray, " n"], calibration: Calibration, name: str) -> float:
    """The likely unit of the readings, per metre; `name` of a file is for messages."""
    is_stated, median = _states_unit(calibration), float(np.median(readings)) if readings.size else METRES
    if not is_stated and readings.size and Z_BUFFER < readings.min() < readings.max() <= 1:
        raise GavoError(
            f"{name}: depth of {readings.min():.3g} to {readings.max():.3g} looks like a z-buffer, not a distance: "
            "write near far / (far - (far - near) depth), or pass --depth-scale 1 if it is in metres"
        )
    if not is_stated and readings.size and readings.min() < readings.max() == 1:
        raise GavoError(
            f"{name}: the largest depth is exactly 1, as if scaled to the farthest reading: pass --depth-scale, in "
            "units per metre (0.1 if 1 stands for 10 m)"
        )
    if is_stated and _is_within(median / calibration.color.depth_scale, STATED_MEDIANS):
        return calibration.color.depth_scale
    for unit, medians in ((METRES, METRE_MEDIANS), (MILLIMETRES, MILLIMETRE_MEDIANS)):
        if _is_within(median, medians):
            return unit
    raise GavoError(
        f"{name}: a median depth of {median:g} fits neither metres nor millimetres: pass --depth-scale, "
        "in units per metre"
    )


def _is_within(value: float, bounds: tuple[float, float]) -> bool:
    return bounds[0] <= value <= bounds[1]


@dataclass(frozen=True)
class FrameAssembler:
    """Makes frames from the images of one source.

    Attributes:
        calibration: the cameras as they record.
        unit: depth units of files and frames.
        white: full scale of 16-bit intensities.
        color: whether frames have RGB beside grey. Grey is the same either way.
        undistort: whether to remove lens distortion.
    """

    calibration: Calibration
    unit: DepthUnit
    white: int = 255
    color: bool = False
    undistort: bool = True
    _told: set[str] = field(default_factory=set, compare=False, repr=False)

    @cached_property
    def binning(self) -> int:
        """Factor by which colour is binned, such that it stays at least `FINER` times as fine as depth.

        Finer pixels would have no depth of their own.
        """
        color, depth = self.calibration.color, self.calibration.depth
        return 1 if depth is None else max(1, int(color.fx / depth.fx / FINER))

    @cached_property
    def recorded(self) -> Camera:
        """The distorted colour camera, at the size of frames and with their depth scale."""
        return replace(self.calibration.color.binned(self.binning), depth_scale=self.unit.frame)

    @property
    def camera(self) -> Camera:
        """Camera of the returned frames."""
        return self.recorded.rectified() if self.undistort else self.recorded

    def frame(
        self,
        bgr: Shaped[np.ndarray, "h w 3"],
        depth: DepthImage,
        name: str,
        timestamp: float,
        depth_timestamp: float | None = None,
    ) -> Frame:
        """Make a frame.

        Args:
            bgr: colour image, 8 or 16 bits.
            depth: raw depth, as in the file.
            name: name of the colour image, for messages.
            timestamp: stamp of the colour image, seconds.
            depth_timestamp: stamp of the depth image, seconds, if known.

        Raises:
            FrameError: an image is not of its camera's size.
        """
        camera = self.recorded
        if self.calibration.depth_delay:
            apart = 0.0 if depth_timestamp is None else depth_timestamp - timestamp
            total = self.calibration.depth_delay + (apart if abs(apart) <= MOST_DELAY else 0.0)
            depth_timestamp = timestamp + min(max(total, -MOST_DELAY), MOST_DELAY)
        _check_size(bgr, self.calibration.color, name, "camera")
        if bgr.dtype != np.uint8 and np.mean(bgr > self.white) > MAX_EXCESS_SHARE:
            brighter = "is brighter than the images that were sampled"
            self._tell_once(brighter, name, f"values above {self.white} become white, in other images too")
        image = _binned(to_8_bits(bgr, self.white), self.binning)
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        rgb = cv2.cvtColor(image, cv2.COLOR_BGR2RGB) if self.color else None
        if self.undistort:
            grey = camera.undistort_image(grey)
            rgb = None if rgb is None else camera.undistort_image(rgb)
        return Frame(grey, self._depth(depth), timestamp, rgb, depth_timestamp)

    def _depth(self, depth: DepthImage) -> UInt16[np.ndarray, "height width"]:
        camera = self.calibration.depth
        if camera is None:
            _check_registered(depth, self.recorded)
            raw = self._in_frame_units(depth)
            return self.recorded.undistort_depth(raw) if self.undistort else raw
        _check_size(depth.raw, camera, depth.name, "depth camera")
        moved = self._registration(self._in_frame_units(depth), self.unit.frame)
        return np.where(self._with_grey, moved, np.uint16(0)) if self.undistort else moved

    def _in_frame_units(self, depth: DepthImage) -> UInt16[np.ndarray, "h w"]:
        of_floats, is_float = self.unit.of_floats, depth.raw.dtype != np.uint16
        if of_floats is not None and of_floats != is_float and _is_of_floats(depth.raw) is is_float:
            kinds = ("whole numbers", "floats")
            raise FrameError(
                f"{depth.name}: depth in {kinds[is_float]}, but in {kinds[of_floats]} in the images that were "
                "sampled: pass --depth-scale for both"
            )
        if depth.raw.dtype != np.uint16:
            farthest = NO_READING / self.unit.frame
            if np.mean(np.isfinite(depth.raw) & (depth.raw > farthest * self.unit.file)) > MAX_EXCESS_SHARE:
                so = f"depth beyond {farthest:.3g} m is left out, in other images too"
                self._tell_once("reaches further than frames of this source can store", depth.name, so)
        return in_frame_units(depth.raw, self.unit)

    def _tell_once(self, what: str, name: str, so: str) -> None:
        """Warn once per kind of fault, for the first image that exceeds the scale of the source."""
        if what not in self._told:
            self._told.add(what)
            warnings.warn(f"{name}: {what}: {so}", GavoWarning, stacklevel=4)

    @cached_property
    def _registration(self) -> Registration:
        depth, color_T_depth = self.calibration.depth, self.calibration.color_T_depth
        assert depth is not None and color_T_depth is not None
        return Registration(depth, self.camera, color_T_depth)

    @cached_property
    def _with_grey(self) -> np.ndarray:
        """Mask of the pixels of an undistorted image that were recorded, not extended into the border."""
        everywhere = np.ones((self.recorded.height, self.recorded.width), np.uint16)
        return self.recorded.undistort_depth(everywhere) > 0


def in_frame_units(raw: np.ndarray, unit: DepthUnit) -> UInt16[np.ndarray, "h w"]:
    """Convert raw depth to that of frames: 16 bits, 0 = no reading, `unit.frame` units per metre."""
    clean = without_invalid(raw)
    if clean.dtype == np.uint16 and unit.file == unit.frame:
        return clean
    scaled = clean * np.float32(unit.frame / unit.file) + np.float32(0.5)
    return np.where(scaled < NO_READING, scaled, np.float32(0)).astype(np.uint16)


def _binned(image: np.ndarray, pixels: int) -> np.ndarray:
    """Average blocks of pixels × pixels, as `Camera.binned` expects."""
    if pixels == 1:
        return image
    height, width = (side // pixels for side in image.shape[:2])
    whole = image[: height * pixels, : width * pixels]
    return cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA)


def common_white(images: Iterable[np.ndarray]) -> int:
    """The smallest full scale that covers the intensities of all images."""
    return max((white_of(image) for image in images if image.dtype != np.uint8), default=255)


def _check_registered(depth: DepthImage, camera: Camera) -> None:
    height, width = depth.raw.shape
    if (width, height) != (camera.width, camera.height):
        needed = "to register it, the camera file needs the depth camera (a table [depth]) and colour_T_depth"
        if width * camera.height == height * camera.width:
            needed += f"; if it differs only in size, [depth] has colour's numbers times {width / camera.width:.6g}"
        raise FrameError(
            f"{depth.name}: is {width}x{height} pixels, but the colour camera's images are "
            f"{camera.width}x{camera.height}: {needed}"
        )


def _check_size(image: np.ndarray, camera: Camera, name: str, whose: str) -> None:
    height, width = image.shape[:2]
    if (width, height) != (camera.width, camera.height):
        expected = f"the {whose}'s images are {camera.width}x{camera.height}"
        raise FrameError(f"{name}: is {width}x{height} pixels, but {expected}: pass --camera with one of that size")
