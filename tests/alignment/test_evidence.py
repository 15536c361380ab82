"""The evidence is one scale for all motions: the true one has most, and what is not seen tells nothing."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gavo_jax.alignment.aliases import self_motions
from gavo_jax.alignment.evidence import evidence, evidence_and_best, is_held
from gavo_jax.alignment.fitting import objectives_of
from gavo_jax.image.pyramid import build_pyramid
from gavo_jax.se3 import exp
from gavo_jax.settings import AlignmentOptions
from tests.small import CAMERA, PLAIN_ERROR

SHIFT = 12.0
"""Pixels to the side, of a wall a metre ahead."""
FAINT = 1.5
"""Contrast of an almost plain wall, grey levels a wave."""
TURNED = (0.0, 0.0, 0.0, 0.0, 3.0, 0.0)


def wall(shift: float, period: float | None, contrast: float = 22.0) -> tuple[np.ndarray, np.ndarray]:
    """A wall with a pattern of dots, which may repeat to the side."""
    u, v = np.meshgrid(np.arange(CAMERA.width) - shift, np.arange(CAMERA.height))
    along = u if period is None else u % period
    waves = np.random.default_rng(3).normal(0, 0.12, (12, 2))
    grey = 128 + contrast * np.sum([np.sin(a * along + b * v + i) for i, (a, b) in enumerate(waves)], axis=0)
    return np.clip(grey, 0, 255).astype(np.uint8), np.full(grey.shape, CAMERA.depth_scale).astype(np.uint16)


@jax.jit
def ask(before: Any, after: Any, motions: jax.Array) -> Any:
    """Evidence of some motions, by fixed noise and by the best one, whether the first is held, and its aliases."""
    pyramids = [build_pyramid(grey, depth, CAMERA.depth_scale, 3) for grey, depth in (before, after)]
    options = AlignmentOptions(symmetric=True, points=1200, **{k: getattr(PLAIN_ERROR, k) for k in ("loss", "depth")})
    [objective] = objectives_of(pyramids[0], pyramids[1], CAMERA, (2,), options, motions[0])
    assert objective.backward is not None
    fixed = jax.vmap(lambda motion: evidence(objective, motion))(motions)
    again, best = jax.vmap(lambda motion: evidence_and_best(objective, motion))(motions)
    held = is_held(objective, motions[0], jax.tree.map(lambda of: of[0], fixed), jnp.eye(6)).held
    return fixed.total, again.total, best.total, held, self_motions(objective, objective.backward.target)


@pytest.fixture(scope="module")
def answers() -> dict[str, Any]:
    """Of a wall that repeats, one that does not, and one that is almost plain."""
    twists = np.zeros((4, 6), np.float32)
    twists[0, 0] = twists[1, 0] = SHIFT / CAMERA.fx
    twists[1, 0] -= 0.05
    twists[3] = TURNED
    motions = exp(jnp.asarray(twists))
    walls = {"repeats": (40.0,), "plain": (None, FAINT), "dots": (None,)}
    return {
        name: jax.device_get(ask(wall(0.0, *pattern), wall(SHIFT, *pattern), motions))
        for name, pattern in walls.items()
    }


def test_the_true_motion_has_most(answers: dict[str, Any]) -> None:
    (true, aside, still, turned), _, _, held, _ = answers["dots"]
    assert true > 0.8 and true > 1.2 * max(aside, still)
    assert held[0] and held[1], "to the side, up and down"
    assert turned == 0.0, "what is not seen tells nothing"


def test_an_almost_plain_wall_does_not_outweigh_a_better_match(answers: dict[str, Any]) -> None:
    """Motions were compared under the noise of a search: before plain walls decimetres went unseen, and overlap won."""
    (true, _, still, _), _, (best_true, _, best_still, _), _, _ = answers["plain"]
    assert still > true, "more of it stays in view"
    assert best_true > 1.2 * best_still


@pytest.mark.parametrize("wall", ["repeats", "plain", "dots"])
def test_both_evidences_are_of_one_motion(answers: dict[str, Any], wall: str) -> None:
    fixed, again, best, *_ = answers[wall]
    np.testing.assert_allclose(again, fixed, rtol=1e-5, atol=1e-6)
    assert np.all(best >= again)


def test_a_pattern_that_repeats_looks_like_itself(answers: dict[str, Any]) -> None:
    assert not np.isfinite(answers["dots"][-1]).any()
    found = answers["repeats"][-1]
    found = found[np.isfinite(found).all(axis=(1, 2))]
    assert len(found) >= 2
    np.testing.assert_allclose(np.abs(found[:2, 0, 3]) * CAMERA.fx, 40.0, atol=6.0)
