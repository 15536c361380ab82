"""Image files of every kind: what they become, and what is refused in one line."""

import os
import struct
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gavo_jax.camera import Camera
from gavo_jax.camera_files.calibration import Calibration
from gavo_jax.datasets.base import Frame, FrameError
from gavo_jax.datasets.files import Entry, FileSequence, Reading, open_pair
from gavo_jax.datasets.images import MAX_BYTES, read_color, read_depth, white_of, without_invalid
from gavo_jax.datasets.quiet import without_words_on
from gavo_jax.errors import GavoError, GavoWarning

CAMERA = Camera(50.0, 50.0, 31.5, 23.5, 64, 48)
PORTRAIT = Camera(50.0, 50.0, 23.5, 31.5, 48, 64)
RNG = np.random.default_rng(0)
GREY = cv2.GaussianBlur(RNG.integers(0, 256, (48, 64), dtype=np.uint8), (0, 0), 2)
BGR = cv2.GaussianBlur(RNG.integers(0, 256, (48, 64, 3), dtype=np.uint8), (0, 0), 2)
RAW = RNG.integers(2000, 30000, (48, 64), dtype=np.uint16)
METRES = (RAW / 5000).astype(np.float32)


def write(path: Path, image: np.ndarray) -> Path:
    if path.suffix == ".npy":
        np.save(path, image)
    elif path.suffix == ".npz":
        np.savez_compressed(path, image)
    elif path.suffix == ".exr":
        pytest.importorskip("OpenEXR").File({}, {"Z": image}).write(str(path))
    else:
        path.write_bytes(cv2.imencode(path.suffix, image)[1].tobytes())
    return path


def palette_png(indices: np.ndarray, palette: np.ndarray) -> bytes:
    """A PNG whose pixels are indices into a table of RGB."""
    import zlib

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    height, width = indices.shape
    rows = b"".join(b"\0" + row.tobytes() for row in indices)
    header = struct.pack(">IIBBBBB", width, height, 8, 3, 0, 0, 0)
    parts = [(b"IHDR", header), (b"PLTE", palette.tobytes()), (b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*part) for part in parts)


AS_FOUND = Reading()


def read(color: Path, depth: Path, camera: Camera = CAMERA, reading: Reading = AS_FOUND) -> tuple[Frame, Camera]:
    pair = open_pair([(color, depth)], Calibration(camera), reading)
    return pair[0], pair.camera


@pytest.fixture
def depth_file(tmp_path) -> Path:
    return write(tmp_path / "depth.png", RAW)


@pytest.fixture
def color_file(tmp_path) -> Path:
    return write(tmp_path / "color.png", BGR)


@pytest.mark.parametrize("ending", [".png", ".bmp", ".tiff", ".webp", ".ppm", ".jpg", ".npy"])
def test_colour_of_any_format(tmp_path, depth_file, ending):
    image = BGR[..., ::-1] if ending == ".npy" else BGR
    frame, _ = read(write(tmp_path / f"image{ending}", image), depth_file, reading=Reading(color=True))
    expected = cv2.cvtColor(BGR, cv2.COLOR_BGR2GRAY).astype(int)
    tolerance = 12 if ending in (".jpg", ".webp") else 0
    assert np.abs(frame.grey - expected).max() <= tolerance and frame.grey.dtype == np.uint8
    assert frame.color is not None and np.abs(frame.color[..., ::-1].astype(int) - BGR).mean() <= tolerance


@pytest.mark.parametrize(
    ("name", "image"),
    [
        ("8 bits", GREY),
        ("16 bits, full scale", GREY.astype(np.uint16) * 257),
        ("16 bits, 12 used", GREY.astype(np.uint16) * 16),
        ("16 bits, 8 used", GREY.astype(np.uint16)),
        ("alpha", np.dstack([GREY] * 3 + [np.full_like(GREY, 3)])),
        ("16-bit colour", np.dstack([GREY.astype(np.uint16) * 257] * 3)),
    ],
)
@pytest.mark.parametrize("ending", [".png", ".tiff"])
def test_grey_of_any_kind(tmp_path, depth_file, name, image, ending):
    frame, _ = read(write(tmp_path / f"image{ending}", image), depth_file)
    assert np.abs(frame.grey.astype(int) - GREY).max() <= 1, name


