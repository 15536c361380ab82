"""Location of colour and depth images in a folder, by the names of folders and files."""

import re
from pathlib import Path

from gavo_jax.datasets.films import FILMS, frames_of
from gavo_jax.datasets.images import COLOR_SUFFIXES, DEPTH_SUFFIXES
from gavo_jax.datasets.names import images_among, mask_numbers

COLOR_FOLDERS = (
    *("color", "colour", "rgb", "image", "images", "image_left", "lowres_wide"),
    *("color_images", "colour_images", "rgb_images", "rgb_raw", "color_raw", "gray", "jpegimages"),
)
DEPTH_FOLDERS = (
    *("aligned_depth", "depth_registered", "depth", "depths", "depth_left", "lowres_depth"),
    *("depth_images", "depth_raw", "depth_rect", "depth_map", "depth_maps", "distance_to_image_plane"),
)
"""Names of depth folders, in order of preference, after those that are named as registered (`_is_registered`)."""

REGISTERED = {"aligned", "align", "registered", "transformed", "to"}
"""Words that mark a depth folder as registered to colour; another one beside it is the depth camera's own."""

ALL_SUFFIXES = tuple({*COLOR_SUFFIXES, *DEPTH_SUFFIXES})

COLOR_NAMES = {"color", "colour", "rgb"}
DEPTH_NAMES = {"depth", "depths"}
PLAIN_WORDS = {"image", "images", "raw"}
"""Other words allowed in the name of a registered depth folder."""

PAIR = re.compile(r"(.*)(?<![a-z])(?:colou?r|rgb)(?![a-z])(.*)")
"""Colour folder named after its scene (as in Redwood) or camera; the depth folder has the same text around "depth"."""

DEPTH_WORD = re.compile(r"(?<![a-z])(?:depth|distance_to_image_plane)(?![a-z])", re.IGNORECASE)
"""Marks depth images in the same folder as colour, as a separate word if any name has it so; the longer one is of Isaac
Sim's Replicator."""

DERIVED = "conf(?:idence)?|masks?|vis|preview|normals?"
"""Words in names of images that are derived from depth."""

PICTURES = (
    r"disp(?:arity|arities)?|inv(?:erse)?|vi[sz](?:uali[sz](?:ation|ed))?|colou?rmaps?|cmap|colou?ri[sz]ed|8[-_]?bit"
)
"""Words in names of disparity and of pictures of depth."""

NO_DEPTH = re.compile(rf"(?<![a-z])(?:{DERIVED}|colou?r(?:ed)?)(?![a-z])")
"""Marks folders of images derived from depth, or about it."""

OF_DEPTH = re.compile(rf"(?<![a-z])(?:{DERIVED}|{PICTURES})(?![a-z])", re.IGNORECASE)
"""Marks files and folders derived from depth, where depth itself lies beside them."""

BIT_DEPTH, PNG = 24, b"\x89PNG"
"""Place of the bits per channel in a PNG, and its first bytes."""

DEPTH_PART = re.compile(r"([-_. ]?)depth([-_. ]?)", re.IGNORECASE)
"""The part that distinguishes a depth image's name from its colour image's, where colour's has no word of its own."""

COLOR_WORDS = ("colou?r|rgb", "image|frame|img", "left", r"^\d+\.")
"""Patterns that mark colour images in the same folder as depth, tried in order; the last is a bare number. Depth of a
stereo camera belongs to the left image."""


def _is_registered(name: str) -> bool:
    """Whether a folder is named as depth registered to colour; if its name mentions colour, it has to end with it."""
    words = re.split(r"[-_. ]+", name)
    said = set(words)
    if not said & DEPTH_NAMES or not said & REGISTERED or said - REGISTERED - COLOR_NAMES - DEPTH_NAMES - PLAIN_WORDS:
        return False
    return not said & COLOR_NAMES or words[-1] in COLOR_NAMES


def _subfolders(path: Path) -> dict[str, Path]:
    """The folders in a folder by their names in lower case."""
    return {child.name.lower(): child for child in sorted(path.glob("*")) if child.is_dir()}


