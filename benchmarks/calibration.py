"""Whether the covariance of a motion matches its error: eᵀΣ⁻¹e over pairs of synthetic sequences and of real clips.

Let e be the twist between the true and the estimated motion, in the tangent space of Σ. If Σ is consistent, eᵀΣ⁻¹e has
a mean of 6, and 95 % of the pairs lie within the 95 % ellipsoid. Prints one row per sequence: the pairs, the mean and
median of eᵀΣ⁻¹e, the share within the ellipsoid, and the median errors. On real clips the truth is motion capture,
whose own errors and time offset count as the odometry's.

    python benchmarks/calibration.py
    python benchmarks/calibration.py --frames 30 --clips fr1_xyz --json calibration.json

On 2 cores the defaults take about 3 minutes.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import common
import jax
import numpy as np
from scipy.stats import chi2

from gavo_jax.alignment.pairs import align
from gavo_jax.datasets.base import Sequence
from gavo_jax.datasets.rendered.sensor_noise import KINECT, NONE
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.errors import GavoError
from gavo_jax.output.screen import number
from gavo_jax.se3 import log
from gavo_jax.trajectory import inverse

ELLIPSOID = float(chi2.ppf(0.95, 6))
NOISE = {
    "no noise": NONE,
    "Kinect": KINECT,
    "Kinect, grey noise x 3": replace(KINECT, grey_sigma=3 * KINECT.grey_sigma),
    "Kinect, depth noise x 3": replace(KINECT, depth_sigma=3 * KINECT.depth_sigma),
}


def normalised_errors(sequence: Sequence, method: str, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Errors e [pairs, 6] and eᵀΣ⁻¹e [pairs] of consecutive frames that are ok and have ground truth.

    Raises:
        GavoError: there is no ground truth.
    """
    if sequence.ground_truth is None:
        raise GavoError(f"{sequence.name}: no ground truth to compare with")
    settings = common.preset_of(method)
    world_T_camera, valid = sequence.ground_truth.interpolate(sequence.timestamps)
    errors, distances, reference = [], [], sequence[0]
    for index in range(1, len(sequence)):
        target = sequence[index]
        key = jax.random.fold_in(jax.random.key(seed), index)
        found = align(reference, target, sequence.camera, settings, key=key)
        truth = inverse(world_T_camera[index]) @ world_T_camera[index - 1]
        error = np.asarray(log(inverse(np.asarray(found.target_T_reference, np.float64)) @ truth), np.float64)
        if found.status == 0 and valid[index] and valid[index - 1]:
            errors.append(error)
            distances.append(error @ np.linalg.solve(np.asarray(found.covariance, np.float64), error))
        reference = target
    return np.array(errors), np.array(distances)


def summarise(name: str, errors: np.ndarray, distances: np.ndarray) -> dict[str, Any]:
    """Figures of a sequence, or of several together."""
    return {
        "sequence": name,
        "pairs": len(distances),
        "mean": float(np.mean(distances)),
        "median": float(np.median(distances)),
        "share_within": float(np.mean(distances < ELLIPSOID)),
        "millimetres": float(np.median(np.linalg.norm(errors[:, :3], axis=1)) * 1e3),
        "milliradians": float(np.median(np.linalg.norm(errors[:, 3:], axis=1)) * 1e3),
    }


def main(
    frames: int = 26,
    seeds: int = 4,
    clips: str = "fr1_xyz:90,fr1_desk,fr1_rpy",
    method: str = "gauss-newton",
    json: Path | None = None,
) -> dict[str, Any]:
    """Measure, print and return the figures.

    Args:
        frames: of each synthetic sequence.
        seeds: synthetic sequences per noise level, each with its own path and textures.
        clips: comma-separated real clips; none if empty.
        method: METHOD or METHOD:PRESET.
        json: file for the figures.
    """
    rows, every = [], []
    for name, noise in NOISE.items():
        parts = [
            normalised_errors(SyntheticSequence(frames=frames, noise=noise, seed=seed), method, seed)
            for seed in range(seeds)
        ]
        every += parts
        rows.append(summarise(f"synthetic, {name}", *map(np.concatenate, zip(*parts, strict=True))))
    rows.append(summarise("synthetic, all", *map(np.concatenate, zip(*every, strict=True))))
    named = common.names(clips) if clips else []
    rows += [summarise(clip, *normalised_errors(common.open_clip(clip), method, 0)) for clip in named]
    columns = ("", "pairs", "mean", "median", "share within 95 %", "mm", "mrad")
    keys = ("mean", "median", "share_within", "millimetres", "milliradians")
    cells = [[row["sequence"], row["pairs"], *(number(row[key], 2) for key in keys)] for row in rows]
    common.print_table(f"normalised error of {method}; 6 and 0.95 are ideal", columns, cells)
    results = {"method": method, "frames": frames, "seeds": seeds, "rows": rows}
    common.record(json, "calibration", results)
    return results


if __name__ == "__main__":
    common.command(main)
