"""What a run writes down of its options."""

from pathlib import Path

import pytest

from gavo_jax.cli.options import Run
from gavo_jax.cli.selection import with_whole_paths


def test_words_are_no_paths(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a folder `synthetic` at hand, `gavo view` of a run over the rendered room opened that."""
    monkeypatch.chdir(tmp_path)
    for name in ("synthetic", "fr1", "auto", "desk"):
        (tmp_path / name).mkdir()
    whole = with_whole_paths(Run(sequence="synthetic", camera="fr1"))
    assert (whole.sequence, whole.camera) == ("synthetic", "fr1")
    assert with_whole_paths(Run(sequence="desk")).sequence == str(tmp_path / "desk")
