"""TUM folders: association, decoding and what is refused when."""

import shutil
import tracemalloc
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gavo_jax.camera import Camera
from gavo_jax.camera_files.calibration import Calibration
from gavo_jax.datasets.base import Frame, FrameError, Sequence, TimestampError
from gavo_jax.datasets.files import open_pair
from gavo_jax.datasets.layouts.tum import TumSequence
from gavo_jax.errors import GavoError
from gavo_jax.trajectory import Trajectory

CAMERA = Camera(50.0, 50.0, 31.5, 23.5, 64, 48)
STAMPS = [100.0 + i / 30 for i in range(6)]


def png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


def color_image(i: int) -> np.ndarray:
    return np.random.default_rng(i).integers(0, 256, (48, 64, 3), dtype=np.uint8)


def depth_image(i: int) -> np.ndarray:
    return np.random.default_rng(100 + i).integers(0, 30000, (48, 64), dtype=np.uint16)


@pytest.fixture
def folder(tmp_path) -> Path:
    """Six frames of 64×48 pixels, depth 5 ms after colour, with ground truth."""
    folder = tmp_path / "clip"
    for kind in ("rgb", "depth"):
        (folder / kind).mkdir(parents=True)
    rgb, depth = ["# colour"], ["# depth"]
    for i, stamp in enumerate(STAMPS):
        (folder / f"rgb/{i}.png").write_bytes(png(color_image(i)))
        (folder / f"depth/{i}.png").write_bytes(png(depth_image(i)))
        rgb.append(f"{stamp:.6f} rgb/{i}.png")
        depth.append(f"{stamp + 0.005:.6f} depth/{i}.png")
    (folder / "rgb.txt").write_text("\n".join(rgb) + "\n")
    (folder / "depth.txt").write_text("\n".join(depth) + "\n")
    Trajectory(np.array(STAMPS), np.tile(np.eye(4), (6, 1, 1))).write_tum(folder / "groundtruth.txt")
    return folder


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def test_a_unit_that_nobody_says_is_a_guess(folder):
    """A recorder of another camera writes millimetres: the run took 5000 per metre for known."""
    numbers = "fx = 50.0\nfy = 50.0\ncx = 31.5\ncy = 23.5\nwidth = 64\nheight = 48\n"
    (folder / "camera.toml").write_text(numbers)
    assert TumSequence(folder).unit_is_assumed
    (folder / "camera.toml").write_text(numbers + "depth_scale = 1000.0\n")
    assert not TumSequence(folder).unit_is_assumed and not TumSequence(folder, "fr1").unit_is_assumed


def test_lists_may_count_ticks_of_windows(folder):
    for name in ("rgb.txt", "depth.txt"):
        lines = [line.split() for line in (folder / name).read_text().splitlines()[1:]]
        ticks = [f"{round(1e7 * (1.6e9 + float(stamp))) + 116444736000000000} {path}" for stamp, path in lines]
        (folder / name).write_text("\n".join(ticks) + "\n")
    np.testing.assert_allclose(TumSequence(folder, CAMERA).timestamps, 1.6e9 + np.array(STAMPS), atol=1e-5)


def test_the_list_of_colour_may_be_called_so(folder):
    (folder / "rgb.txt").rename(folder / "color.txt")
    assert len(TumSequence(folder, CAMERA)) == len(STAMPS)


def test_frames_come_as_written(folder):
    sequence: Sequence = TumSequence(folder, CAMERA, color=True)
    sequence.check()
    assert sequence.name == "clip" and len(sequence) == 6 and sequence.camera == CAMERA
    np.testing.assert_allclose(sequence.timestamps, STAMPS, atol=1e-6)
    for i, frame in enumerate(sequence):
        assert isinstance(frame, Frame) and frame.timestamp == sequence.timestamps[i]
        np.testing.assert_array_equal(frame.depth, depth_image(i))
        assert frame.color is not None
        np.testing.assert_array_equal(frame.color, color_image(i)[..., ::-1])
        np.testing.assert_allclose(frame.grey, color_image(i) @ [0.114, 0.587, 0.299], atol=1)
        assert frame.grey.dtype == np.uint8 and frame.depth.dtype == np.uint16
    truth = sequence.ground_truth
    assert truth is not None and len(truth) == 6


