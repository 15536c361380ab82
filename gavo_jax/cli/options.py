"""Arguments of the command: one dataclass per subcommand, from which tyro builds parser and help."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Literal, get_args

from tyro.conf import Positional, UseAppendAction, arg, subcommand

from gavo_jax import presets
from gavo_jax.peers.registry import PEERS

METHODS = (*presets.METHODS, *presets.plugin_names())
METHOD = f"{{{','.join(METHODS)}}}"
"""Names of `presets.methods()`; the help lists those of other packages without loading their code."""
PresetName = Literal["default", "paper", "fast", "wide"]

# tyro keeps the line breaks of a docstring, so texts longer than a line are given as `help`

SOURCE = (
    "A folder of a dataset or of images, a ROS recording (see Sources in the project's documentation), or the word "
    "synthetic: a room rendered by the package"
)
LIVE = "Also realsense: live frames of the first Intel RealSense camera that is connected"


@dataclass(frozen=True)
class Source:
    """The frames to use."""

    sequence: Annotated[Positional[str], arg(metavar="[SEQUENCE]", help=f"{SOURCE}.")] = "synthetic"
    camera: Annotated[
        str,
        arg(
            metavar="{auto,fr1,fr2,fr3,FILE}",
            help="The camera: what the source brings, a camera of a benchmark (bonn and icl, too), or a camera file "
            "(TOML, ROS, Kalibr, OpenCV, Open3D).",
        ),
    ] = "auto"
    start: Annotated[int, arg(metavar="K")] = 0
    """First frame."""
    frames: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: all)")] = None
    """Number of frames, at least 2."""
    stride: Annotated[int, arg(metavar="S")] = 1
    """Take every S-th frame."""
    depth_scale: Annotated[float | None, arg(metavar="U", help_behavior_hint="(default: the camera's)")] = None
    """Raw depth units per metre: 5000 for TUM, 1000 for millimetres."""
    rate: Annotated[float | None, arg(metavar="HZ", help_behavior_hint="(default: from the stamps, else 30)")] = None
    """Frames per second, if frames have numbers but no timestamps."""
    colour_topic: Annotated[str | None, arg(metavar="TOPIC", help_behavior_hint="(default: found by type)")] = None
    """Topic of a recording's colour images."""
    depth_topic: Annotated[str | None, arg(metavar="TOPIC", help_behavior_hint="(default: found by type)")] = None
    """Topic of a recording's depth images."""
    moving: Annotated[int, arg(metavar="N")] = 0
    """Number of bodies that move through the synthetic room: a box, a walking figure, more boxes."""
    force: bool = False
    """Continue even if the depth scale looks wrong."""


@dataclass(frozen=True, kw_only=True)
class SearchOptions:
    """The search and its settings."""

    method: Annotated[
        str | None,
        arg(
            metavar=METHOD,
            help_behavior_hint="(default: ga)",
            help="Genetic algorithm, particle swarm, Gauss-Newton (the classic method), Adam. Installed "
            "packages may add others.",
        ),
    ] = None
    preset: Annotated[
        PresetName | None,
        arg(
            metavar="{default,paper,fast,wide}",
            help_behavior_hint="(default: default)",
            help="Settings: the project's own, the paper's, for speed, for large motions. Each of the four methods has "
            "all of them; a method of another package has only default.",
        ),
    ] = None
    settings: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(default: the preset's)")] = None
    """Settings from a TOML file or an earlier run's config.json, with the method and preset that it names."""
    set: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="NAME=VALUE", help_behavior_hint="(repeatable)")] = ()
    """A single setting, such as alignment.points=2400 or solver.population.4=32."""

    @property
    def base(self) -> tuple[str, str]:
        """Method and preset, those that stand for none included."""
        return self.method or "ga", self.preset or "default"


