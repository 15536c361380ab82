"""Where colour and depth images lie in a folder, by the names of folders and files."""

import re
from pathlib import Path

from gavo_jax.datasets.films import FILMS, frames_of
from gavo_jax.datasets.images import COLOR_SUFFIXES, DEPTH_SUFFIXES
from gavo_jax.datasets.names import form, images_among

COLOR_FOLDERS = (
    *("color", "colour", "rgb", "image", "images", "image_left", "lowres_wide"),
    *("color_images", "colour_images", "rgb_images", "rgb_raw", "color_raw", "gray"),
)
DEPTH_FOLDERS = (
    *("aligned_depth", "depth_registered", "depth", "depths", "depth_left", "lowres_depth"),
    *("depth_images", "depth_raw", "depth_rect", "depth_map", "depth_maps", "distance_to_image_plane"),
)
"""The first one counts, after those whose names say that they are registered, see `_is_registered`."""

REGISTERED = {"aligned", "align", "registered", "transformed", "to"}
"""Words of which one stands in the name of a folder of depth that is registered to colour: beside such a one, another
is that of its own camera."""

ALL_SUFFIXES = tuple({*COLOR_SUFFIXES, *DEPTH_SUFFIXES})

COLOR_NAMES = {"color", "colour", "rgb"}
DEPTH_NAMES = {"depth", "depths"}
PLAIN_WORDS = {"image", "images", "raw"}
"""What else may stand in the name of such a folder."""

PAIR = re.compile(r"(.*)(?<![a-z])(?:colou?r|rgb)(?![a-z])(.*)")
"""A folder of colour named as its scene is, as Redwood has it, or its camera; depth's has the same around its word."""

DEPTH_WORD = re.compile(r"(?<![a-z])(?:depth|distance_to_image_plane)(?![a-z])", re.IGNORECASE)
"""In the names of depth images that lie beside colour, as a part of its own, where some have it so; the latter is of
Isaac Sim's Replicator."""

NO_DEPTH = re.compile(r"(?<![a-z])(?:conf(?:idence)?|masks?|vis|preview|normals?|colou?r(?:ed)?)(?![a-z])")
"""In the names of folders of what is made of depth, or said of it."""

OF_DEPTH = re.compile(r"(?<![a-z])(?:conf(?:idence)?|masks?|vis|preview|normals?|colou?rmap)(?![a-z])", re.IGNORECASE)
"""The same in the names of files beside which depth itself lies."""

DEPTH_PART = re.compile(r"([-_. ]?)depth([-_. ]?)", re.IGNORECASE)
"""What depth's name has more than that of its colour image, where colour's has no word of its own."""

COLOR_WORDS = ("colou?r|rgb", "image|frame|img", "left", r"^\d+\.")
"""In the names of colour images that lie beside depth; the latter, at last a number and nothing else, where the former
say nothing. Of a stereo camera depth is that of the left image."""


def _is_registered(name: str) -> bool:
    """Whether a folder's name speaks of depth that is registered to colour; colour, if named, stands last."""
    words = re.split(r"[-_. ]+", name)
    said = set(words)
    if not said & DEPTH_NAMES or not said & REGISTERED or said - REGISTERED - COLOR_NAMES - DEPTH_NAMES - PLAIN_WORDS:
        return False
    return not said & COLOR_NAMES or words[-1] in COLOR_NAMES


def _candidates(path: Path) -> tuple[list[Path], list[Path]]:
    """Folders of colour and of depth images, as far as a folder has them, the one that counts first."""
    children = {child.name.lower(): child for child in sorted(path.glob("*")) if child.is_dir()}
    registered = sorted(filter(_is_registered, children), key=lambda name: (name not in DEPTH_FOLDERS, name))
    names = COLOR_FOLDERS, dict.fromkeys((*registered, *DEPTH_FOLDERS))
    color, depth = ([children[name] for name in some if name in children] for some in names)
    if color and depth:
        return color, depth
    alike = _named_alike(children)
    return alike if all(alike) else (color, depth)


def _named_alike(children: dict[str, Path]) -> tuple[list[Path], list[Path]]:
    """The same, of the one scene or camera that the names of both speak of."""
    found = _pairs(children)
    return found[0] if len(found) == 1 else ([], [])


def _pairs(children: dict[str, Path]) -> list[tuple[list[Path], list[Path]]]:
    """A folder of colour and those of depth beside it, of each scene or camera; depth's may say more at its end."""
    matches = [match for name in children if (match := PAIR.fullmatch(name))]
    return [
        ([children[match[0]]], depth)
        for match in matches
        if (depth := [children[name] for name in children if _is_depth_beside(match, name)])
    ]