def test_asking_for_colour_changes_nothing_else(folder):
    plain, colored = TumSequence(folder, CAMERA)[2], TumSequence(folder, CAMERA, color=True)[2]
    assert plain.color is None
    np.testing.assert_array_equal(plain.grey, colored.grey)


def test_slices_are_sequences(folder):
    sequence = TumSequence(folder, CAMERA, name="mine")
    part = sequence[1:6:2]
    assert isinstance(part, TumSequence) and len(part) == 3
    assert (part.name, part.camera, part.ground_truth) == ("mine", CAMERA, sequence.ground_truth)
    np.testing.assert_array_equal(part.timestamps, sequence.timestamps[1:6:2])
    np.testing.assert_array_equal(part[1:][0].depth, depth_image(3))
    np.testing.assert_array_equal(part[-1].depth, depth_image(5))
    assert len(sequence) == 6
    for index in (3, -4):
        with pytest.raises(IndexError):
            part[index]
    with pytest.raises(GavoError, match="no frames"):
        sequence[6:].check()


def test_association_is_one_to_one_and_in_the_order_of_colour_stamps(folder):
    """A depth image is used once, by its nearest colour image, whatever the order of the lists."""
    (folder / "rgb.txt").write_text(
        "3.000 rgb/3.png\n1.000 rgb/0.png\n1.012 rgb/1.png\n2.000 rgb/2.png\n1.012 rgb/5.png\n"
    )
    (folder / "depth.txt").write_text("1.010 depth/1.png\n3.019 depth/3.png\n2.020 depth/2.png\n")
    sequence = TumSequence(folder, CAMERA, color=True)
    np.testing.assert_array_equal(sequence.timestamps, [1.012, 3.0])
    assert sequence[0].color is not None
    np.testing.assert_array_equal(sequence[0].color[..., ::-1], color_image(1))
    np.testing.assert_array_equal(sequence[0].depth, depth_image(1))
    np.testing.assert_array_equal(sequence[1].depth, depth_image(3))


def test_images_of_stamps_that_were_cut_short_are_left_out_and_counted(folder):
    """Two of three images went without a word where stamps had one decimal. A row that appears twice is no image."""
    for kind in ("rgb", "depth"):
        rows = [f"{100 + i // 3 / 10:.1f} {kind}/{i}.png" for i in range(6)]
        (folder / f"{kind}.txt").write_text("\n".join(rows + rows) + "\n")
    sequence = TumSequence(folder, CAMERA)
    np.testing.assert_allclose(sequence.timestamps, [100.0, 100.1])
    assert sequence.left_out == tuple(f"4 {kind} images: the same stamp as another one" for kind in ("colour", "depth"))


@pytest.mark.parametrize("kind", ["rgb", "depth"])
@pytest.mark.parametrize(
    ("stamps", "in_doubt"),
    [
        ({7: -0.05}, [6, 7]),
        ({7: 0.0}, [6, 7]),
        ({7: -0.4}, [7]),
        ({4: -0.15, 9: -0.15}, [4, 9]),
    ],
    ids=str,
)
def test_a_few_stamps_out_of_order_are_in_doubt(folder, kind, stamps, in_doubt):
    """Rows whose stamps do not fit the others', both where either may be the wrong one, are told and spoil no other."""
    rows = {"rgb": [], "depth": []}
    for i in range(12):
        for part, wrong in (("rgb", kind == "rgb"), ("depth", kind == "depth")):
            stamp = 100 + i / 10
            if wrong and i in stamps:
                stamp = 100 + (i - 1) / 10 + stamps[i]
            rows[part].append(f"{stamp:.6f} {part}/{i % 6}.png")
    for part, lines in rows.items():
        (folder / f"{part}.txt").write_text("\n".join(lines) + "\n")
    sequence = TumSequence(folder, CAMERA)
    sequence.check()
    good, bad = [], []
    for i, stamp in enumerate(sequence.timestamps):
        try:
            good.append(round((sequence[i].timestamp - 100) * 10))
        except TimestampError as error:
            assert f"{kind}.txt:" in str(error)
            bad.append(stamp)
    assert good == [i for i in range(12) if i not in in_doubt]
    assert len(bad) == len(in_doubt) or kind == "depth"
    assert np.all(np.diff(sequence.timestamps) >= 0)