def test_palettes_are_looked_up(tmp_path, depth_file):
    palette = RNG.integers(0, 256, (256, 3), dtype=np.uint8)
    (tmp_path / "image.png").write_bytes(palette_png(GREY, palette))
    frame, _ = read(tmp_path / "image.png", depth_file, reading=Reading(color=True))
    assert frame.color is not None
    np.testing.assert_array_equal(frame.color, palette[np.asarray(GREY, int)])


def test_sixteen_bits_are_scaled_alike_in_all_frames_of_a_sequence(tmp_path, depth_file):
    """A frame that happens to be dark must not come brighter than the others."""
    images = [GREY.astype(np.uint16) * scale for scale in (16, 3, 1)]
    files = [write(tmp_path / f"{i}.png", image) for i, image in enumerate(images)]
    entries = [Entry(float(i), file, depth_file) for i, file in enumerate(files)]
    sequence = FileSequence("clip", entries, Calibration(CAMERA))
    for whole, part in ((sequence[1], sequence[1:][0]), (sequence[2], sequence[2:][0])):
        np.testing.assert_array_equal(whole.grey, part.grey)
    assert np.abs(sequence[1].grey - GREY.astype(float) * 3 / 16).max() <= 1
    assert [white_of(image) for image in (images[0], GREY.astype(np.uint16))] == [4095, 255]


def test_images_beyond_the_scale_of_those_that_were_looked_at_first_are_told_once(tmp_path):
    """Depth of a street behind a door was left out, and a bright room white, without a word."""
    files = [write(tmp_path / f"{i}.png", GREY.astype(np.uint16) * (16 if i == 1 else 1)) for i in range(5)]
    depths = [write(tmp_path / f"{i}.npy", METRES * np.float32(4 if i == 1 else 1)) for i in range(5)]
    sequence = FileSequence(
        "far", [Entry(float(i), *both) for i, both in enumerate(zip(files, depths, strict=True))], Calibration(CAMERA)
    )
    with pytest.warns(GavoWarning) as told:
        frame = sequence[1]
    words = [str(warning.message) for warning in told]
    assert len(words) == 2 and all("1." in line for line in words)
    assert "values above 255 become white" in words[0] and "depth beyond 13.1 m is left out" in words[1]
    assert not frame.depth[METRES * 4 > 13.2].any()
    _ = sequence[1], sequence[2]


@pytest.mark.parametrize("ending", [".png", ".tiff", ".npy", ".pgm"])
def test_depth_of_sixteen_bits_is_taken_as_it_is(tmp_path, color_file, ending):
    frame, camera = read(color_file, write(tmp_path / f"depth{ending}", RAW))
    np.testing.assert_array_equal(frame.depth, RAW)
    assert frame.depth.dtype == np.uint16 and camera.depth_scale == 5000


@pytest.mark.parametrize("ending", [".tiff", ".npy", ".npz", ".pfm", ".exr"])
@pytest.mark.parametrize("units", [1.0, 1000.0])
def test_depth_of_floats_in_metres_or_millimetres(tmp_path, color_file, ending, units):
    """A preset's depth_scale speaks of its PNG files and is not asked."""
    depth = write(tmp_path / f"depth{ending}", METRES * np.float32(units))
    pair = open_pair([(color_file, depth)], Calibration(CAMERA, preset="fr1"))
    np.testing.assert_array_equal(pair[0].depth, RAW)
    assert pair.camera.depth_scale == 5000


@pytest.mark.parametrize("dtype", [np.float16, np.float64, np.int32, np.uint32, ">f4", ">u2"])
def test_arrays_of_any_numbers_are_depth(tmp_path, color_file, dtype):
    values = METRES if np.dtype(dtype).kind == "f" else RAW // 5
    frame, camera = read(
        color_file, write(tmp_path / "depth.npy", values.astype(dtype)), replace(CAMERA, depth_scale=1e3)
    )
    metres = frame.depth / camera.depth_scale
    assert np.abs(metres - (values if np.dtype(dtype).kind == "f" else values / 1000)).max() < 3e-3