def _candidates(path: Path) -> tuple[list[Path], list[Path]]:
    """Colour folders and depth folders in a folder, the preferred one first."""
    children = _subfolders(path)
    registered = sorted(filter(_is_registered, children), key=lambda name: (name not in DEPTH_FOLDERS, name))
    names = COLOR_FOLDERS, dict.fromkeys((*registered, *DEPTH_FOLDERS))
    color, depth = ([children[name] for name in some if name in children] for some in names)
    if color and depth:
        return color, depth
    alike = _named_alike(children)
    return alike if all(alike) else (color, depth)


def _named_alike(children: dict[str, Path]) -> tuple[list[Path], list[Path]]:
    """Colour and depth folders named after the same scene or camera, if unique."""
    found = _pairs(children)
    return found[0] if len(found) == 1 else ([], [])


def _pairs(children: dict[str, Path]) -> list[tuple[list[Path], list[Path]]]:
    """The colour folder and the depth folders of each scene or camera; depth's name may have a suffix."""
    matches = [match for name in children if (match := PAIR.fullmatch(name))]
    return [
        ([children[match[0]]], depth)
        for match in matches
        if (depth := [children[name] for name in sorted(children, key=_is_derived) if _is_depth_beside(match, name)])
    ]


def _is_derived(name: str) -> bool:
    """Whether a name marks images derived from depth."""
    return bool(OF_DEPTH.search(name))


def several_pairs(path: Path) -> str | None:
    """Which folders of colour have depth beside them, where several have and none goes before the others."""
    pairs = _pairs(_subfolders(path))
    if len(pairs) < 2:
        return None
    names = ", ".join(color.name[:60] for (color, *_), _ in pairs[:3]) + ", …" * (len(pairs) > 3)
    return f"{len(pairs)} colour folders have a depth folder beside them ({names}): link one pair as rgb/ and depth/"


def _is_depth_beside(color: re.Match[str], name: str) -> bool:
    """Whether a folder's name is that of the depth folder matching a colour folder."""
    return name.startswith(f"{color[1]}depth{color[2]}") and not NO_DEPTH.search(name)


def _folders(path: Path) -> tuple[Path | None, Path | None]:
    """The preferred folders of colour and depth images."""
    color, depth = _candidates(path)
    return next(iter(color), None), next(iter(depth), None)


def passed_over(path: Path) -> list[str]:
    """List further colour and depth folders that are not read, one line each, if there are folders of both kinds."""
    candidates = _candidates(path)
    if not all(candidates):
        return []
    words = []
    for kind, some, suffixes in zip(("colour", "depth"), candidates, (COLOR_SUFFIXES, DEPTH_SUFFIXES), strict=True):
        others = [child for child in some[1:] if images_among(child.glob("*"), suffixes)]
        words += [f"{other.name}/: not read, {kind} comes from {some[0].name}/" for other in others]
    depth = candidates[1][0]
    if aside := sorted({*images_among(depth.glob("*"), DEPTH_SUFFIXES)} - {*_depth_in(depth)}):
        words.append(f"{len(aside)} images in {depth.name}/: derived from depth beside them, such as {aside[0].name}")
    return words


def _depth_in(folder: Path) -> list[Path]:
    """Depth images in a folder: without those derived from it, and without its pictures beside arrays of it."""
    images = images_among(folder.glob("*"), DEPTH_SUFFIXES)
    images = [image for image in images if not _is_derived(image.name)] or images
    arrays = {image.stem for image in images if image.suffix.lower() != ".png"}
    return [image for image in images if image.stem not in arrays or not _is_picture(image)]


def _is_picture(image: Path) -> bool:
    """Whether a file is a PNG of up to 8 bits per channel."""
    try:
        with image.open("rb") as stream:
            head = stream.read(BIT_DEPTH + 1)
    except OSError:  # reported when it is decoded
        return False
    return head.startswith(PNG) and len(head) > BIT_DEPTH and head[BIT_DEPTH] <= 8


