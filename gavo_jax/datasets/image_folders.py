"""Where colour and depth images lie in a folder, by the names of folders and files."""

import re
from pathlib import Path

from gavo_jax.datasets.images import COLOR_SUFFIXES, DEPTH_SUFFIXES
from gavo_jax.datasets.names import images_among

COLOR_FOLDERS = ("color", "colour", "rgb", "image", "images", "image_left", "lowres_wide")
DEPTH_FOLDERS = ("aligned_depth", "depth_registered", "depth", "depths", "depth_left", "lowres_depth")
"""The first one counts: beside depth that is registered to colour another one is that of its own camera."""

COLOR_WORDS = ("colou?r|rgb", "image|frame|img", r"^\d+\.")
"""In the names of colour images that lie beside depth; the latter, at last a number and nothing else, where the former
say nothing."""


def _folders(path: Path) -> tuple[Path | None, Path | None]:
    """Those of colour and of depth images, as far as a folder has them."""
    children = {child.name.lower(): child for child in sorted(path.glob("*")) if child.is_dir()}
    color, depth = (
        next((children[name] for name in names if name in children), None) for names in (COLOR_FOLDERS, DEPTH_FOLDERS)
    )
    return color, depth


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


def plain_files(path: Path) -> tuple[list[Path], list[Path]]:
    """Colour and depth files, each in the order of their names."""
    color, depth = _folders(path)
    if color is not None and depth is not None:
        files = list(color.glob("*"))
        some = images_among(files, COLOR_SUFFIXES) or images_among(files, (".npy",))
        return some, images_among(depth.glob("*"), DEPTH_SUFFIXES)
    files = list(path.glob("*"))
    depths = [file for file in images_among(files, DEPTH_SUFFIXES) if "depth" in file.name.lower()]
    others = [file for file in images_among(files, COLOR_SUFFIXES) if "depth" not in file.name.lower()]
    named = ([file for file in others if re.search(word, file.name, re.IGNORECASE)] for word in COLOR_WORDS)
    return next(filter(None, named), []), depths
