"""The page, in a real browser: what it shows, what a fault looks like, and what it never does."""

from __future__ import annotations

import http.client
import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from browser import Browser
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin, Subprotocol

from linkpose.cli.page import is_loopback
from linkpose.errors import LinkposeError
from linkpose.page import Page, Status, geometry
from linkpose.page.history import PATH_POINTS, SPAN_S, History, Replay
from linkpose.page.origin import is_own
from linkpose.sensors.rig import Rig

J2S_M = (-0.09, -0.04, 1.65)
LINK = ["time_s", *(f"tilt_{q}{std}_{unit}" for q, unit in (("height", "m"), ("roll", "deg"), ("pitch", "deg"))
                    for std in ("", "_std"))]  # fmt: skip
ROBOT = ["time_s", "mice_x_m", "mice_x_std_m", "mice_y_m", "mice_y_std_m", "mice_heading_rad", "mice_excluded"]


def link_rows(count: int = 200) -> np.ndarray:
    time = 0.05 * np.arange(count)
    roll, pitch = 25 * np.sin(0.9 * time), 18 * np.sin(1.3 * time)
    height = 1.65 * np.cos(np.radians(roll)) * np.cos(np.radians(pitch))
    std = np.ones(count)
    return np.column_stack([time, height, 0.02 * std, roll, 1.5 * std, pitch, 1.5 * std])


def status(imu: str = "ok") -> Callable[[], Status]:
    health: Any = SimpleNamespace(rate_hz=100.0, lost=0, sensors={"imu": {"state": imu}, "baro": {"state": "ok"}})
    return lambda: Status(health)


@pytest.fixture(scope="module")
def chromium() -> Iterator[Browser]:
    with Browser() as browser:
        yield browser


@pytest.fixture
def browser(chromium: Browser) -> Browser:
    chromium.console.clear()
    return chromium


def leave_without_error(browser: Browser) -> None:
    """Leaves the page before its server ends, and fails if the browser's console has an error."""
    browser.open("about:blank")
    assert browser.console == []


def button(name: str) -> str:
    return f"[...document.querySelectorAll('button')].find(e => e.innerText == '{name}')"


def test_the_page_shows_the_last_row_and_a_fault_in_red(browser: Browser, tmp_path: Path) -> None:
    rows, marks = link_rows(), list[float]()
    with Page(LINK, Rig().with_j2s(J2S_M), "sim://link", on_mark=marks.append) as page:
        page.show(rows, status())
        browser.open(page.url)
        browser.wait_for_text(f"{rows[-1, 1]:.4f} m ±2.0 cm")
        browser.wait_for_text("IMU ok")
        browser.wait_for("document.querySelectorAll('.uplot canvas').length == 3")
        page.show(np.empty(0), status(imu="not answering"))
        alarm = "[...document.querySelectorAll('[role=alert]')].find(e => e.innerText.includes('IMU NOT ANSWERING'))"
        browser.wait_for(alarm)
        assert browser.evaluate(f"getComputedStyle({alarm}).backgroundColor") == "rgb(201, 42, 42)"
        assert "IMU ok" not in browser.evaluate("document.body.innerText")
        browser.evaluate(f"{button('mark')}.click()")
        browser.wait_for_text("marks: 1")
        assert marks == [rows[-1, 0]]
        browser.evaluate(f"{button('stop')}.click()")
        assert page.stopped.wait(30)
        with pytest.raises(KeyboardInterrupt):
            page.raise_if_stopped()
        browser.screenshot(tmp_path / "page.png")
        leave_without_error(browser)


def test_a_robot_and_its_excluded_mouse(browser: Browser) -> None:
    time = 0.1 * np.arange(50)
    rows = np.column_stack([time, time, 0 * time + 0.01, 0.1 * time, 0 * time + 0.02, 0 * time, 2.0 * (time > 3.05)])
    with Page(ROBOT, Rig(), "sim://mice") as page:
        page.show(rows, status())
        browser.open(page.url)
        browser.wait_for_text("x 4.900 m ±1.0 cm")
        browser.wait_for_text("mouse 2 LEFT OUT since 3.1 s")
        leave_without_error(browser)


def test_a_file_is_played_to_its_end(browser: Browser) -> None:
    rows = link_rows(20)
    with Page(LINK, Rig().with_j2s(J2S_M), "e.csv", replay=Replay(rows)) as page:
        browser.open(page.url)
        browser.wait_for_text(f"{rows[-1, 1]:.4f} m")
        leave_without_error(browser)


def test_without_a_browser_nothing_waits_and_old_blocks_are_dropped() -> None:
    rows = link_rows()
    with Page(LINK, Rig(), "sim://link") as page:
        for _ in range(100):
            page.show(rows, status())
        assert page.url.startswith("http://127.0.0.1:")


