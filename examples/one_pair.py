"""The motion between two RGB-D frames, and how well it is known.

Run it as `python examples/one_pair.py`.
"""

import numpy as np

import gavo_jax as gavo


def main() -> gavo.Alignment:
    """Align two frames of the synthetic room and compare with the exact motion."""
    sequence = gavo.SyntheticSequence(frames=2)
    pair = gavo.align(sequence[0], sequence[1], sequence.camera)

    print(f"{pair.status}: {pair.sentence}")
    print(f"error {float(pair.error):.2f} squared grey levels, {float(pair.overlap):.0%} of the points in view")
    print("target_T_reference:")
    print(np.round(np.asarray(pair.target_T_reference), 5))

    deviations = np.sqrt(np.diag(pair.covariance))
    print(f"standard deviations: {np.round(1e3 * deviations[:3], 2)} mm, {np.round(np.degrees(deviations[3:]), 3)} deg")

    first, second = sequence.ground_truth.world_T_camera
    exact = np.linalg.inv(second) @ first
    print(f"off the exact motion by {1e3 * np.linalg.norm(pair.target_T_reference[:3, 3] - exact[:3, 3]):.2f} mm")
    return pair


if __name__ == "__main__":
    main()