@pytest.mark.parametrize("scale", [b"1.0", b"-1", b"-0.003922", b"-5e-3", b"5e3"])
def test_a_pfm_has_the_numbers_that_stand_in_it(tmp_path, scale):
    """OpenCV divides them by its scale, of which nobody else takes more than the sign, for the order of its bytes."""
    numbers = METRES[::-1].astype("<f4" if scale.startswith(b"-") else ">f4")
    (tmp_path / "depth.pfm").write_bytes(b"Pf\n64 48\n%s\n" % scale + numbers.tobytes())
    np.testing.assert_array_equal(read_depth(tmp_path / "depth.pfm"), METRES)


@pytest.mark.parametrize("axis", [0, 2])
def test_an_array_of_depth_may_have_an_axis_of_one_channel(tmp_path, axis):
    np.save(tmp_path / "depth.npy", np.expand_dims(METRES, axis))
    np.testing.assert_array_equal(read_depth(tmp_path / "depth.npy"), METRES)


def test_of_several_arrays_one_is_named_depth(tmp_path):
    np.savez(tmp_path / "depth.npz", depth=METRES, confidence=RAW)
    np.testing.assert_array_equal(read_depth(tmp_path / "depth.npz"), METRES)
    np.savez(tmp_path / "depth.npz", a=METRES, b=RAW)
    with pytest.raises(FrameError, match=r"depth\.npz: .* named depth: found a\.npy, b\.npy"):
        read_depth(tmp_path / "depth.npz")


def test_a_tiff_of_floats_of_16_bits_is_refused_for_what_it_is(tmp_path):
    tags = ((256, 64), (257, 48), (258, 16), (259, 1), (262, 1), (273, 8), (277, 1), (278, 48), (279, 6144), (339, 3))
    table = struct.pack("<H", len(tags)) + b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags)
    head = b"II*\0" + struct.pack("<I", 8 + 6144)
    (tmp_path / "depth.tif").write_bytes(head + METRES.astype("<f2").tobytes() + table + bytes(4))
    with pytest.raises(FrameError, match=r"depth\.tif: a TIFF of 16-bit floats, .*: write 32 bits, or \.npy"):
        read_depth(tmp_path / "depth.tif")


def test_wide_integers_of_16_bits_are_those(tmp_path):
    """65535 among them is no reading, as it is in an image of 16 bits."""
    wide = RAW.astype(np.int64)
    wide[0, :3] = -1, 0, 65535
    found = read_depth(write(tmp_path / "depth.npy", wide))
    assert found.dtype == np.uint16 and found[0, :3].tolist() == [0, 0, 65535]
    wide[0, 0] = 70000
    assert read_depth(write(tmp_path / "depth.npy", wide)).dtype == np.float32


EXR = {
    "one": ({"V": METRES}, None),
    "grey": ({"RGB": np.dstack([METRES] * 3)}, None),
    "grey with NaN": ({"RGB": np.dstack([np.where(METRES > 2, np.nan, METRES)] * 3)}, None),
    "beside colour": ({"RGBA": np.dstack([METRES * 0] * 4), "Z": METRES}, None),
    "of a layer": ({**{f"View.Combined.{c}": METRES * 0 for c in "RGB"}, "View.Depth.Z": METRES}, None),
    "of a word": ({"RGB": np.dstack([METRES * 0] * 3), "Depth.V": METRES}, None),
    "colour": ({"RGB": np.dstack([METRES, METRES * 0, METRES])}, "a colour OpenEXR image"),
    "several": ({"U": METRES, "V": METRES}, "has to be depth, named Z: found U, V"),
}