def missing_images(path: Path) -> str | None:
    """Describe which kind of images is missing in a folder with subfolders for both; None if neither is."""
    color, depth = _folders(path)
    if color is None or depth is None:
        return None
    for kind, folder, suffixes in (("colour", color, COLOR_SUFFIXES), ("depth", depth, DEPTH_SUFFIXES)):
        if not images_among(folder.glob("*"), (*suffixes, ".npy")):
            inside = sorted(folder.glob("*"))
            names = ", ".join(child.name[:60] for child in inside[:2]) or "empty"
            hint = _instead_of_images(kind, folder.name, inside) or f"expected names ending in {', '.join(suffixes)}"
            return f"no {kind} images in {folder.name} ({names}): {hint}"
    return None


def _instead_of_images(kind: str, folder: str, inside: list[Path]) -> str:
    """Advice on what lies in a folder in place of images; empty if there is none."""
    endings = {child.suffix.lower() for child in inside}
    if inside and all(child.is_dir() for child in inside):
        return f"if they are in {inside[0].name[:60]}/, link it as {folder}/"
    if kind == "colour" and len(inside) == 1 and endings & {*FILMS}:
        return f"a film goes beside that folder, as rgb{inside[0].suffix}"
    if kind == "depth" and endings & {".jpg", ".jpeg", ".webp"}:
        return "these are pictures of depth: write depth itself, as 16-bit PNG or TIFF of floats"
    return ""


def missing_folder(path: Path) -> str | None:
    """Describe which image folder is missing beside that of the other kind; None if both or neither are there."""
    color, depth = _folders(path)
    if (color is None) == (depth is None):
        return None
    kind, known = ("colour", COLOR_FOLDERS) if color is None else ("depth", DEPTH_FOLDERS)
    there = color or depth
    assert there is not None
    return f"no folder of {kind} beside {there.name}/; {kind} is looked for in {', '.join(known)}"


def _film_beside(path: Path) -> Path | None:
    """The colour film that takes the place of a colour folder; None unless there is exactly one."""
    found = [file for file in images_among(path.glob("*"), FILMS) if file.stem.lower() in COLOR_FOLDERS]
    return found[0] if len(found) == 1 and _folders(path)[0] is None else None


def plain_files(path: Path) -> tuple[list[Path], list[Path]]:
    """Colour and depth files, each sorted by name."""
    color, depth = _folders(path)
    if color is not None and depth is not None:
        files = list(color.glob("*"))
        some = images_among(files, COLOR_SUFFIXES) or images_among(files, (".npy",))
        return some, _depth_in(depth)
    if depth is not None and (film := _film_beside(path)) is not None:
        return frames_of(film), _depth_in(depth)
    files = list(path.glob("*"))
    named_depth = _with_depth(images_among(files, DEPTH_SUFFIXES))
    depths = [file for file in named_depth if not _is_derived(file.name)] or named_depth
    others = sorted(set(images_among(files, COLOR_SUFFIXES)) - set(_with_depth(images_among(files, ALL_SUFFIXES))))
    named = ([file for file in others if re.search(word, file.name, re.IGNORECASE)] for word in COLOR_WORDS)
    return next(filter(None, named), _partners(others, depths)), depths


def _partners(files: list[Path], depths: list[Path]) -> list[Path]:
    """Files named as depth is but for its word, `desk_1.png` beside `desk_1_depth.png`, and others of their form."""
    stems = {DEPTH_PART.sub(kept, file.stem) for file in depths for kept in ("", r"\1", r"\2")}
    forms = {mask_numbers(file.stem) for file in files if file.stem in stems}
    return [file for file in files if mask_numbers(file.stem) in forms]


def _with_depth(files: list[Path]) -> list[Path]:
    """Files whose names contain "depth" as a separate word, or if none does, as part of a word."""
    return [file for file in files if DEPTH_WORD.search(file.name)] or [
        file for file in files if "depth" in file.name.lower()
    ]


def missing_word(path: Path) -> str | None:
    """Describe why a folder has no colour images if all names contain "depth"; else None."""
    files = images_among(path.glob("*"), ALL_SUFFIXES)
    if not files or len(_with_depth(files)) < len(files):
        return None
    return f"all images have depth in their names, such as {files[0].name[:60]}: only those without it are colour"
