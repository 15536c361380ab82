"""A trajectory from a sequence: a folder in TUM layout, or the synthetic room.

Run it as `python examples/sequence.py [FOLDER]`.
"""

import sys

import gavo_jax as gavo


def main(folder: str | None = None, frames: int = 30) -> gavo.OdometryRun:
    """Track the first frames of a sequence, printing each pair's status on the way."""
    gavo.enable_compilation_cache()  # keep compiled programs for later runs
    sequence = gavo.TumSequence(folder)[:frames] if folder else gavo.SyntheticSequence(frames=frames)

    def tell(step: gavo.Step) -> None:
        x, y, z = step.world_T_camera[:3, 3]
        print(f"{step.timestamp:.3f} s  {step.alignment.status!s:12} camera at {x:+.3f} {y:+.3f} {z:+.3f} m")

    run = gavo.run_odometry(sequence, gavo.preset("ga", "fast"), seed=0, on_step=tell)
    for key, value in run.metrics.items():
        print(f"{key:36} {value}")
    return run


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else None)
