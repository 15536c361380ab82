"""Frames as they come from a camera: `Odometry.register`, one call a frame.

Run it as `python examples/live_frames.py`. The synthetic room stands for the camera; with a device of your own, yield
its images and stamps from `camera_images` instead, and give `Odometry` its `gavo.Camera`. Images of a lens with
distortion go through `camera.undistort` first.
"""

from collections.abc import Iterator

import numpy as np

import gavo_jax as gavo


def camera_images(frames: int) -> Iterator[tuple[np.ndarray, np.ndarray, float]]:
    """Grey [H, W] of uint8, depth [H, W] of uint16 registered to it, and the colour image's stamp in seconds."""
    for frame in gavo.SyntheticSequence(frames=frames):
        yield frame.grey, frame.depth, frame.timestamp


def main(frames: int = 10) -> np.ndarray:
    """Track what the camera sees until it ends or Ctrl-C; returns the last world_T_camera."""
    gavo.enable_compilation_cache()
    odometry = gavo.Odometry(gavo.SyntheticSequence(frames=2).camera, gavo.preset("ga", "fast"))
    print("compiling ...")
    odometry.warm_up()
    world_T_camera = np.eye(4)
    try:
        for grey, depth, timestamp in camera_images(frames):
            step = odometry.register(gavo.Frame(grey, depth, timestamp), timestamp)
            if step is None:  # the first frame is the world's origin
                continue
            world_T_camera = step.world_T_camera
            x, y, z = world_T_camera[:3, 3]
            print(f"{timestamp:.3f} s  {step.alignment.sentence}  camera at {x:+.3f} {y:+.3f} {z:+.3f} m")
    except KeyboardInterrupt:
        print("stopped")
    return world_T_camera


if __name__ == "__main__":
    main()