COUNTS = {
    "nanoseconds": (1305031102175304000, 33333333, 1305031102.175304, 30.0),
    "milliseconds": (1305031102175, 33, 1305031102.175, 30.3),
    "microseconds since switched on": (123456789, 33333, 123.456789, 30.0),
    "numbers of frames": (7, 1, 7 / 30, 30.0),
    "whole seconds": (1305031102, 1, 1305031102.0, 1.0),
}


@pytest.mark.parametrize("name", COUNTS)
@pytest.mark.parametrize("form", ["two lists", "associate.txt"])
def test_stamps_that_are_whole_numbers_count_what_gives_a_cameras_rate(folder, name, form):
    first, step, seconds, rate = COUNTS[name]
    stamps = [first + i * step for i in range(6)]
    late = 400 if step > 1000 else 0  # of depth, in the same unit
    if form == "two lists":
        for kind, off in (("rgb", 0), ("depth", late)):
            rows = [f"{stamp + off} {kind}/{i}.png" for i, stamp in enumerate(stamps)]
            (folder / f"{kind}.txt").write_text("\n".join(rows) + "\n")
    else:
        for kind in ("rgb", "depth"):
            (folder / f"{kind}.txt").unlink()
        rows = [f"{stamp + late} depth/{i}.png {stamp} rgb/{i}.png" for i, stamp in enumerate(stamps)]
        (folder / form).write_text("\n".join(rows) + "\n")
    (folder / "groundtruth.txt").write_text("\n".join(f"{stamp} 0 0 0 0 0 0 1" for stamp in stamps[:2]) + "\n")
    sequence = TumSequence(folder, CAMERA)
    np.testing.assert_allclose(sequence.timestamps[0], seconds, atol=1e-6)
    np.testing.assert_allclose(np.diff(sequence.timestamps), 1 / rate, rtol=1e-3)
    if sequence.ground_truth is not None:
        np.testing.assert_allclose(sequence.ground_truth.timestamps, sequence.timestamps[:2], atol=1e-6)
    if form == "two lists" and name == "numbers of frames":
        np.testing.assert_allclose(np.diff(TumSequence(folder, CAMERA, rate=10.0).timestamps), 0.1)


@pytest.mark.parametrize("rate", [None, 15.0])
def test_lists_numbered_from_other_numbers_are_refused(folder, rate):
    """Whether they pair by number or by order is not known; by number, drift grew by two thirds."""
    for kind, first in (("rgb", 0), ("depth", 1)):
        rows = [f"{first + i} {kind}/{i % 6}.png" for i in range(12)]
        (folder / f"{kind}.txt").write_text("\n".join(rows) + "\n")
    with pytest.raises(GavoError, match=r"colour images are 0 to 11, depth images 1 to 12: give those of one frame"):
        TumSequence(folder, CAMERA, rate=rate)


@pytest.mark.parametrize("offset", [0.033, -0.1, 10.0])
@pytest.mark.parametrize("depth_first", [False, True])
def test_pairs_that_a_list_says_are_frames_whatever_the_clock_of_depth(folder, offset, depth_first):
    """They were paired anew, each with the depth of another frame."""
    rows = []
    for i, stamp in enumerate(STAMPS):
        pair = [f"{stamp:.6f} rgb/{i}.png", f"{stamp + offset:.6f} depth/{i}.png"]
        rows.append(" ".join(pair[::-1] if depth_first else pair))
    for kind in ("rgb", "depth"):
        (folder / f"{kind}.txt").unlink()
    (folder / "associations.txt").write_text("\n".join(rows))
    sequence = TumSequence(folder, CAMERA)
    np.testing.assert_allclose(sequence.timestamps, STAMPS)
    assert sequence.left_out == ()
    for i in range(len(STAMPS)):
        np.testing.assert_array_equal(sequence[i].depth, depth_image(i))
        assert sequence[i].depth_timestamp is None