def test_no_file_of_the_machine_is_served() -> None:
    with Page(LINK, Rig(), "sim://link") as page:
        host, port = page.url.removeprefix("http://").split(":")
        for path in ("/../../../../etc/passwd", "/%2e%2e/%2e%2e/%2e%2e/etc/passwd", "//etc/passwd", "/..%5c..%5cx"):
            connection = http.client.HTTPConnection(host, int(port), timeout=30)
            connection.request("GET", path)
            assert connection.getresponse().status == 404, path
            connection.close()


@pytest.mark.parametrize(
    ("host", "origin", "allowed"),
    [
        ("127.0.0.1:8080", None, True),  # a program
        ("127.0.0.1:8080", "http://127.0.0.1:8080", True),
        ("localhost:8080", "http://localhost:8080", True),
        ("[::1]:8080", "http://[::1]:8080", True),
        ("127.0.0.1:8080", "http://evil.example", False),
        ("127.0.0.1:8080", "http://127.0.0.1:9000", False),  # another program's page on this machine
        ("127.0.0.1:8080", "null", False),  # a file, a sandboxed frame
        ("evil.example:8080", "http://evil.example:8080", False),  # DNS rebinding
        ("evil.example:8080", None, False),
    ],
)
def test_only_the_page_itself_may_connect(host: str, origin: str | None, allowed: bool) -> None:
    headers = {"Host": host} | ({"Origin": origin} if origin is not None else {})
    assert is_own(headers, "127.0.0.1") == allowed


def test_another_page_cannot_connect() -> None:
    with Page(LINK, Rig(), "sim://link") as page:
        url = page.url.replace("http:", "ws:")
        with connect(url, origin=Origin(page.url), subprotocols=[Subprotocol("viser-v0")]):
            pass
        with pytest.raises(InvalidStatus) as refused, connect(url, origin=Origin("http://evil.example")):
            pass
        assert refused.value.response.status_code == 403


def test_addresses_that_cannot_be_used_are_refused() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(LinkposeError, match=r"cannot be served at 127\.0\.0\.1:\d+"):
            Page(LINK, Rig(), "", port=taken.getsockname()[1])
    with pytest.raises(LinkposeError, match=r"cannot be served at 192\.0\.2\.1"):
        Page(LINK, Rig(), "", host="192.0.2.1")
    assert is_loopback("127.0.0.1") and is_loopback("::1") and is_loopback("localhost")
    assert not is_loopback("0.0.0.0") and not is_loopback("192.0.2.1")


def test_view_options_go_with_what_they_need(refused: Callable[..., str], tmp_path: Path) -> None:
    assert "--view-host and --view-port go with --view" in refused("estimate", "--live", "--view-port", 8080)
    assert "--view goes with --live" in refused("estimate", tmp_path / "r.csv", "--view")
    assert "leave out --output" in refused("plot", "--view", tmp_path / "e.csv", "-o", tmp_path / "x.png")
    recording = tmp_path / "r.csv"
    recording.write_text("time_s,accel_x_m_s2\n0,1\n1,1\n")
    assert "holds no estimates" in refused("plot", "--view", recording)


def test_the_drawn_sensor_has_the_estimated_height() -> None:
    roll, pitch = 22.0, 13.0
    w, *v = geometry.attitude(roll, pitch, 40.0)
    d, v = np.array(J2S_M), np.array(v)
    turned = d + 2 * w * np.cross(v, d) + 2 * np.cross(v, np.cross(v, d))
    r, p = np.radians(roll), np.radians(pitch)
    vertical = np.array([-np.sin(p), np.cos(p) * np.sin(r), np.cos(p) * np.cos(r)])  # host/docs/files.md
    assert turned[2] == pytest.approx(vertical @ d)


def test_the_cone_is_as_wide_as_two_sigma() -> None:
    assert geometry.cone_radius(1.0, 5.0) == pytest.approx(np.tan(np.radians(10.0)))
    assert geometry.cone_radius(1.0, np.nan) == 0.0
    assert np.isfinite(geometry.cone_radius(1.0, 180.0))


def test_history_keeps_the_newest_row_and_stays_small() -> None:
    history = History(["time_s", "x_m"])
    for at in range(50_000):
        history.add(np.array([0.01 * at, float(at)]))
    window, path = history.window(), history.path()
    assert window[-1, 1] == path[-1, 1] == 49_999
    assert window[0, 0] >= window[-1, 0] - SPAN_S and len(window) > 300
    assert path[0, 1] == 0 and len(path) <= PATH_POINTS + 2
