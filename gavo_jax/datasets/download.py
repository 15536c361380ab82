"""Download of TUM RGB-D sequences: resumed after interruptions, checked by size, and unpacked safely."""

import difflib
import gzip
import os
import re
import shutil
import tarfile
import time
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gavo_jax.errors import GavoError, line_of
from gavo_jax.locks import hold

SERVER = "https://cvg.cit.tum.de/rgbd/dataset"
SEQUENCES = {
    "1": "360 desk desk2 floor plant room rpy teddy xyz",
    "2": "360_hemisphere 360_kidnap coke desk desk_with_person dishes flowerbouquet flowerbouquet_brownbackground "
    "large_no_loop large_with_loop metallic_sphere metallic_sphere2 pioneer_360 pioneer_slam pioneer_slam2 "
    "pioneer_slam3 rpy xyz",
    "3": "cabinet large_cabinet long_office_household nostructure_notexture_far nostructure_notexture_near_withloop "
    "nostructure_texture_far nostructure_texture_near_withloop sitting_halfsphere sitting_rpy sitting_static "
    "sitting_xyz structure_notexture_far structure_notexture_near structure_texture_far structure_texture_near teddy "
    "walking_halfsphere walking_rpy walking_static walking_xyz",
}
"""Names of the sequences, by camera."""
ATTEMPTS, PAUSE = 5, 1.0
"""Number of attempts, each resuming where the last one ended, and seconds between them."""
TIMEOUT = (10.0, 30.0)
"""Timeouts of connecting and of reading, seconds."""
CHUNK = 2**18
DAMAGED = (tarfile.TarError, gzip.BadGzipFile, EOFError, zlib.error)
"""Exceptions that reading a damaged archive raises."""
SIZE = "[0-9]{1,18}"
"""A number of bytes in a response header; anything else is ignored."""

Progress = Callable[[int, int | None], None]
"""Called with the number of bytes received and the total; None where the server does not state it."""


def folder_of(name: str) -> str:
    """Name of a sequence's folder, from `fr1_xyz`, `freiburg1_xyz` or the folder's name itself.

    Raises:
        GavoError: no such sequence; the message suggests the closest name.
    """
    known = [f"fr{camera}_{rest}" for camera, names in SEQUENCES.items() for rest in names.split()]
    short = re.sub(r"^(rgbd_dataset_)?freiburg", "fr", name.strip())
    if short not in known:
        near = difflib.get_close_matches(short, known, n=1, cutoff=0.0)[0]
        raise GavoError(f"{name!r}: not a sequence of the TUM RGB-D benchmark; did you mean {near!r}?")
    return f"rgbd_dataset_freiburg{short[2:]}"


def download(name: str, to: str | Path, server: str = SERVER, progress: Progress = lambda *_: None) -> Path:
    """Download a sequence and unpack it, unless its folder exists already.

    Args:
        name: As in `folder_of`.
        to: Folder in which the sequence's folder is created. A partial download left there by an earlier call is
            resumed.
        server: Base URL of the benchmark's files.
        progress: Called as data arrives.

    Returns:
        The sequence's folder.

    Raises:
        GavoError: unknown name, no connection, the server refuses or keeps breaking off, the archive is damaged or
            would write outside its folder, the disk is full, or pooch is missing.
    """
    folder = folder_of(name)
    target = Path(to) / folder
    if target.is_dir():
        return target
    url = f"{server.rstrip('/')}/freiburg{folder.removeprefix('rgbd_dataset_freiburg')[0]}/{folder}.tgz"
    try:
        Path(to).mkdir(parents=True, exist_ok=True)
        with hold(to, f".{folder}.lock"):
            if not target.is_dir():
                archive = _retrieve(url, Path(to), progress)
                _unpack(archive, target)
                archive.unlink()
    except OSError as error:
        raise GavoError(f"{to}: cannot be written to: {error.strerror or error}") from None
    return target


def _retrieve(url: str, to: Path, progress: Progress) -> Path:
    """Download the archive to `to`."""
    try:
        import pooch
        import requests
    except ImportError:
        raise GavoError("downloads need pooch: pip install 'gavo-jax[download]'") from None
    pooch.get_logger().setLevel("WARNING")
    name = url.rpartition("/")[2]
    partial = to / f"{name}.part"

    def fetch(url: str, output_file: Any, pooch: Any, check_only: bool | None = False) -> None:
        """Downloader for pooch that keeps partial data in `partial`."""
        _fetch_patiently(url, partial, progress)
        os.replace(partial, output_file)

    downloader: Any = fetch
    try:
        return Path(pooch.retrieve(url, known_hash=None, fname=name, path=to, downloader=downloader))
    except GavoError:
        raise
    except (requests.RequestException, ValueError) as error:
        kept = f"; {partial} keeps what was received; another call resumes from there" if partial.exists() else ""
        raise GavoError(_told(error, url, kept)) from None