def test_a_stamp_out_of_order_in_a_list_of_pairs_puts_its_frame_in_doubt(folder):
    rows = [f"{stamp:.6f} rgb/{i}.png {stamp + 0.004:.6f} depth/{i}.png" for i, stamp in enumerate(STAMPS)]
    rows[3] = rows[3].replace(f"{STAMPS[3] + 0.004:.6f}", f"{STAMPS[0]:.6f}")
    for kind in ("rgb", "depth"):
        (folder / f"{kind}.txt").unlink()
    (folder / "associations.txt").write_text("\n".join(rows))
    sequence = TumSequence(folder, CAMERA)
    assert len(sequence) == len(STAMPS) and sequence[2].depth_timestamp == pytest.approx(STAMPS[2] + 0.004)
    with pytest.raises(TimestampError, match=r"associations\.txt:4: stamp .* out of order"):
        sequence[3]


def test_lists_may_begin_with_the_names_of_their_columns(folder):
    """As pandas writes them."""
    for kind in ("rgb", "depth"):
        rows = [row.replace(" ", ",") for row in (folder / f"{kind}.txt").read_text().splitlines()[1:]]
        (folder / f"{kind}.txt").write_text("\n".join(["timestamp,filename", *rows]) + "\n")
    np.testing.assert_allclose(TumSequence(folder, CAMERA).timestamps, STAMPS)


@pytest.mark.parametrize("layout", ["two lists", "one list"])
def test_zeros_that_are_missing_after_the_point_are_filled_in(folder, layout):
    """Whole seconds and the rest printed one after the other: 102.008 s is 102.8000."""
    times = [1305031102.966 + i * 0.03339 for i in range(6)]
    wrong, right = ([f"{int(t)}.{round(t % 1 * 1e6):{form}}" for t in times] for form in ("", "06"))
    assert wrong[2:] != right[2:]
    for stamps in (wrong, right):
        if layout == "one list":
            rows = [f"{stamp} rgb/{i}.png {stamp} depth/{i}.png" for i, stamp in enumerate(stamps)]
            (folder / "associations.txt").write_text("\n".join(rows))
            (folder / "rgb.txt").unlink(missing_ok=True)
            (folder / "depth.txt").unlink(missing_ok=True)
        else:
            for kind in ("rgb", "depth"):
                rows = [f"{stamp} {kind}/{i}.png" for i, stamp in enumerate(stamps)]
                (folder / f"{kind}.txt").write_text("\n".join(rows))
        sequence = TumSequence(folder, CAMERA)
        np.testing.assert_allclose(sequence.timestamps, times, rtol=0, atol=1e-6)
        np.testing.assert_array_equal(sequence[3].depth, depth_image(3))


def test_zeros_that_are_missing_at_the_end_are_not(folder):
    times = [100.3, 100.33, 100.37, 100.4, 100.43, 100.47]
    for kind in ("rgb", "depth"):
        (folder / f"{kind}.txt").write_text("\n".join(f"{t} {kind}/{i}.png" for i, t in enumerate(times)))
    np.testing.assert_array_equal(TumSequence(folder, CAMERA).timestamps, times)


