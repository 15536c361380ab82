"""Choice of a recording's colour and depth topics of one camera, by their names and messages."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from gavo_jax.datasets.recordings.messages import COMPRESSED, DEPTH_ENCODINGS, IMAGE, INFRARED, encoding_of, is_depth
from gavo_jax.errors import GavoError

COLOR_NAMES, DEPTH_NAMES = ("color", "colour", "rgb"), ("aligned", "registered", "depth_to_rgb", "depth_to_color")
"""Words in topic names that are preferred among those of one camera."""

MOVED_COLOR = ("rgb_to_depth", "color_to_depth")
"""Words in names of colour topics that are warped to the depth camera, which are chosen last."""

DEVICE = re.compile(r"depth_?(?:ai|cam(?:era)?|sensor)")
"""Matches device names that contain "depth", whose other images don't show depth."""

COLORED = re.compile(r"colou?r(?:ed|i[sz]ed|_?map)")
"""Matches names of topics with colour-mapped depth."""

SENSOR = re.compile(r"/sensor_\d+(?=/)")
"""Matches the sensor numbers of one device in RealSense's own recordings."""

STREAM = re.compile(
    r"(?:colou?r|rgb|ima?ge?|ir|infra(?:red)?|left|right|stereo|mono|gr[ae]y|aligned|registered|disparity)\d*|.*depth.*"
)
"""Matches words that distinguish images of one camera, not cameras."""

RECTIFIED = re.compile(r"(?:^|[/_])rect(?:ified)?(?:[/_]|$)")
"""Matches names of topics whose images are rectified."""


class ImageTopic(NamedTuple):
    """Properties of an image topic, from its first message."""

    is_depth: bool
    encoding: str
    """Encoding of raw images; the format of compressed ones."""
    frame: str
    """Coordinate frame of the camera."""

    @classmethod
    def of(cls, kind: str, message: Any, topic: str) -> "ImageTopic":
        """Describe a topic by a message of type `kind`."""
        return cls(is_depth(kind, message, topic), encoding_of(kind, message), message.header.frame_id)


def choose(path: Path, images: Mapping[str, ImageTopic], color: str | None, depth: str | None) -> tuple[str, str]:
    """Return the colour and depth topics: those given, else those of the same camera.

    Args:
        path: the recording, for messages.
        images: properties of the image topics, by name.
        color: the colour topic, if given.
        depth: the depth topic, if given.

    Raises:
        GavoError: a topic is missing, or the choice is ambiguous, within a camera or between several.
    """
    if not images:
        raise GavoError(f"{path}: contains no images: no topic of {IMAGE} or {COMPRESSED}")
    for given, option in ((depth, "--depth-topic"), (color, "--colour-topic")):
        if given is not None and given not in images:
            raise GavoError(f"{path}: {option}: no images on {given!r}; there are images on {_listed(images)}")
    colors, depths = _of_color(images, color, depth), _of_depth(images, color, depth)
    if colors and colors == depths:
        raise GavoError(f"{path}: {colors[0]}: chosen as both colour and depth; there are images on {_listed(images)}")
    cameras = _cameras(colors, depths)
    pairs = [(_preferred(colors, COLOR_NAMES), _preferred(depths, DEPTH_NAMES)) for colors, depths in cameras]
    if len(pairs) > 1:
        told = "; ".join(f"{_listed(colors)} with {_listed(depths)}" for colors, depths in pairs)
        raise GavoError(f"{path}: {len(pairs)} cameras, {told}: pass --colour-topic or --depth-topic of one")
    colors, depths = pairs[0]
    for best, what, option in ((depths, "depth", "--depth-topic"), (colors, "colour", "--colour-topic")):
        if len(best) != 1:
            fault = f"{what} images on {_listed(best)}" if best else f"no {what} images"
            if not best and what == "depth":
                fault += _unread(images)
            raise GavoError(f"{path}: {fault}; there are images on {_listed(images)}: pass {option}")
    return colors[0], depths[0]