def _told(error: Exception, url: str, kept: str) -> str:
    """Describe why a download failed; `kept` says what remains of it."""
    import requests

    words = line_of(error)
    match error:
        case requests.HTTPError():
            return f"{url}: the server says: {words}"
        case requests.Timeout():
            return f"{url}: no answer in time (is there a network?){kept}"
        case requests.ConnectionError():
            return f"{url}: no connection (is there a network?){kept}"
        case requests.RequestException():
            return f"{url}: the download broke off {ATTEMPTS} times: {words}{kept}"
        case _:
            return f"{url[:200]}: not an address to download from: {words}"


def _fetch_patiently(url: str, partial: Path, progress: Progress) -> None:
    """Make up to `ATTEMPTS` attempts, each resuming where the last one ended."""
    import requests

    for attempt in range(ATTEMPTS):
        try:
            _fetch(url, partial, progress)
            return
        except requests.HTTPError:
            raise
        except requests.RequestException:
            if attempt + 1 == ATTEMPTS:
                raise
            time.sleep(PAUSE)


def _fetch(url: str, partial: Path, progress: Progress) -> None:
    """Make one attempt: resume the partial file if the server supports it, else start over, and check the size."""
    import requests

    have = partial.stat().st_size if partial.exists() else 0
    headers = {"Accept-Encoding": "identity"} | ({"Range": f"bytes={have}-"} if have else {})
    with requests.get(url, headers=headers, stream=True, timeout=TIMEOUT) as response:
        if response.status_code == requests.codes.requested_range_not_satisfiable:
            partial.unlink()
            raise requests.RequestException("the partial file does not match the server's file")
        response.raise_for_status()
        span = re.fullmatch(rf"bytes ({SIZE})-{SIZE}/({SIZE}|\*)", response.headers.get("Content-Range", ""))
        goes_on = response.status_code == requests.codes.partial_content and span is not None
        if goes_on and span is not None and int(span[1]) != have:
            partial.unlink(missing_ok=True)
            raise requests.RequestException("the server resumed at the wrong position")
        if not goes_on:
            have = 0
        length = response.headers.get("Content-Length", "")
        total = have + int(length) if re.fullmatch(SIZE, length) else None
        with partial.open("ab" if goes_on else "wb") as file:
            try:
                for chunk in response.iter_content(CHUNK):
                    file.write(chunk)
                    have += len(chunk)
                    progress(have, total)
            except requests.ConnectionError:  # it stalled
                raise requests.RequestException(f"no data for {TIMEOUT[1]:g} s") from None
    if total is not None and have != total:
        raise requests.RequestException(f"received {have} of {total} bytes")


def _unpack(archive: Path, target: Path) -> None:
    """Unpack beside the target and rename, so that its folder is complete or absent."""
    scratch = target.with_name(f".unpacking-{target.name}")
    shutil.rmtree(scratch, ignore_errors=True)  # left by a killed process
    scratch.mkdir()
    try:
        with gzip.open(archive) as stream:
            with tarfile.open(fileobj=stream, mode="r:") as tar:
                for member in tar:
                    _unpack_member(tar, member, scratch, target.name)
            while stream.read(CHUNK):  # up to the checksum at its end
                pass
        if not (scratch / target.name / "rgb.txt").is_file():
            raise tarfile.ReadError(f"contains no {target.name}/rgb.txt")
        os.replace(scratch / target.name, target)
    except (*DAMAGED, FileExistsError, IsADirectoryError, NotADirectoryError) as error:
        archive.unlink()
        raise GavoError(f"{archive}: damaged or unsafe archive, now removed: {line_of(error)}") from None
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def _unpack_member(tar: tarfile.TarFile, member: tarfile.TarInfo, scratch: Path, folder: str) -> None:
    """Unpack a file or folder below `folder`, nothing else; not every Python 3.11 has the filters of `tarfile`."""
    if not (member.isfile() or member.isdir()):
        raise tarfile.ReadError(f"{member.name}: neither a file nor a folder")
    name = os.path.normpath(member.name)
    if Path(name).parts[:1] not in ((folder,), ()):
        raise tarfile.ReadError(f"{member.name}: outside {folder}")
    place = scratch / name
    if member.isdir():
        place.mkdir(parents=True, exist_ok=True)
        return
    place.parent.mkdir(parents=True, exist_ok=True)
    source = tar.extractfile(member)
    assert source is not None
    with source, place.open("xb") as file:
        shutil.copyfileobj(source, file)