@pytest.mark.parametrize(("first", "step", "unit"), [(123456.789, 33.3, 1e-3), (1305031102.5, 12.5, 1.0)])
def test_milliseconds_may_have_decimals(folder, first, step, unit):
    stamps = [first + i * step for i in range(6)]
    for kind in ("rgb", "depth"):
        rows = [f"{stamp:.3f} {kind}/{i}.png" for i, stamp in enumerate(stamps)]
        (folder / f"{kind}.txt").write_text("\n".join(rows))
    np.testing.assert_allclose(TumSequence(folder, CAMERA).timestamps, unit * np.array(stamps), rtol=0, atol=1e-6)


def test_milliseconds_with_decimals_are_refused(folder):
    for kind in ("rgb", "depth"):
        edit(folder / f"{kind}.txt", "\n100.", "\n1305031102175.")
    with pytest.raises(GavoError, match=r"rgb\.txt:2: not a time stamp: 1305031102175.*expected seconds"):
        TumSequence(folder, CAMERA)


def test_a_missing_ground_truth_is_none(folder):
    (folder / "groundtruth.txt").unlink()
    assert TumSequence(folder, CAMERA).ground_truth is None


def test_auto_camera_follows_the_folder_name(folder):
    with pytest.raises(GavoError, match="--camera"):
        TumSequence(folder)
    renamed = folder.rename(folder.with_name("rgbd_dataset_freiburg3_clip"))
    assert TumSequence(renamed).camera == Camera.preset("fr3")
    (folder.parent / "link").symlink_to(renamed)
    assert TumSequence(folder.parent / "link").camera == Camera.preset("fr3")
    assert TumSequence(renamed, "fr1").camera == Camera.preset("fr1").rectified()


def test_undistortion_belongs_to_the_sequence(folder):
    lens = Camera(50.0, 50.0, 31.5, 23.5, 64, 48, (0.3, 0.0, 0.0, 0.0, 0.0))
    sequence = TumSequence(folder, lens)
    assert sequence.camera == CAMERA
    grey, depth = lens.undistort(TumSequence(folder, CAMERA)[0].grey, depth_image(0))
    np.testing.assert_array_equal(sequence[0].grey, grey)
    np.testing.assert_array_equal(sequence[0].depth, depth)
    assert (depth == 0).mean() > 0.1
    raw = TumSequence(folder, lens, undistort=False)
    assert raw.camera == lens
    np.testing.assert_array_equal(raw[0].depth, depth_image(0))


@pytest.mark.parametrize(
    ("damage", "fault"),
    [
        (lambda f: shutil.rmtree(f), "no such folder"),
        (lambda f: (f / "rgb.txt").unlink(), "rgb.txt: no such file"),
        (lambda f: (f / "depth.txt").unlink(), "depth.txt: no such file"),
        (lambda f: (f / "rgb.txt").write_text("# nothing\n"), "rgb.txt: lists no images"),
        (lambda f: (f / "rgb.txt").write_text("colours of our logo\n"), "found 4 fields: 'colours of our logo'"),
        (lambda f: (f / "rgb.txt").write_text("colours\n"), "found 1 field: 'colours'"),
        (lambda f: (f / "rgb.txt").write_bytes(b"\xff\xfe\x00"), "rgb.txt: not a text"),
        (lambda f: edit(f / "depth.txt", "depth/2.png", "depth/2.png\nnot a line at all"), "depth.txt:5: "),
        (lambda f: edit(f / "depth.txt", "depth/2.png", ""), "depth.txt:4: "),
        (lambda f: edit(f / "depth.txt", "depth/2.png", "depth/2 b.png"), "depth.txt:4: expected `timestamp path`"),
        (lambda f: edit(f / "rgb.txt", "100.000000", "nan"), "rgb.txt:2: not a time stamp"),
        (lambda f: edit(f / "rgb.txt", "100.000000", "1_00"), "rgb.txt:2: not a time stamp: '1_00'"),
        (lambda f: edit(f / "rgb.txt", "100.000000", "\u0661\u0662"), "rgb.txt:2: not a time stamp"),
        (lambda f: edit(f / "groundtruth.txt", "100.000000", "1_00"), "groundtruth.txt:2: expected 8 numbers"),
        (lambda f: edit(f / "rgb.txt", "rgb/3.png", "../clip2/3.png"), "rgb.txt:5: path leaves"),
        (lambda f: edit(f / "rgb.txt", "rgb/3.png", "/etc/passwd"), "rgb.txt:5: path leaves"),
        (lambda f: edit(f / "rgb.txt", "rgb/3.png", "/etc/passwd"), "link the images' folder into this one (ln -s)"),
        (
            lambda f: edit(f / "rgb.txt", "rgb/", "/disk/clip/rgb/"),
            "exists here as rgb/0.png: remove the prefix '/disk/clip/'",
        ),
        (
            lambda f: edit(f / "rgb.txt", "rgb/", "D:\\clip\\rgb\\"),
            "exists here as rgb/0.png: remove the prefix 'D:/clip/'",
        ),
        (lambda f: edit(f / "rgb.txt", "rgb/3.png", "rgb/\0.png"), "rgb.txt:5: not a usable path"),
        (lambda f: edit(f / "depth.txt", "100.", "900."), "no stamps"),
        (lambda f: (f / "groundtruth.txt").write_text(""), "groundtruth.txt: "),
        (lambda f: (f / "groundtruth.txt").write_text("1,2,3,4\n"), "found 4 fields; rename it to have it ignored"),
        (lambda f: (f / "groundtruth.txt").write_text("nan nan nan nan nan nan nan nan\n"), "groundtruth.txt:1: "),
    ],
)
def test_faults_of_the_lists_are_refused_at_once(folder, damage, fault):
    damage(folder)
    with pytest.raises(GavoError) as caught:
        TumSequence(folder, CAMERA)
    message = str(caught.value)
    assert str(folder) in message and fault in message and len(message.splitlines()) == 1


