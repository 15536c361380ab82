"""Frames as they come from a camera: `Odometry.register`, one call a frame.

Run it as `python examples/live_frames.py`. The synthetic room stands in for the camera; for a real device, yield its
images and timestamps from `camera_images` instead, and give `Odometry` its `gavo.Camera`. `register` removes the lens
distortion. If your images are already undistorted, give `Odometry` the `camera.rectified()`.
"""

from collections.abc import Iterator

import numpy as np

import gavo_jax as gavo


def camera_images(frames: int) -> Iterator[tuple[np.ndarray, np.ndarray, float]]:
    """Yield grey [H, W] uint8, depth [H, W] uint16 registered to it, and the colour image's timestamp in seconds."""
    for frame in gavo.SyntheticSequence(frames=frames):
        yield frame.grey, frame.depth, frame.timestamp


def main(frames: int = 10) -> np.ndarray:
    """Track the camera until its images end or Ctrl-C is pressed; return the last world_T_camera."""
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
