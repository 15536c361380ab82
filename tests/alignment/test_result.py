"""What a result says in words."""

import jax
import numpy as np
import pytest
from aligning import run

from gavo_jax.alignment.result import Alignment
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.errors import GavoError
from gavo_jax.status import AlignmentStatus


def test_a_pair_of_a_batch_has_words_and_the_batch_has_none() -> None:
    one = Alignment(*(np.float32(1.0),) * 5, status=0, history=np.zeros(1), findings=0)  # pyright: ignore
    batch = jax.tree.map(lambda field: np.stack([field, field]), one)
    with pytest.raises(GavoError, match="a batch of 2 alignments has no single status"):
        _ = batch.sentence
    pair = jax.tree.map(lambda field: field[1], batch)
    assert pair.statuses == (AlignmentStatus.OK,) and pair.sentence == AlignmentStatus.OK.sentence


def test_an_undetermined_direction_is_named(sequence: SyntheticSequence) -> None:
    height, width = sequence.camera.height, sequence.camera.width
    stripes = 128 + 100 * np.sin(np.arange(width) / 7.0 + 3 * np.sin(np.arange(width) / 40.0))
    depth = np.full((height, width), 2 * sequence.camera.depth_scale).astype(np.uint16)
    upright = np.tile(stripes.astype(np.uint8), (height, 1))
    result = run("gauss-newton", (upright, depth), (upright, depth), sequence.camera)
    assert result.status is AlignmentStatus.LOW_TEXTURE
    assert result.undetermined.startswith("translation along y") and result.undetermined in result.sentence
    textured = run("gauss-newton", sequence[0], sequence[1], sequence.camera)
    assert textured.undetermined == "" and textured.sentence == textured.status.sentence