@pytest.mark.parametrize("name", EXR)
def test_the_channel_of_depth_is_found_by_its_name(tmp_path, name):
    channels, fault = EXR[name]
    library, path = pytest.importorskip("OpenEXR"), tmp_path / "depth.exr"
    library.File({}, {key: np.ascontiguousarray(pixels) for key, pixels in channels.items()}).write(str(path))
    if fault is None:
        found = read_depth(path)
        np.testing.assert_array_equal(found, np.where(np.isnan(found), found, METRES))
        return
    with pytest.raises(FrameError, match=fault):
        read_depth(path)


def test_the_unit_of_floats_can_be_said(tmp_path, color_file):
    inches = write(tmp_path / "depth.npy", METRES / np.float32(0.0254))
    frame, camera = read(color_file, inches, reading=Reading(depth_scale=1 / 0.0254))
    assert np.abs(frame.depth / camera.depth_scale - METRES).max() < 1e-3
    frame, camera = read(color_file, inches, replace(CAMERA, depth_scale=1 / 0.0254))
    assert np.abs(frame.depth / camera.depth_scale - METRES).max() < 1e-3


def test_floats_beside_whole_numbers_are_in_no_common_unit(tmp_path, color_file):
    pair = [(color_file, write(tmp_path / name, raw)) for name, raw in (("a.npy", METRES), ("b.png", RAW))]
    with pytest.raises(GavoError, match=r"b\.png: depth in whole numbers, but floats in .*a\.npy.*--depth-scale"):
        open_pair(pair, Calibration(CAMERA))[0]
    pair[1] = color_file, write(tmp_path / "none.png", np.zeros_like(RAW))
    assert open_pair(pair, Calibration(CAMERA))[0].depth.any()


@pytest.mark.parametrize("is_float", [True, False])
def test_one_image_of_another_kind_of_numbers_has_no_unit(tmp_path, color_file, is_float):
    """It is not among those that are looked at first: metres counted as millimetres lay 3 mm before the camera."""
    kinds = [write(tmp_path / "metres.npy", METRES + np.float32(0.0123)), write(tmp_path / "whole.png", RAW)]
    pairs = [(color_file, kinds[is_float if i == 1 else not is_float]) for i in range(5)]
    sequence = open_pair(pairs, Calibration(CAMERA))
    assert sequence[0].depth.any()
    with pytest.raises(
        FrameError, match="(whole.png: depth in whole numbers, but in floats|metres.npy: .* in fl.*whole) "
    ):
        sequence[1]
    assert open_pair(pairs, Calibration(CAMERA), Reading(depth_scale=1.0))[1].depth is not None


def test_whole_numbers_beyond_16_bits_are_in_the_unit_of_the_others(tmp_path, color_file):
    beyond = RAW.astype(np.int32)
    beyond[0, :30] = 2**31 - 1
    for first in (RAW.astype(np.int32), beyond):
        arrays = [write(tmp_path / "a.npy", first), write(tmp_path / "b.npy", beyond)]
        sequence = open_pair([(color_file, arrays[i == 1]) for i in range(5)], Calibration(CAMERA))
        metres = [frame.depth[1:] / sequence.camera.depth_scale for frame in sequence]
        np.testing.assert_allclose(metres[1], metres[0], atol=1e-3)


def test_floats_that_were_scaled_to_the_farthest_are_refused(tmp_path, color_file):
    """As simulators give them, and tools that draw depth; in metres nothing was farther than one."""
    scaled = write(tmp_path / "depth.npy", METRES / METRES.max())
    silent = Calibration(CAMERA, states_depth_scale=False)
    with pytest.raises(
        GavoError, match="depth.npy: the largest depth is exactly 1, .* scaled .*: pass --depth-scale, in"
    ):
        open_pair([(color_file, scaled)], silent)[0]
    sequence = open_pair([(color_file, scaled)], silent, Reading(depth_scale=1 / float(METRES.max())))
    assert np.abs(sequence[0].depth / sequence.camera.depth_scale - METRES).max() < 1e-3