def test_links_out_of_the_folder_are_followed(folder):
    """Images often lie on another disk; what a list itself says stays in its folder."""
    disk = folder.parent / "disk"
    disk.mkdir()
    for part in (folder / "depth", folder / "rgb/1.png", folder / "rgb.txt"):
        part.rename(disk / part.name)
        part.symlink_to(disk / part.name)
    sequence = TumSequence(folder, CAMERA)
    sequence.check()
    assert len(sequence) == 6
    np.testing.assert_array_equal(sequence[1].depth, depth_image(1))
    edit(folder / "depth.txt", "depth/2.png", "depth/../../disk/depth/2.png")
    with pytest.raises(GavoError, match=r"depth\.txt:4: path leaves"):
        TumSequence(folder, CAMERA)


def test_a_folder_reached_through_a_link_is_fine(folder):
    (folder.parent / "link").symlink_to(folder)
    TumSequence(folder.parent / "link", CAMERA).check()


@pytest.mark.parametrize("camera", ["nonsense", "missing.toml"])
def test_an_unknown_camera_is_refused(folder, camera):
    with pytest.raises(GavoError, match=camera):
        TumSequence(folder, camera)


def test_paths_of_windows_lead_to_the_images(folder):
    for name in ("rgb", "depth"):
        edit(folder / f"{name}.txt", f"{name}/", f"{name}\\")
    sequence = TumSequence(folder, CAMERA)
    sequence.check()
    np.testing.assert_array_equal(sequence[3].depth, depth_image(3))
    edit(folder / "rgb.txt", "rgb\\3.png", "..\\..\\3.png")
    with pytest.raises(GavoError, match=r"rgb\.txt:5: path leaves"):
        TumSequence(folder, CAMERA)


@pytest.mark.parametrize(
    ("put", "words"),
    [
        (lambda path: path.mkdir(), "not a file: restore it, or omit its frame"),
        (lambda path: path.symlink_to("elsewhere.png"), r"a link to elsewhere\.png, which is missing: restore"),
        (lambda path: None, "image is missing: restore it, or omit its frame"),
    ],
)
def test_what_is_there_instead_of_an_image_is_said(folder, put, words):
    (folder / "rgb/4.png").unlink()
    put(folder / "rgb/4.png")
    with pytest.raises(GavoError, match=rf"rgb/4\.png: {words}"):
        TumSequence(folder, CAMERA).check()