@dataclass(frozen=True)
class Run(SearchOptions, Source):
    """Estimate the trajectory of a sequence."""

    sequence: Annotated[Positional[str], arg(metavar="[SEQUENCE]", help=f"{SOURCE}. {LIVE}.")] = "synthetic"
    seed: Annotated[int, arg(metavar="S")] = 0
    """Seed of the method's random numbers: the same seed gives the same trajectory, bit for bit."""
    reference: Annotated[
        Literal["previous", "keyframe"] | None,
        arg(metavar="{previous,keyframe}", help_behavior_hint="(default: the preset's)"),
    ] = None
    """What a frame is aligned to: only the previous frame, or that and a keyframe at once."""
    on_lost: Annotated[
        Literal["hold", "predict", "stop"] | None,
        arg(metavar="{hold,predict,stop}", help_behavior_hint="(default: the preset's)"),
    ] = None
    """After a pair without a usable motion: stand still, keep the last motion, or end the run."""
    bodies: Annotated[
        Literal["off", "mask", "track"] | None,
        arg(metavar="{off,mask,track}", help_behavior_hint="(default: the preset's)"),
    ] = None
    """Moving bodies: treat as part of the scene, exclude from the search, or also find their own motions."""
    output: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="(default: runs/SEQUENCE-METHOD-PRESET)")] = (
        None
    )
    """Folder for trajectory.txt, metrics.json, frames.csv, config.json and figures; earlier ones are replaced."""
    trajectory_format: Annotated[str, arg(metavar="{tum,kitti,euroc,json,bag}")] = "tum"
    """Further formats of the trajectory, comma-separated: KITTI, EuRoC's CSV, JSON, a ROS 2 bag of poses."""
    map: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(.ply, .pcd or .obj; default: none)")] = None
    """Write a coloured map of the scene: a point cloud, or for .obj a mesh; needs the extra [map]."""
    map_shape: Annotated[
        Literal["cloud", "mesh"] | None, arg(metavar="{cloud,mesh}", help_behavior_hint="(default: the ending's)")
    ] = None
    """Kind of the map."""
    voxel: Annotated[float, arg(metavar="M")] = 0.01
    """Side of the map's voxels, metres."""
    loops: bool = False
    """Keep a map of keyframes and correct the trajectory when the camera returns to a place."""
    viewer: Literal["none", "spawn", "web", "save"] = "none"
    """Watch the search: in a window of Rerun, in a browser, or later, from run.rrd in the output folder."""
    resume: bool = False
    """Resume the interrupted run in the folder; the options must be the same."""
    strict: bool = False
    """Exit with status 3 if any pair was lost."""


@dataclass(frozen=True)
class Compare(Source):
    """Run several methods, also of other libraries, on the same frames: one table, comparison.json, figures."""

    methods: Annotated[
        str,
        arg(
            metavar="NAME,NAME,…",
            help="Methods of `gavo run` and odometries of other libraries, separated by commas: "
            f"{', '.join((*METHODS, *PEERS))}. A method may have its own preset: ga:fast.",
        ),
    ] = "ga,pso,gauss-newton,adam,opencv-rgb,opencv-rgbd"
    preset: PresetName = "default"
    """Preset of those of the project's methods that are named without one."""
    seeds: Annotated[int, arg(metavar="N")] = 1
    """Run each of the project's methods with seeds 0 to N - 1; the table and figures show the run of median drift."""
    output: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="(default: runs/SEQUENCE-compare-PRESET)")] = (
        None
    )
    """Folder for comparison.json, the trajectories and the figures."""


@dataclass(frozen=True)
class View:
    """Look at a finished run: its trajectory, curves and, if the sequence is still there, images and truth."""

    folder: Annotated[Positional[Path], arg(metavar="DIR")]
    """The output folder of `gavo run`."""
    viewer: Literal["spawn", "web", "save"] = "web"
    """As in `gavo run`; save writes view.rrd into DIR."""
    search: Annotated[
        bool,
        arg(
            help="Do not track the frames again: paths and images appear at once, without the particles.",
            help_behavior_hint="(default: they are tracked)",
        ),
    ] = True


@dataclass(frozen=True)
class Align(SearchOptions):
    """Align one pair of RGB-D images and print the motion as JSON."""

    rgb0: Annotated[Positional[Path], arg(metavar="RGB0")]
    """Colour or grey image of the reference frame."""
    depth0: Annotated[Positional[Path], arg(metavar="DEPTH0")]
    """Depth image of the reference frame, registered to it."""
    rgb1: Annotated[Positional[Path], arg(metavar="RGB1")]
    """Colour image of the target frame."""
    depth1: Annotated[Positional[Path], arg(metavar="DEPTH1")]
    """Depth image of the target frame."""
    camera: Annotated[str, arg(metavar="{auto,fr1,fr2,fr3,FILE}")] = "auto"
    """As in `gavo run`; auto: the camera of RGB0's source, else the camera file beside it or one folder up."""
    depth_scale: Annotated[float | None, arg(metavar="U", help_behavior_hint="(default: the camera's)")] = None
    """As in `gavo run`."""
    force: bool = False
    """As in `gavo run`."""
    seed: Annotated[int, arg(metavar="S")] = 0
    """As in `gavo run`."""