def several_pairs(path: Path) -> str | None:
    """Which folders of colour have depth beside them, where several have and none goes before the others."""
    pairs = _pairs({child.name.lower(): child for child in sorted(path.glob("*")) if child.is_dir()})
    if len(pairs) < 2:
        return None
    names = ", ".join(color.name[:60] for (color, *_), _ in pairs[:3]) + ", …" * (len(pairs) > 3)
    return (
        f"{len(pairs)} folders of colour have one of depth beside them ({names}): link those of one as rgb/ and depth/"
    )


def _is_depth_beside(color: re.Match[str], name: str) -> bool:
    """Whether a folder's name is that of depth, beside colour's."""
    return name.startswith(f"{color[1]}depth{color[2]}") and not NO_DEPTH.search(name)


def _folders(path: Path) -> tuple[Path | None, Path | None]:
    """Those of colour and of depth images that count."""
    color, depth = _candidates(path)
    return next(iter(color), None), next(iter(depth), None)


def passed_over(path: Path) -> list[str]:
    """A line for each other folder of images whose name speaks of depth or colour, of a folder with folders of both."""
    candidates = _candidates(path)
    if not all(candidates):
        return []
    words = []
    for kind, some, suffixes in zip(("colour", "depth"), candidates, (COLOR_SUFFIXES, DEPTH_SUFFIXES), strict=True):
        others = [child for child in some[1:] if images_among(child.glob("*"), suffixes)]
        words += [f"{other.name}/: not read, {kind} is that of {some[0].name}/" for other in others]
    return words


def missing_images(path: Path) -> str | None:
    """Which kind of images a folder lacks that has folders for both."""
    color, depth = _folders(path)
    if color is None or depth is None:
        return None
    for kind, folder, suffixes in (("colour", color, COLOR_SUFFIXES), ("depth", depth, DEPTH_SUFFIXES)):
        if not images_among(folder.glob("*"), (*suffixes, ".npy")):
            inside = ", ".join(child.name[:60] for child in sorted(folder.glob("*"))[:2]) or "empty"
            return f"no {kind} images in {folder.name} ({inside}): those end in {', '.join(suffixes)}"
    return None


def missing_folder(path: Path) -> str | None:
    """Which folder of images a folder lacks that has that of the other kind."""
    color, depth = _folders(path)
    if (color is None) == (depth is None):
        return None
    kind, known = ("colour", COLOR_FOLDERS) if color is None else ("depth", DEPTH_FOLDERS)
    there = color or depth
    assert there is not None
    return f"no folder of {kind} beside {there.name}/; {kind} is looked for in {', '.join(known)}"


def _film_beside(path: Path) -> Path | None:
    """The film of colour that lies in a folder in place of a folder of colour; None where none or several do."""
    found = [file for file in images_among(path.glob("*"), FILMS) if file.stem.lower() in COLOR_FOLDERS]
    return found[0] if len(found) == 1 and _folders(path)[0] is None else None


def plain_files(path: Path) -> tuple[list[Path], list[Path]]:
    """Colour and depth files, each in the order of their names."""
    color, depth = _folders(path)
    if color is not None and depth is not None:
        files = list(color.glob("*"))
        some = images_among(files, COLOR_SUFFIXES) or images_among(files, (".npy",))
        return some, images_among(depth.glob("*"), DEPTH_SUFFIXES)
    if depth is not None and (film := _film_beside(path)) is not None:
        return frames_of(film), images_among(depth.glob("*"), DEPTH_SUFFIXES)
    files = list(path.glob("*"))
    named_depth = _with_depth(images_among(files, DEPTH_SUFFIXES))
    depths = [file for file in named_depth if not OF_DEPTH.search(file.name)] or named_depth
    others = sorted(set(images_among(files, COLOR_SUFFIXES)) - set(_with_depth(images_among(files, ALL_SUFFIXES))))
    named = ([file for file in others if re.search(word, file.name, re.IGNORECASE)] for word in COLOR_WORDS)
    return next(filter(None, named), _partners(others, depths)), depths


def _partners(files: list[Path], depths: list[Path]) -> list[Path]:
    """Files named as depth is but for its word, `desk_1.png` beside `desk_1_depth.png`, and others of their form."""
    stems = {DEPTH_PART.sub(kept, file.stem) for file in depths for kept in ("", r"\1", r"\2")}
    forms = {form(file.stem) for file in files if file.stem in stems}
    return [file for file in files if form(file.stem) in forms]


def _with_depth(files: list[Path]) -> list[Path]:
    """Files whose names speak of depth: as a part of its own, else within a word."""
    return [file for file in files if DEPTH_WORD.search(file.name)] or [
        file for file in files if "depth" in file.name.lower()
    ]


def missing_word(path: Path) -> str | None:
    """What the images of a folder lack that all speak of depth."""
    files = images_among(path.glob("*"), ALL_SUFFIXES)
    if not files or len(_with_depth(files)) < len(files):
        return None
    return f"all images have depth in their names, as {files[0].name[:60]}: those without it are colour"
