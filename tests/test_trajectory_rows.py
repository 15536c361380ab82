"""Trajectories in tables with more columns than those of a pose."""

from pathlib import Path

import numpy as np
import pytest

from gavo_jax.datasets.truth import counted_in
from gavo_jax.errors import GavoError
from gavo_jax.trajectory import Trajectory

EUROC = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], "
    "v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], b_w_RS_S_x [rad s^-1], b_w_RS_S_y [rad s^-1], "
    "b_w_RS_S_z [rad s^-1], "
    "b_a_RS_S_x [m s^-2], b_a_RS_S_y [m s^-2], b_a_RS_S_z [m s^-2]\r\n"
    "1403636580838555648,4.688,-1.786,0.783,0.8,0.6,0,0,-0.027,0.034,0.79,-0.0022,0.0207,0.0758,-0.013,0.103,0.093\r\n"
    "1403636580888555648,4.687,-1.786,0.787,0.8,0.6,0,0,-0.028,0.034,0.80,-0.0022,0.0207,0.0758,-0.013,0.103,0.093\r\n"
)
POSE = ",".join(f"field.pose.{name}" for name in ("position.x", "position.y", "position.z"))
TURN = ",".join(f"field.pose.orientation.{axis}" for axis in "xyzw")
ROSTOPIC = f"%time,field.header.seq,field.header.stamp,field.header.frame_id,{POSE},{TURN}\n"


def row(received: int, stamp: int) -> str:
    return f"{received},0,{stamp},,4.688,-1.786,0.783,0.6,0,0,0.8\n"


@pytest.mark.parametrize(
    ("text", "first"),
    [
        (EUROC, 1403636580.838556),
        (ROSTOPIC + row(1403636590000000000, 1403636580838555648), 1403636580.838556),
        (ROSTOPIC + row(1403636590000000000, 0), 1403636590.0),
        (ROSTOPIC.replace("field.pose", "field.pose.pose") + row(1403636590000000000, 0), 1403636590.0),
        (
            ROSTOPIC.replace("pose.position", "transform.translation").replace("pose.orientation", "transform.rotation")
            + row(1403636590000000000, 0),
            1403636590.0,
        ),
    ],
)
def test_the_columns_of_the_pose_are_found_by_their_names(tmp_path: Path, text: str, first: float) -> None:
    """Such files were refused, for their number of columns."""
    (tmp_path / "data.csv").write_text(text)
    found = Trajectory.read_tum(tmp_path / "data.csv")
    assert counted_in(found) * found.timestamps[0] == pytest.approx(first, abs=1e-5)
    np.testing.assert_allclose(found.world_T_camera[0, :3, 3], [4.688, -1.786, 0.783])
    np.testing.assert_allclose(found.world_T_camera[0, :3, :3] @ [0, 1, 0], [0, 0.28, 0.96], atol=1e-12)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (EUROC + "1403636580938555648,4.688\n", r"data\.csv:4: expected 17 fields, as in the heading, found 2"),
        (ROSTOPIC, "contains no trajectory"),
        (ROSTOPIC + row(1, 2).replace("4.688", "north"), "data.csv:2: expected 8 numbers .*, found text"),
        (EUROC.replace("q_RS_w", "roll"), "expected 8 numbers"),
    ],
)
def test_rows_that_do_not_fit_their_heading_are_refused(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "data.csv").write_text(text)
    with pytest.raises(GavoError, match=words):
        Trajectory.read_tum(tmp_path / "data.csv")
