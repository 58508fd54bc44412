"""Mice all the way: a simulated robot, bits on PS/2 lines, the firmware, a port, `linkpose`, velocities."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from measuring import MICE
from pty_server import PatientClock, PtyServer
from rig_signals import RigFeed
from test_end_to_end import linkpose, rms
from wire_link import WireLink

from linkpose.recording.table import read_table
from linkpose.simulation.mice import MiceRun


def test_live_velocities_from_three_mice(board: Callable[..., WireLink], tmp_path: Path) -> None:
    """A robot at up to 0.5 m/s: within 2 cm/s of the truth, at the shift in time that fits best."""
    run = MiceRun(seed=2, duration_s=None)
    rig, out = tmp_path / "rig.toml", tmp_path / "out.csv"
    rig.write_text(run.rig.to_toml())
    uno = board(mice=MICE[:3]).uno
    uno.run_ms(1000)  # the mice have had their power for a while when a host opens the port
    feed = RigFeed(uno, run)
    port = tmp_path / "port"
    with PtyServer(uno, port, on_slice=feed.supply, on_open=feed.restart, clock=PatientClock()):
        source = ["--live", "--port", port, "--duration", 5]
        done = linkpose("estimate", *source, "--filter", "mice", "--rig", rig, "-o", out)
    assert done.returncode == 0, done.stderr
    columns = read_table(out, "estimate").columns
    time_s, vx = columns["time_s"], columns["mice_vx_m_s"]
    settled = time_s > 1.5  # the mice are set up by then
    assert np.isfinite(vx[settled]).all()
    shifts = np.arange(0.0, 20.0, 0.005)  # from the board's reset to the stream, with a slow host
    errors = [rms(vx[settled] - run.at(time_s[settled] + shift).vx_m_s) for shift in shifts]
    assert min(errors) < 0.02
    assert rms(vx[settled]) > 5 * min(errors)
