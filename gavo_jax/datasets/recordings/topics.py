"""Which topics of a recording are colour and depth of one camera, by their names and what their messages hold."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from gavo_jax.datasets.recordings.messages import COMPRESSED, DEPTH_ENCODINGS, IMAGE, INFRARED, encoding_of, is_depth
from gavo_jax.errors import GavoError

COLOR_NAMES, DEPTH_NAMES = ("color", "colour", "rgb"), ("aligned", "registered", "depth_to_rgb", "depth_to_color")
"""Words in the names of topics that are chosen before others of the same camera."""

MOVED_COLOR = ("rgb_to_depth", "color_to_depth")
"""In the names of topics of colour as the depth camera would see it, which are chosen last."""

DEVICE = re.compile(r"depth_?(?:ai|cam(?:era)?|sensor)")
"""In the name of a topic: a device that is called after depth, whose other images are no pictures of it."""

COLORED = re.compile(r"colou?r(?:ed|i[sz]ed|_?map)")
"""In the name of a topic of depth that was drawn in colours."""

SENSOR = re.compile(r"/sensor_\d+(?=/)")
"""In the names of RealSense's own recordings, which number the sensors of one device."""

STREAM = re.compile(
    r"(?:colou?r|rgb|ima?ge?|ir|infra(?:red)?|left|right|stereo|mono|gr[ae]y|aligned|registered|disparity)\d*|.*depth.*"
)
"""A word that tells one image of a camera from another, and no camera from another."""

RECTIFIED = re.compile(r"(?:^|[/_])rect(?:ified)?(?:[/_]|$)")
"""In the name of a topic whose images are free of distortion."""


class Images(NamedTuple):
    """What the first message of a topic tells of all."""

    is_depth: bool
    encoding: str
    """Encoding of raw images; the format of compressed ones."""
    frame: str
    """In which their camera looks."""

    @classmethod
    def of(cls, kind: str, message: Any, topic: str) -> "Images":
        """Describe a topic by a message of type `kind`."""
        return cls(is_depth(kind, message, topic), encoding_of(kind, message), message.header.frame_id)


def choose(path: Path, images: Mapping[str, Images], color: str | None, depth: str | None) -> tuple[str, str]:
    """Return the topics of colour and depth: those that are named, and beside them those of the same camera.

    Args:
        path: of the recording, for what is said of it.
        images: by the names of topics.
        color: the topic of colour, where it is named.
        depth: the topic of depth, where it is named.

    Raises:
        GavoError: there is none, or there are several, of one camera or of more.
    """
    if not images:
        raise GavoError(f"{path}: holds no images: no topic of {IMAGE} or {COMPRESSED}")
    for given, option in ((depth, "--depth-topic"), (color, "--colour-topic")):
        if given is not None and given not in images:
            raise GavoError(f"{path}: {option}: no images on {given!r}: those are on {_listed(images)}")
    colors, depths = _of_color(images, color, depth), _of_depth(images, color, depth)
    if colors and colors == depths:
        raise GavoError(
            f"{path}: {colors[0]}: chosen as colour and as depth alike: there are images on {_listed(images)}"
        )
    cameras = _cameras(colors, depths)
    pairs = [(_preferred(colors, COLOR_NAMES), _preferred(depths, DEPTH_NAMES)) for colors, depths in cameras]
    if len(pairs) > 1:
        told = "; ".join(f"{_listed(colors)} with {_listed(depths)}" for colors, depths in pairs)
        raise GavoError(f"{path}: {len(pairs)} cameras, {told}: say --colour-topic or --depth-topic of one")
    colors, depths = pairs[0]
    for best, what, option in ((depths, "depth", "--depth-topic"), (colors, "colour", "--colour-topic")):
        if len(best) != 1:
            fault = f"{what} images on {_listed(best)}" if best else f"no {what} images"
            if not best and what == "depth":
                fault += _unread(images)
            raise GavoError(f"{path}: {fault}; there are images on {_listed(images)}: say {option}")
    return colors[0], depths[0]


def are_of_two_cameras(color: str, depth: str) -> bool:
    """Whether topics part at the names of two cameras, `/front/color` and `/rear/depth`, and not at their images'."""
    both = list(zip(_words(color), _words(depth), strict=False))
    at = next((at for at, (a, b) in enumerate(both) if a != b), len(both))
    return at + 1 < len(both) and not any(STREAM.fullmatch(word) for word in both[at])


def says_registered(color: str, depth: str) -> bool:
    """Whether the topic of depth says of itself that it lies on the images of colour, of the same camera."""
    return _is_named(depth, DEPTH_NAMES) and not are_of_two_cameras(color, depth)


def says_rectified(topic: str) -> bool:
    """Whether a topic's name says that its images are free of distortion."""
    return bool(RECTIFIED.search(topic))


def _of_depth(images: Mapping[str, Images], color: str | None, depth: str | None) -> list[str]:
    """Topics that may be the depth."""
    if depth is not None:
        return [depth]
    names = _without_copies([name for name, one in images.items() if one.is_depth])
    return [name for name in names if name != color] or names


def _of_color(images: Mapping[str, Images], color: str | None, depth: str | None) -> list[str]:
    """Topics that may be the colour; a picture of depth has to be named."""
    if color is not None:
        return [color]
    names = _without_copies([name for name, one in images.items() if not one.is_depth])
    others = [name for name in names if name != depth]
    return [name for name in others if not _shows_depth(name)] if others else names


def _cameras(color: list[str], depth: list[str], level: int = 0) -> list[tuple[list[str], list[str]]]:
    """Topics of colour and depth by their cameras: the longest beginnings of names that both are found under.

    Where nothing but the whole has both, it is one camera.
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
    """Topics of colour, or else of infrared, or else of what was moved to the depth camera."""
    here = [name for name in names if not _is_named(name, MOVED_COLOR)]
    return [name for name in here if not INFRARED.search(name.lower())] or here or names


def _preferred(names: list[str], words: tuple[str, ...]) -> list[str]:
    return [name for name in names if _is_named(name, words)] or names


def _words(topic: str) -> list[str]:
    """The words of a topic's name, small."""
    return [word for word in re.split("[/_]", SENSOR.sub("", topic).lower()) if word]


def _shows_depth(topic: str) -> bool:
    """Whether the name of a topic of other images than depth says that they show depth."""
    name = topic.lower()
    for words in MOVED_COLOR:
        name = name.replace(words, "")
    return "depth" in DEVICE.sub("", name) or "depth" in name and bool(COLORED.search(name))


def _unread(images: Mapping[str, Images]) -> str:
    """Which topics, by their names, would be depth if their encoding were."""
    faults = [f"{name} has {one.encoding[:40]!r}" for name, one in sorted(images.items()) if _shows_depth(name)]
    return f": {', '.join(faults)}, and not {', '.join(DEPTH_ENCODINGS)}" if faults else ""


def _without_copies(names: list[str]) -> list[str]:
    """Topics without those that hold the same images as another, compressed."""
    return [name for name in names if name.rpartition("/")[0] not in names]


def _is_named(topic: str, words: tuple[str, ...]) -> bool:
    """Whether a topic's name holds one of some words, small or capital."""
    return any(word in topic.lower() for word in words)


def _listed(topics: Any) -> str:
    return ", ".join(sorted(topics)) or "no topic"