@pytest.mark.parametrize("far", [10.0, float(METRES.max())])
def test_a_buffer_of_a_renderer_is_refused(tmp_path, color_file, far):
    """As OpenGL keeps depth, of PyBullet and MuJoCo: it was taken for metres, of a wall at one."""
    near = np.float32(0.02)
    buffer = write(tmp_path / "depth.npy", ((far - near * far / METRES) / (far - near)).astype(np.float32))
    silent = Calibration(CAMERA, states_depth_scale=False)
    with pytest.raises(
        GavoError, match=r"depth.npy: depth of 0\.9.* to .* looks like a z-buffer, .* --depth-scale 1 if"
    ):
        open_pair([(color_file, buffer)], silent)[0]
    assert open_pair([(color_file, buffer)], silent, Reading(depth_scale=1.0))[0].depth.any()


def test_far_floats_get_a_coarser_unit(tmp_path, color_file):
    frame, camera = read(color_file, write(tmp_path / "depth.npy", METRES * 8))
    assert camera.depth_scale == 1000
    assert np.abs(frame.depth / 1000 - METRES * 8).max() <= 0.0006


def test_floats_in_no_likely_unit_are_refused(tmp_path, color_file):
    depth = write(tmp_path / "depth.npy", METRES * np.float32(1e6))
    with pytest.raises(GavoError, match=r"depth\.npy: .*--depth-scale"):
        read(color_file, depth)


def test_what_is_no_reading_is_zero(tmp_path, color_file):
    raw = RAW.copy()
    raw[0, :3] = 0, 65535, 65534
    np.testing.assert_array_equal(without_invalid(raw)[0, :3], [0, 0, 65534])
    metres = METRES.copy()
    metres[0, :6] = np.nan, np.inf, -np.inf, -1, 0, 14.0
    frame, _ = read(color_file, write(tmp_path / "depth.npy", metres))
    np.testing.assert_array_equal(frame.depth[0, :6], 0)
    np.testing.assert_array_equal(frame.depth[1:], RAW[1:])


def test_portrait_images_of_any_size(tmp_path):
    color, depth = write(tmp_path / "color.jpg", BGR.transpose(1, 0, 2)), write(tmp_path / "depth.png", RAW.T)
    frame, _ = read(color, depth, PORTRAIT)
    np.testing.assert_array_equal(frame.depth, RAW.T)
    assert frame.grey.shape == (64, 48)
    with pytest.raises(FrameError, match=r"color\.jpg: is 48x64 pixels, but the camera's images are 64x48"):
        read(color, depth, CAMERA)


