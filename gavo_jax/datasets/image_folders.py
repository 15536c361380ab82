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


def missing_images(path: Path) -> str | None:
    """Which kind of images a folder lacks that has folders for both."""
    folders = {child.name.lower(): child for child in sorted(path.glob("*")) if child.is_dir()}
    kinds = (("colour", COLOR_FOLDERS, COLOR_SUFFIXES), ("depth", DEPTH_FOLDERS, DEPTH_SUFFIXES))
    found = [next((folders[name] for name in names if name in folders), None) for _, names, _ in kinds]
    for (kind, _, suffixes), folder in zip(kinds, found, strict=True):
        if all(found) and folder is not None and not images_among(folder.glob("*"), (*suffixes, ".npy")):
            inside = ", ".join(child.name[:60] for child in sorted(folder.glob("*"))[:2]) or "empty"
            return f"no {kind} images in {folder.name} ({inside}): those end in {', '.join(suffixes)}"
    return None


def missing_folder(path: Path) -> str | None:
    """Which folder of images a folder lacks that has that of the other kind."""
    names = {child.name.lower() for child in path.glob("*") if child.is_dir()}
    color, depth = (names & {*known} for known in (COLOR_FOLDERS, DEPTH_FOLDERS))
    if bool(color) == bool(depth):
        return None
    kind, known = ("depth", DEPTH_FOLDERS) if color else ("colour", COLOR_FOLDERS)
    return f"no folder of {kind} beside {min(color or depth)}/; {kind} is looked for in {', '.join(known)}"


def plain_files(path: Path) -> tuple[list[Path], list[Path]]:
    """Colour and depth files, each in the order of their names."""
    folders = {child.name.lower(): child for child in sorted(path.glob("*")) if child.is_dir()}
    for color in COLOR_FOLDERS:
        for depth in DEPTH_FOLDERS:
            if color in folders and depth in folders:
                files = list(folders[color].glob("*"))
                some = images_among(files, COLOR_SUFFIXES) or images_among(files, (".npy",))
                return some, images_among(folders[depth].glob("*"), DEPTH_SUFFIXES)
    files = list(path.glob("*"))
    depth = [file for file in images_among(files, DEPTH_SUFFIXES) if "depth" in file.name.lower()]
    others = [file for file in images_among(files, COLOR_SUFFIXES) if "depth" not in file.name.lower()]
    named = ([file for file in others if re.search(word, file.name, re.IGNORECASE)] for word in COLOR_WORDS)
    return next(filter(None, named), []), depth