def test_a_missing_image_of_the_chosen_range_is_refused_before_the_run(folder):
    (folder / "depth/4.png").unlink()
    sequence = TumSequence(folder, CAMERA)
    sequence[:4].check()
    with pytest.raises(GavoError, match=r"depth/4\.png"):
        sequence.check()
    with pytest.raises(FrameError, match=r"depth/4\.png"):
        sequence[4]


def with_chunk(data: bytes, kind: bytes, content: bytes) -> bytes:
    chunk = len(content).to_bytes(4, "big") + kind + content + zlib.crc32(kind + content).to_bytes(4, "big")
    return data[:33] + chunk + data[33:]


def with_size(data: bytes, width: int, height: int) -> bytes:
    header = b"IHDR" + width.to_bytes(4, "big") + height.to_bytes(4, "big") + data[24:29]
    return data[:12] + header + zlib.crc32(header).to_bytes(4, "big") + data[33:]


WHOLE_COLOR, WHOLE_DEPTH = png(color_image(0)), png(depth_image(0))
BAD_COLOR = {
    "empty": b"",
    "text": b"hello",
    "torn": WHOLE_COLOR[:3000],
    "only the end missing": WHOLE_COLOR[:-12],
    "last byte missing": WHOLE_COLOR[:-1],
    "zeros at the end": WHOLE_COLOR[:3000] + bytes(len(WHOLE_COLOR) - 3000),
    "flipped byte": WHOLE_COLOR[:2000] + bytes([WHOLE_COLOR[2000] ^ 1]) + WHOLE_COLOR[2001:],
    "another size": png(np.zeros((24, 64, 3), np.uint8)),
    "absurd size": with_size(WHOLE_COLOR, 2**31 - 1, 2**31 - 1),
    "wrong size, right header": with_size(png(np.zeros((24, 64, 3), np.uint8)), 64, 48),
    "torn JPEG": cv2.imencode(".jpg", color_image(0))[1].tobytes()[:-400],
    "floats": cv2.imencode(".tiff", np.zeros((48, 64), np.float32))[1].tobytes(),
    "no end of chunk": WHOLE_COLOR[:33] + b"\xff\xff\xff\xffIDAT",
    "signature only": WHOLE_COLOR[:8],
}
BAD_DEPTH = {
    "torn": WHOLE_DEPTH[:3000],
    "8 bits": png(np.zeros((48, 64), np.uint8)),
    "colour": WHOLE_COLOR,
    "16-bit colour": png(np.arange(48 * 64 * 3, dtype=np.uint16).reshape(48, 64, 3)),
    "another size": png(np.zeros((48, 32), np.uint16)),
}
BAD = [("rgb", name) for name in BAD_COLOR] + [("depth", name) for name in BAD_DEPTH]


@pytest.mark.parametrize(("kind", "name"), BAD)
def test_a_bad_image_is_refused_as_first_and_flagged_in_the_middle(folder, kind, name):
    content = BAD_COLOR[name] if kind == "rgb" else BAD_DEPTH[name]
    (folder / f"{kind}/2.png").write_bytes(content)
    sequence = TumSequence(folder, CAMERA)
    sequence.check()
    with pytest.raises(FrameError) as caught:
        sequence[2]
    assert f"{kind}/2.png" in str(caught.value) and len(str(caught.value).splitlines()) == 1
    assert sequence[3].timestamp == sequence.timestamps[3]
    with pytest.raises(GavoError, match=rf"{kind}/2\.png"):
        sequence[2:].check()


def read_one(color: Path, depth: Path) -> Frame:
    return open_pair([(color, depth)], Calibration(CAMERA))[0]