@dataclass(frozen=True)
class Evaluate:
    """Compute the errors of a trajectory against the truth, both TUM files (timestamp tx ty tz qx qy qz qw)."""

    estimate: Annotated[Positional[Path], arg(metavar="ESTIMATE")]
    """The estimated trajectory, camera to world."""
    groundtruth: Annotated[Positional[Path], arg(metavar="GROUNDTRUTH")]
    """The true trajectory."""
    delta: Annotated[float, arg(metavar="D")] = 1.0
    """Span of the relative pose error."""
    unit: Literal["s", "frames"] = "s"
    """Unit of the span."""
    json: bool = False
    """Print the errors as JSON."""
    plot: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="(default: no figures)")] = None
    """Folder for figures of both trajectories and of the distance between them."""


@dataclass(frozen=True)
class Experiment:
    """Run sequences x methods x presets x seeds x settings into a table of results, and report on it."""

    file: Annotated[Positional[str], arg(metavar="{FILE.toml,report}")]
    """The experiment (see Experiments in the project's documentation), or the word report and a folder of results."""
    folder: Annotated[Positional[Path | None], arg(metavar="[DIR]", help_behavior_hint="(with report)")] = None
    """Folder of results to report on."""
    executor: Literal["local", "ray"] = "local"
    """Run in this process, or on the Ray cluster named by RAY_ADDRESS (else on one started here)."""
    dry_run: bool = False
    """Print the plan and stop."""
    output: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="(default: the file's, else runs/NAME)")] = (
        None
    )
    """Folder for the table and the report; runs that it holds already are not repeated."""
    markdown: bool = False
    """Print the tables of the report as Markdown."""


@dataclass(frozen=True)
class Download:
    """Download a sequence of the TUM RGB-D benchmark and unpack it."""

    name: Annotated[Positional[str], arg(metavar="NAME")]
    """For example fr1_xyz, freiburg1_xyz or rgbd_dataset_freiburg1_xyz."""
    to: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="(default: GAVO_DATA, else data)")] = None
    """Folder that receives the sequence's folder."""


@dataclass(frozen=True)
class Tune:
    """Tune settings for both low drift and short time, by Optuna; the result is a Pareto front."""

    file: Annotated[Positional[Path], arg(metavar="FILE.toml")]
    """The settings to tune and the sequences to tune them on (see Experiments in the project's documentation)."""
    trials: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: the file's, else 50)")] = None
    """Total number of trials in the study, including those it has already."""
    storage: Annotated[str | None, arg(metavar="URL", help_behavior_hint="(default: SQLite in --output)")] = None
    """Any Optuna storage; several machines may share one."""
    output: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="(default: the file's, else runs/NAME)")] = (
        None
    )
    """Folder for the study and the front."""


@dataclass(frozen=True)
class Doctor:
    """Show versions, machine and settings for an issue report; check that this JAX computes correctly, and how fast."""


@dataclass(frozen=True)
class Inspect(Source):
    """Describe a source: frames, rates, sizes, depth, camera, truth, and which frames cannot be used, and why."""

    json: bool = False
    """Print it as JSON."""


@dataclass(frozen=True)
class Calibrate(Source):
    """Estimate from the images alone what a source does not say about its camera, and write a camera file.

    It finds shutter readout, depth delay, depth scale and vignetting, starting from the source's camera.
    """

    focal_length: bool = False
    """Also find the focal length."""
    principal_point: bool = False
    """Also find the principal point."""
    output: Annotated[Path | None, arg(metavar="FILE.toml", help_behavior_hint="(default: camera.toml)")] = None
    """The camera file, for --camera. An existing one is replaced only if named here."""
    json: bool = False
    """Print what was found as JSON."""


Command = (
    Annotated[Run, subcommand("run")]
    | Annotated[Compare, subcommand("compare")]
    | Annotated[View, subcommand("view")]
    | Annotated[Align, subcommand("align")]
    | Annotated[Evaluate, subcommand("evaluate")]
    | Annotated[Experiment, subcommand("experiment")]
    | Annotated[Download, subcommand("download")]
    | Annotated[Tune, subcommand("tune")]
    | Annotated[Doctor, subcommand("doctor")]
    | Annotated[Inspect, subcommand("inspect")]
    | Annotated[Calibrate, subcommand("calibrate")]
)
OPTIONS = {
    (of := get_args(command)[0]).__name__.lower(): {f"--{one.name.replace('_', '-')}" for one in fields(of)}
    for command in get_args(Command)
}
"""Names of each command's options (and arguments), by the command's name."""
COMMANDS = tuple(OPTIONS)
"""Names of the commands."""