JPEG, TIFF = cv2.imencode(".jpg", BGR)[1].tobytes(), cv2.imencode(".tiff", METRES)[1].tobytes()
BAD = {
    "color.jpg": [
        JPEG[:11] + b"\x07" + JPEG[12 : len(JPEG) // 2],
        JPEG[: len(JPEG) // 2],
        JPEG[:-2],
        b"",
        b"\xff\xd8\xff",
    ],
    "color.webp": [cv2.imencode(".webp", BGR)[1].tobytes()[:-100]],
    "color.gif": [b"GIF89a"],
    "color.tiff": [TIFF],
    "color.txt": [b"hello"],
    "color.npy": [b"\x93NUMPY", b"\x93NUMPY\x01\0\x0e\0{'descr':('|O \n", b"\x93NUMPY\x01\0\x0e\0{'descr':'|O'}\n"],
    "depth.tiff": [TIFF[:5000], cv2.imencode(".tiff", BGR)[1].tobytes()],
    "depth.jpg": [JPEG],
    "depth.png": [cv2.imencode(".png", GREY)[1].tobytes()],
    "depth.exr": [b"\x76\x2f\x31\x01" + bytes(100)],
    "depth.npy": [b"\x93NUMPY\x01\0v\0{'descr': '<f4', 'fortran_order': False, 'shape': (4, 4), }" + b" " * 60 + b"\n"],
}


@pytest.mark.parametrize(("name", "content"), [(name, content) for name in BAD for content in BAD[name]])
def test_what_cannot_be_read_is_refused_in_one_line(tmp_path, capfd, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(FrameError) as caught:
        (read_color if name.startswith("color") else read_depth)(tmp_path / name)
    message = str(caught.value)
    assert message.startswith(str(tmp_path / name)) and len(message.splitlines()) == 1 and len(message) < 400
    assert capfd.readouterr() == ("", "")


TORN = (".png", ".jpg", ".tiff", ".webp", ".jp2", ".bmp", ".ppm", ".npy", ".npz", ".exr")


@pytest.mark.parametrize("keep", [0.3, 0.6, 0.97])
@pytest.mark.parametrize("ending", TORN)
def test_a_torn_image_is_one_line_and_its_library_says_nothing(tmp_path, capfd, ending, keep):
    """Neither on standard error nor, as OpenEXR does, on standard output, where a program reads JSON."""
    path = tmp_path / f"image{ending}"
    reads_depth = ending in (".npy", ".npz", ".exr")
    write(path, METRES if reads_depth else BGR)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(keep * len(whole))])
    capfd.readouterr()
    with pytest.raises(FrameError) as caught:
        (read_depth if reads_depth else read_color)(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ") and str(tmp_path) in message and "/tmp" not in message.replace(str(path), "")
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("options", [[], [cv2.IMWRITE_JPEG_RST_INTERVAL, 2]])
def test_a_jpeg_whose_middle_is_damaged_is_not_made_up(tmp_path, capfd, options):
    """Cut and closed, or overwritten by zeros: libjpeg fills the rest with grey, and prints a line of its own."""
    whole = cv2.imencode(".jpg", np.tile(BGR, (8, 8, 1)), options)[1].tobytes()
    middle = len(whole) // 2
    for content in (whole[:middle] + b"\xff\xd9", whole[:middle] + bytes(3000) + whole[middle + 3000 :]):
        (tmp_path / "color.jpg").write_bytes(content)
        with pytest.raises(FrameError, match=r"color\.jpg: .*damaged.*image"):
            read_color(tmp_path / "color.jpg")
    assert capfd.readouterr() == ("", "")


def test_bytes_too_many_at_the_end_of_a_jpeg_are_no_damage(tmp_path, capfd):
    """As cameras leave them there."""
    (tmp_path / "color.jpg").write_bytes(JPEG[:-2] + bytes(3) + JPEG[-2:] + bytes(20))
    np.testing.assert_array_equal(
        read_color(tmp_path / "color.jpg"), cv2.imdecode(np.frombuffer(JPEG, np.uint8), cv2.IMREAD_COLOR)
    )
    assert capfd.readouterr() == ("", "")


def test_what_others_say_while_a_library_is_kept_quiet_is_not_lost(capfd):
    with without_words_on("/x.exr"):
        os.write(2, b"/x.exr: torn\nmine\n")
        print("Warning: Exception raised reading pixel data\nmine, too")
    assert capfd.readouterr() == ("mine, too\n", "mine\n")


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are not forked here")
def test_damage_is_told_in_threads_and_in_processes_that_are_forked_from_them(tmp_path):
    """Each has its own words of the library: a fork in the middle of an image neither waits for ever nor mixes them."""
    large = cv2.imencode(".jpg", np.tile(BGR, (8, 8, 1)))[1].tobytes()
    (tmp_path / "whole.jpg").write_bytes(large)
    (tmp_path / "torn.jpg").write_bytes(large[: len(large) // 2] + b"\xff\xd9")
    code = (
        "import os, sys, threading\n"
        "from gavo_jax.datasets.base import FrameError\n"
        "from gavo_jax.datasets.images import read_color\n"
        "def both(times):\n"
        "    for _ in range(times):\n"
        "        read_color('whole.jpg')\n"
        "        try:\n"
        "            read_color('torn.jpg')\n"
        "        except FrameError:\n"
        "            continue\n"
        "        os._exit(1)\n"
        "threads = [threading.Thread(target=both, args=(100,)) for _ in range(3)]\n"
        "for thread in threads: thread.start()\n"
        "for _ in range(20):\n"
        "    child = os.fork()\n"
        "    if not child:\n"
        "        both(3)\n"
        "        os._exit(0)\n"
        "    assert os.waitpid(child, 0)[1] == 0\n"
        "for thread in threads: thread.join()\n"
    )
    command = [sys.executable, "-W", "ignore", "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_tag_that_turns_a_tiff_turns_neither_image(tmp_path, orientation):
    """OpenCV turns no other kind of file here: depth would lie otherwise than its colour."""
    whole = cv2.imencode(".tiff", RAW)[1].tobytes()
    samples_of_one, tag = struct.pack("<HHI", 277, 3, 1), struct.pack("<HHIH", 274, 3, 1, orientation)
    at = whole.index(samples_of_one, struct.unpack_from("<I", whole, 4)[0])
    (tmp_path / "depth.tiff").write_bytes(whole[:at] + tag + whole[at + len(tag) :])
    np.testing.assert_array_equal(read_depth(tmp_path / "depth.tiff"), RAW)


@pytest.mark.parametrize("target", ["closed", "/dev/full"])
def test_a_standard_error_that_takes_nothing_is_no_fault_of_the_image(tmp_path, target):
    (tmp_path / "color.jpg").write_bytes(JPEG)
    code = (
        "import os, sys\n"
        "from gavo_jax.datasets import images, quiet\n"
        "os.close(2) if sys.argv[1] == 'closed' else os.dup2(os.open(sys.argv[1], os.O_WRONLY), 2)\n"
        "with quiet.without_words_on('x'):\n"
        "    os.write(2, b'another library\\n')\n"
        "print(images.read_color(sys.argv[2]).shape)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, target, str(tmp_path / "color.jpg")], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0 and done.stdout == "(48, 64, 3)\n"


def test_arrays_of_other_things_are_refused(tmp_path):
    for array in (
        np.zeros(5),
        np.zeros((2, 2), complex),
        np.zeros((0, 4)),
        np.zeros((2, 2), "U3"),
        np.zeros((1, 9000)),
    ):
        np.save(tmp_path / "depth.npy", array)
        with pytest.raises(FrameError, match=r"depth\.npy: not an image"):
            read_depth(tmp_path / "depth.npy")


def test_grey_arrays_may_have_a_third_axis(tmp_path):
    np.testing.assert_array_equal(read_color(write(tmp_path / "grey.npy", BGR[..., :1])), np.dstack([BGR[..., 0]] * 3))
    for shape in ((3, 48, 64), (48, 64, 2)):
        with pytest.raises(FrameError, match=f"found {shape[-1]} channels of 8 bits"):
            read_color(write(tmp_path / "odd.npy", np.zeros(shape, np.uint8)))


def test_openexr_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    (tmp_path / "depth.exr").write_bytes(b"\x76\x2f\x31\x01" + bytes(100))
    with pytest.raises(FrameError, match=r"\[exr\]"):
        read_depth(tmp_path / "depth.exr")


def test_huge_files_and_images_are_refused_unread(tmp_path):
    with (tmp_path / "huge.png").open("wb") as file:
        file.truncate(MAX_BYTES + 1)
    with pytest.raises(FrameError, match="larger than"):
        read_color(tmp_path / "huge.png")
    write(tmp_path / "wide.png", np.zeros((4, 8200), np.uint8))
    write(tmp_path / "wide.bmp", np.zeros((4, 8200), np.uint8))
    for name in ("wide.png", "wide.bmp"):
        with pytest.raises(FrameError, match="8200x4"):
            read_color(tmp_path / name)


def test_one_file_is_not_both_images(color_file):
    with pytest.raises(GavoError, match="both colour and depth"):
        read(color_file, color_file)


@given(
    content=st.binary(max_size=300),
    start=st.sampled_from([JPEG, TIFF, b"II*\0", b"RIFF", b"P5 9 9 ", b"\x93NUMPY\x01\0"]),
)
def test_no_content_raises_anything_else(tmp_path_factory, content, start):
    path = tmp_path_factory.mktemp("image") / "image"
    path.write_bytes(start[: len(start) // 2 + 4] + content)
    for reader in (read_color, read_depth):
        try:
            assert reader(path).ndim >= 2
        except FrameError as error:
            assert len(str(error).splitlines()) == 1