def test_grey_and_transparent_images_serve_as_colour(tmp_path):
    grey = color_image(0)[..., 0]
    (tmp_path / "depth.png").write_bytes(WHOLE_DEPTH)
    for name, image in (("grey", grey), ("alpha", np.dstack([grey] * 3 + [np.full_like(grey, 255)]))):
        (tmp_path / f"{name}.png").write_bytes(png(image))
        np.testing.assert_array_equal(read_one(tmp_path / f"{name}.png", tmp_path / "depth.png").grey, grey)


def test_an_orientation_tag_does_not_turn_the_image(tmp_path):
    exif = b"MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
    (tmp_path / "plain.png").write_bytes(WHOLE_COLOR)
    (tmp_path / "turned.png").write_bytes(with_chunk(WHOLE_COLOR, b"eXIf", exif))
    (tmp_path / "depth.png").write_bytes(WHOLE_DEPTH)
    plain, turned = (read_one(tmp_path / f"{name}.png", tmp_path / "depth.png") for name in ("plain", "turned"))
    np.testing.assert_array_equal(plain.grey, turned.grey)


@pytest.mark.parametrize("path", ["none.png", ".", "a\0b.png", "x" * 300])
def test_no_path_raises_anything_else(tmp_path, path):
    (tmp_path / "depth.png").write_bytes(WHOLE_DEPTH)
    with pytest.raises(FrameError):
        read_one(tmp_path / path, tmp_path / "depth.png")


@given(cut=st.integers(0, len(WHOLE_DEPTH) - 1), flip=st.integers(1, 255), at=st.integers(0, len(WHOLE_DEPTH) - 1))
def test_damage_anywhere_in_an_image_is_noticed(tmp_path_factory, cut, flip, at):
    folder = tmp_path_factory.mktemp("png")
    (folder / "color.png").write_bytes(WHOLE_COLOR)
    flipped = bytearray(WHOLE_DEPTH)
    flipped[at] ^= flip
    for content in (WHOLE_DEPTH[:cut], bytes(flipped)):
        (folder / "depth.png").write_bytes(content)
        with pytest.raises(FrameError):
            read_one(folder / "color.png", folder / "depth.png")


stamp = st.one_of(st.floats(), st.text(max_size=4))
rows = st.lists(st.tuples(stamp, st.text(max_size=8)).map(lambda row: f"{row[0]} {row[1]}"), max_size=4)


@given(content=st.one_of(st.binary(max_size=200), rows.map(lambda r: "\n".join(r).encode("utf-8", "replace"))))
def test_lists_raise_nothing_else(tmp_path_factory, content):
    folder = tmp_path_factory.mktemp("clip")
    (folder / "rgb.txt").write_bytes(content)
    (folder / "depth.txt").write_bytes(content)
    try:
        TumSequence(folder, CAMERA).check()
    except GavoError as error:
        assert len(str(error).splitlines()) == 1
    else:
        pytest.fail("there is no image in the folder")


def test_memory_does_not_grow_with_the_frames_read(folder):
    sequence = TumSequence(folder, CAMERA)
    for frame in sequence:
        assert frame.grey.size
    tracemalloc.start()
    before, _ = tracemalloc.get_traced_memory()
    for _ in range(50):
        for index in range(len(sequence)):
            assert sequence[index].grey.size
    after, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert after - before < 5 * depth_image(0).nbytes


@pytest.mark.parametrize(("clip", "frames"), [("fr1_xyz", 95), ("fr1_desk", 69), ("fr1_rpy", 80)])
def test_real_clips(data_dir, clip, frames):
    sequence = TumSequence(data_dir / clip)
    sequence.check()
    assert len(sequence) == frames and sequence.camera == Camera.preset("fr1").rectified()
    frame = sequence[0]
    assert frame.grey.shape == frame.depth.shape == (480, 640)
    assert 0.3 < np.median(frame.depth[frame.depth > 0]) / sequence.camera.depth_scale < 3
    assert frame.grey[:, [0, -1]].min() > 0 and frame.grey[[0, -1]].mean() > 10
    assert sequence.ground_truth is not None
    _, valid = sequence.ground_truth.interpolate(sequence.timestamps)
    assert valid.all()
