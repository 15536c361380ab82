"""Dense RGB-D visual odometry by genetic algorithm, in JAX."""

from gavo_jax.early import end_at_once

end_at_once()  # before anything that takes time to import

import warnings

from gavo_jax.compilation.compiler import prepare_process

prepare_process()  # before anything imports JAX

from gavo_jax import solvers as solvers
from gavo_jax.alignment.pairs import align as align
from gavo_jax.alignment.pairs import align_batch as align_batch
from gavo_jax.alignment.result import Alignment as Alignment
from gavo_jax.camera import Camera as Camera
from gavo_jax.camera_files.calibration import Calibration as Calibration
from gavo_jax.camera_files.calibration import load_calibration as load_calibration
from gavo_jax.camera_files.calibration import load_camera as load_camera
from gavo_jax.compilation.cache import enable_compilation_cache as enable_compilation_cache
from gavo_jax.compilation.compiler import CompilerWarning as CompilerWarning
from gavo_jax.datasets.base import Frame as Frame
from gavo_jax.datasets.base import FrameError as FrameError
from gavo_jax.datasets.base import Sequence as Sequence
from gavo_jax.datasets.base import TimestampError as TimestampError
from gavo_jax.datasets.files import Reading as Reading
from gavo_jax.datasets.layouts.tum import TumSequence as TumSequence
from gavo_jax.datasets.layouts.tum_writing import write_tum as write_tum
from gavo_jax.datasets.live.devices import register_device as register_device
from gavo_jax.datasets.live.frames import LiveImages as LiveImages
from gavo_jax.datasets.live.frames import Newest as Newest
from gavo_jax.datasets.live.frames import frame_of as frame_of
from gavo_jax.datasets.registry import open_source as open_source
from gavo_jax.datasets.registry import register_dataset as register_dataset
from gavo_jax.datasets.rendered import actors as actors
from gavo_jax.datasets.rendered.moving import BodyTruth as BodyTruth
from gavo_jax.datasets.rendered.moving import MovingBody as MovingBody
from gavo_jax.datasets.rendered.moving import MovingPart as MovingPart
from gavo_jax.datasets.rendered.room import Box as Box
from gavo_jax.datasets.rendered.sensor_noise import SensorNoise as SensorNoise
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence as SyntheticSequence
from gavo_jax.errors import GavoError as GavoError
from gavo_jax.errors import GavoWarning as GavoWarning
from gavo_jax.evaluation import absolute_trajectory_error as absolute_trajectory_error
from gavo_jax.evaluation import distance_error as distance_error
from gavo_jax.evaluation import relative_pose_error as relative_pose_error
from gavo_jax.map_fusion import MapBuilder as MapBuilder
from gavo_jax.map_fusion import build_map as build_map
from gavo_jax.objective.losses import LOSSES as LOSSES
from gavo_jax.odometry.driver import Odometry as Odometry
from gavo_jax.odometry.driver import Step as Step
from gavo_jax.odometry.metrics import Metrics as Metrics
from gavo_jax.odometry.run import OdometryRun as OdometryRun
from gavo_jax.odometry.run import run_odometry as run_odometry
from gavo_jax.odometry.stream import track as track
from gavo_jax.output.trajectories import write_trajectory as write_trajectory
from gavo_jax.presets import preset as preset
from gavo_jax.presets import register as register
from gavo_jax.scene_map import SceneMap as SceneMap
from gavo_jax.settings import AlignmentOptions as AlignmentOptions
from gavo_jax.settings import OdometryOptions as OdometryOptions
from gavo_jax.settings import Settings as Settings
from gavo_jax.settings_file import NamedSettings as NamedSettings
from gavo_jax.settings_file import load_settings as load_settings
from gavo_jax.settings_file import save_settings as save_settings
from gavo_jax.solvers.gauss_newton import GaussNewton as GaussNewton
from gavo_jax.solvers.genetic import GeneticAlgorithm as GeneticAlgorithm
from gavo_jax.solvers.gradient import GradientDescent as GradientDescent
from gavo_jax.solvers.particle_swarm import ParticleSwarm as ParticleSwarm
from gavo_jax.status import AlignmentStatus as AlignmentStatus
from gavo_jax.trajectory import Trajectory as Trajectory

_RENAMED = {"get_preset": "preset", "Preset": "Settings"}


def __getattr__(name: str) -> object:
    """Return a deprecated name of version 0.1, with a warning."""
    if name not in _RENAMED:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    warnings.warn(f"gavo_jax.{name} is now gavo_jax.{_RENAMED[name]}", DeprecationWarning, stacklevel=2)
    return globals()[_RENAMED[name]]
