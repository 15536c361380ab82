"""A small experiment's file: rendered frames of 160 x 120 pixels."""

from collections.abc import Callable
from pathlib import Path

import pytest

CAMERA = "fx = 131.0\nfy = 131.0\ncx = 79.5\ncy = 59.5\nwidth = 160\nheight = 120\n"
SEQUENCES = '[[sequences]]\npath = "synthetic"\ncamera = "camera.toml"\nframes = {frames}\n'


@pytest.fixture
def write_experiment(tmp_path: Path) -> Callable[..., Path]:
    """Write an experiment's file: top-level lines, then the frames, then the rest."""

    def write(top: str, rest: str, frames: int = 4, name: str = "small.toml") -> Path:
        (tmp_path / "camera.toml").write_text(CAMERA)
        path = tmp_path / name
        path.write_text(f"{top}\n{SEQUENCES.format(frames=frames)}\n{rest}\n")
        return path

    return write
