"""The protocol page lets a stranger write a board: linkpose runs with one that was written from the page."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from page_board import SCHEMA_CRC, PageBoard
from pty_board import PtyBoard

import linkpose as lp
from linkpose.device.session import Session
from linkpose.errors import LinkposeError
from linkpose.wire.messages import Configure

pytestmark = pytest.mark.skipif(not hasattr(os, "openpty"), reason="pseudo terminals are Unix's")


def test_the_page_states_the_schema_of_the_board() -> None:
    page = (Path(__file__).parents[2] / "protocol" / "README.md").read_text(encoding="utf-8")
    assert f"{SCHEMA_CRC:#x}" in page.lower()


def test_a_board_written_from_the_page_is_recorded_and_estimated(tmp_path: Path, linkpose: Callable) -> None:
    port, out = tmp_path / "port", tmp_path / "r.csv"
    with PtyBoard(port, make=PageBoard):
        done = linkpose("record", out, "--port", port, "--duration", "1.2", "--rate", "200", "--accel-range", "4")
        assert done.status == 0 and "0 lost, 0 corrupt" in done.err, done
        with Session(str(port), print) as session, pytest.raises(LinkposeError, match="refused CONFIGURE: dlpf"):
            session.configure(Configure(100, 8, 1000, 7, 1, 8, 400))
    recording = lp.load(out)
    assert not recording.remarks and len(recording.measurements) == 240
    assert {name: of["state"] for name, of in recording.health.items()} == {"imu": "ok", "baro": "ok", "mouse1": "ok"}
    assert recording.measurements.pressure_Pa[-1] == pytest.approx(69_964, abs=60)  # the data sheet's example
    estimates = lp.estimate(recording, filters=["tilt"], j2s_m=(0.0, 0.0, 1.0))
    assert np.isfinite(estimates["tilt_height_m"]).all()