def are_of_two_cameras(color: str, depth: str) -> bool:
    """Whether topics belong to two cameras, as `/front/color` and `/rear/depth`, by where their names differ."""
    both = list(zip(_words(color), _words(depth), strict=False))
    at = next((at for at, (a, b) in enumerate(both) if a != b), len(both))
    return at + 1 < len(both) and not any(STREAM.fullmatch(word) for word in both[at])


def says_registered(color: str, depth: str) -> bool:
    """Whether the depth topic is named as registered to colour, and is of the same camera."""
    return _is_named(depth, DEPTH_NAMES) and not are_of_two_cameras(color, depth)


def says_rectified(topic: str) -> bool:
    """Whether a topic is named as rectified."""
    return bool(RECTIFIED.search(topic))


def _of_depth(images: Mapping[str, ImageTopic], color: str | None, depth: str | None) -> list[str]:
    """Candidates for the depth topic."""
    if depth is not None:
        return [depth]
    names = _without_copies([name for name, one in images.items() if one.is_depth])
    return [name for name in names if name != color] or names


def _of_color(images: Mapping[str, ImageTopic], color: str | None, depth: str | None) -> list[str]:
    """Candidates for the colour topic; visualised depth counts only if there is nothing else."""
    if color is not None:
        return [color]
    names = _without_copies([name for name, one in images.items() if not one.is_depth])
    others = [name for name in names if name != depth]
    return [name for name in others if not _shows_depth(name)] if others else names


def _cameras(color: list[str], depth: list[str], level: int = 0) -> list[tuple[list[str], list[str]]]:
    """Group colour and depth topics by camera: the longest name prefixes that have topics of both kinds.

    If only the whole set has both, it is one camera.
    """
    color = _to_be_seen(color)
    places: dict[str, tuple[list[str], list[str]]] = {}
    for kind, names in enumerate((color, depth)):
        for name in names:
            words = _words(name)
            places.setdefault(words[level] if level < len(words) else name, ([], []))[kind].append(name)
    found = [place for place in places.values() if all(place)]
    return [camera for place in found for camera in _cameras(*place, level + 1)] or [(color, depth)]


def _to_be_seen(names: list[str]) -> list[str]:
    """Colour topics, else infrared ones, else those warped to the depth camera."""
    here = [name for name in names if not _is_named(name, MOVED_COLOR)]
    return [name for name in here if not INFRARED.search(name.lower())] or here or names


def _preferred(names: list[str], words: tuple[str, ...]) -> list[str]:
    return [name for name in names if _is_named(name, words)] or names


def _words(topic: str) -> list[str]:
    """The words of a topic's name in lower case."""
    return [word for word in re.split("[/_]", SENSOR.sub("", topic).lower()) if word]


def _shows_depth(topic: str) -> bool:
    """Whether a topic that is not depth is named as a picture of depth."""
    name = topic.lower()
    for words in MOVED_COLOR:
        name = name.replace(words, "")
    return "depth" in DEVICE.sub("", name) or "depth" in name and bool(COLORED.search(name))


def _unread(images: Mapping[str, ImageTopic]) -> str:
    """Describe topics that are named as depth, but have another encoding; empty if there are none."""
    faults = [f"{name} has {one.encoding[:40]!r}" for name, one in sorted(images.items()) if _shows_depth(name)]
    return f": {', '.join(faults)}, and not {', '.join(DEPTH_ENCODINGS)}" if faults else ""


def _without_copies(names: list[str]) -> list[str]:
    """Leave out topics that are compressed copies of another."""
    return [name for name in names if name.rpartition("/")[0] not in names]


def _is_named(topic: str, words: tuple[str, ...]) -> bool:
    """Whether a topic's name contains one of some words, ignoring case."""
    return any(word in topic.lower() for word in words)


def _listed(topics: Any) -> str:
    return ", ".join(sorted(topics)) or "no topic"
