"""The page, in a real browser: what it shows, what a fault looks like, and what it never does."""

from __future__ import annotations

import base64
import contextlib
import http.client
import json
import os
import signal
import socket
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
import zstandard
from browser import Browser
from websockets.exceptions import InvalidStatus
from websockets.frames import Frame, Opcode
from websockets.protocol import State
from websockets.streams import StreamReader
from websockets.sync.client import connect
from websockets.typing import Origin, Subprotocol

from linkpose.cli.page import is_loopback
from linkpose.errors import LinkposeError
from linkpose.estimation import FoundJ2s
from linkpose.localization.surroundings import Surroundings
from linkpose.page import Page, PageStatus, geometry
from linkpose.page.changes import Changes, uncompressed_frame, websocket_frame
from linkpose.page.history import PATH_POINTS, POINT_INTERVAL_S, SPAN_S, History
from linkpose.page.origin import is_own
from linkpose.page.page import j2s_text, reachable_address
from linkpose.page.panel import with_gap_rows
from linkpose.quantities import by_filter
from linkpose.rotations import product
from linkpose.sensors.rig import Rig
from linkpose.simulation.chain import ChainRun

J2S_M = (-0.09, -0.04, 1.65)
LINK = ["time_s", *(f"tilt_{q}{std}_{unit}" for q, unit in (("height", "m"), ("roll", "deg"), ("pitch", "deg"))
                    for std in ("", "_std"))]  # fmt: skip
CHAIN = ["time_s", "tilt_roll_deg", "tilt_pitch_deg", "chain_qw", "chain_qx", "chain_qy", "chain_qz",
         "chain_rotation_std_deg", "chain_angle_deg", "chain_angle_std_deg"]  # fmt: skip
HOST = Path(__file__).parents[2] / "host"
# A robot's tilt filter has a column of the height, without a value: J2S is unknown.
ROBOT = [
    "time_s",
    "tilt_height_m",
    "tilt_roll_deg",
    "mice_x_m",
    "mice_x_std_m",
    "mice_y_m",
    "mice_y_std_m",
    "mice_heading_rad",
    "mice_excluded",
]


def link_rows(count: int = 200) -> np.ndarray:
    time = 0.05 * np.arange(count)
    roll, pitch = 25 * np.sin(0.9 * time), 18 * np.sin(1.3 * time)
    height = 1.65 * np.cos(np.radians(roll)) * np.cos(np.radians(pitch))
    std = np.ones(count)
    return np.column_stack([time, height, 0.02 * std, roll, 1.5 * std, pitch, 1.5 * std])


def status(imu: str = "ok") -> Callable[[], PageStatus]:
    sensors = {"imu": {"state": imu}, "baro": {"state": "ok"}}
    health: Any = SimpleNamespace(rate_hz=100.0, lost=0, sensors=sensors, silent_s=0.0)
    return lambda: PageStatus(health)


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


def chart_data(title: str) -> str:
    """JavaScript for the data of the chart with this title; uPlot draws a gap where there is null."""
    return (
        f"Object.values(window.__viserTestpoints.uplots).map(e => e.chart)"
        f".find(e => e.root.parentElement.parentElement.innerText.includes('{title}')).data"
    )


# Pixels that a long label of a chart's y axis takes, and those that it has.
LABEL_SPACE = """(() => {
  const chart = Object.values(window.__viserTestpoints.uplots)[0].chart, axis = chart.axes[1];
  chart.ctx.font = axis.font[0];
  return [chart.ctx.measureText("-0.0025").width / window.devicePixelRatio, axis._size - axis.ticks.size - axis.gap];
})()"""


def test_the_page_shows_the_last_row_and_a_fault_in_red(browser: Browser, tmp_path: Path) -> None:
    rows = link_rows()
    rows = np.delete(rows, slice(100, 140), axis=0)  # a pulled cable: 2 s without samples
    rows[-40:-30, 1:] = np.nan
    rows[:5, 2] = 5.0  # of a filter that has just started
    with Page(LINK, Rig().with_j2s(J2S_M), "sim://link") as page:
        page.show(rows, status())
        browser.open(page.url)
        browser.wait_for_text(f"{rows[-1, 1]:.3f} m ±2.0 cm")
        browser.wait_for_text("IMU ok")
        browser.wait_for("document.querySelectorAll('.uplot canvas').length == 3")
        browser.wait_for(f"{chart_data('height')}[3].length > 150")
        time, *_, height = browser.evaluate(f"{chart_data('height')}.slice(0, 4).map(e => [...e])")
        missing = [at for at, value in zip(time, height, strict=True) if value is None]
        band = browser.evaluate(f"[...{chart_data('height')}[2]]")
        assert max(filter(None, band)) < 2.0
        assert len(missing) == 11 and rows[99, 0] < missing[0] < rows[100, 0]
        page.show(np.empty(0), status(imu="silent"))
        alarm = "[...document.querySelectorAll('[role=alert]')].find(e => e.innerText.includes('IMU NOT ANSWERING'))"
        browser.wait_for(alarm)
        assert browser.evaluate(f"getComputedStyle({alarm}).backgroundColor") == "rgb(201, 42, 42)"
        text = browser.evaluate("document.body.innerText")
        assert "IMU ok" not in text and "not known" in text and "m ±2.0 cm" not in text
        found = FoundJ2s.of(np.array([0.0, 0.0, 1.6]), np.diag([1e-6, 1e-6, 0.04]))
        page.show(np.empty(0), lambda: PageStatus(status()().health, found))
        browser.wait_for_text("not excited yet: J2S along the sensor's z axis. Turn the link about x or y.")
        browser.open("about:blank")  # and back: the page goes on
        page.restart(rows + np.array([0.0, 0.1, *[0.0] * 5]))  # a better filter has caught up
        browser.open(page.url)
        browser.wait_for_text("not excited yet")
        browser.wait_for_text(f"{rows[-1, 1] + 0.1:.3f} m ±2.0 cm")
        browser.wait_for(f"{chart_data('height')}[3].length > 150")
        assert browser.evaluate(f"{chart_data('height')}[3][5]") == pytest.approx(rows[5, 1] + 0.1)
        browser.screenshot(tmp_path / "page.png")
        leave_without_error(browser)


# Frames that the client draws while the browser has 30, with a clock that stands still: what draws for a while goes on.
STOP_THE_CLOCK = "(() => { const later = performance.now() + 1e6; performance.now = () => later; })()"
SCENE = "window.__viserMutable.scene.__r3f.root.getState()"
FRAMES_OF_30 = f"""new Promise(resolve => {{
  const counted = {SCENE}.gl.info.render, before = counted.frame;
  const next = left => left ? requestAnimationFrame(() => next(left - 1)) : resolve(counted.frame - before);
  next(30);
}})"""
# The width of the cone as drawn: three.js computes this matrix when it draws.
CONE_RADIUS = """(() => {
  let mesh;
  window.__viserMutable.nodeRefFromName["/link/cone"].traverse(part => { mesh = mesh || (part.isMesh && part); });
  return Math.hypot(...mesh.matrixWorld.elements.slice(0, 3));
})()"""
NEW_NODE = """new Promise(resolve => {
  const look = () => "/new" in window.__viserMutable.nodeRefFromName ? resolve() : requestAnimationFrame(look);
  look();
})"""


def test_without_a_graphics_card_an_update_takes_one_frame(browser: Browser) -> None:
    """viser draws for 250 ms after each change: always, at the rate of the screen, and new values wait for it."""
    rows = link_rows()
    with Page(LINK, Rig().with_j2s(J2S_M), "sim://link") as page:
        page.show(rows[:50], status())
        browser.open(page.url)
        browser.wait_for_text(f"{rows[49, 1]:.3f} m ±2.0 cm")
        browser.wait_for("Object.keys(window.__viserTestpoints?.uplots ?? {}).length == 3")
        page._has_ended = True  # the updates are made here
        browser.evaluate(STOP_THE_CLOCK)
        rows[60, [4, 6]] = 10.0
        page.show(rows[60], status())
        page._loop.call_soon_threadsafe(page._redraw)
        page._loop.call_soon_threadsafe(page._update)
        browser.wait_for_text(f"{rows[60, 1]:.3f} m ±2.0 cm")
        assert browser.evaluate(FRAMES_OF_30) < 15
        length = float(np.linalg.norm(J2S_M))
        assert browser.evaluate(CONE_RADIUS) == pytest.approx(geometry.cone_radius(length, 10.0), rel=1e-3)
        assert browser.evaluate("window.__viserMutable.backgroundMaterial.visible") is False
        page._server.scene.add_icosphere("/new")  # viser's way: such a change is complete only after a while
        browser.evaluate(NEW_NODE)
        assert browser.evaluate(FRAMES_OF_30) > 25
        leave_without_error(browser)


@contextlib.contextmanager
def command(*typed: object) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """linkpose in a process of its own, and the address of the page that it serves."""
    process = subprocess.Popen(
        [sys.executable, "-m", "linkpose", *map(str, typed)],
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(HOST)},
    )
    assert process.stderr is not None
    try:
        lines = []
        for line in process.stderr:
            lines.append(line)
            if line.startswith("page: "):
                yield process, line.removeprefix("page: ").strip()
                break
        else:
            raise AssertionError("".join(lines))
    finally:
        process.kill()
        process.wait()
        process.stderr.close()


def test_a_recording_is_watched_marked_and_stopped(browser: Browser, tmp_path: Path) -> None:
    recording = tmp_path / "r.csv"
    with command("record", recording, "--view", "--port", "sim://link") as (process, url):
        browser.open(url)
        browser.wait_for_text("height over the joint, ")
        browser.evaluate(f"{button('mark')}.click()")
        browser.wait_for_text("marks: 1")
        browser.evaluate(f"{button('stop')}.click()")
        assert process.wait(60) == 0
        browser.wait_for_text("measurement ended")
    closing = json.loads(recording.read_text().splitlines()[-1].removeprefix("# "))
    assert len(closing["marks"]) == 1 and closing["ended"] == "interrupted"
    browser.open("about:blank")


def robot_file(path: Path) -> None:
    """An estimate of `localize` along a line, with correlated x and y and a stretch of unknown poses."""
    names = ["time_s", "ekf_x_m", "ekf_y_m", "ekf_heading_rad", "ekf_x_std_m", "ekf_y_std_m", "ekf_cov_x_m_y_m"]
    rows = [[0.1 * at, 0.1 * at, 0.05 * at, 0.4, 0.1, 0.2, 0.01] for at in range(15)]
    text = [",".join("" if 5 <= at < 8 and column else f"{v:.6f}" for column, v in enumerate(row))
            for at, row in enumerate(rows)]  # fmt: skip
    path.write_text("\n".join([",".join(names), *text, ""]))


def test_a_path_is_played_among_map_and_beacons(browser: Browser, tmp_path: Path) -> None:
    estimate, truth = tmp_path / "path.csv", tmp_path / "truth.csv"
    robot_file(estimate)
    truth.write_text("time_s,x_m,y_m,heading_rad\n0,0,0,0.4\n1.4,1.4,0.7,0.4\n")
    image, grid, beacons = tmp_path / "m.pgm", tmp_path / "m.yaml", tmp_path / "b.csv"
    image.write_bytes(b"P5 4 4 255\n" + bytes([0] * 4 + [254] * 12))
    grid.write_text("image: m.pgm\nresolution: 1\norigin: [0, 0, 0]\nnegate: 0\n"
                    "occupied_thresh: 0.65\nfree_thresh: 0.2\n")  # fmt: skip
    beacons.write_text("id,x_m,y_m\nA,1,3\n")
    with command("plot", "--view", estimate, truth, "--map", grid, "--beacons", beacons) as (process, url):
        browser.open(url)
        browser.wait_for_text("x 1.400 m ±10.0 cm")
        browser.wait_for_text("heading +22.9°")
        browser.screenshot(tmp_path / "path.png")
        leave_without_error(browser)
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 0


def test_localize_shows_the_path_that_it_found(browser: Browser, tmp_path: Path) -> None:
    log, beacons, truth = (tmp_path / name for name in ("log.csv", "b.csv", "truth.csv"))
    at = 0.1 * np.arange(60)
    log.write_text("time_s,kind,a,b,c\n" + "".join(
        f"{t:.2f},odometry,1,0,\n{t:.2f},range,A,{np.hypot(t - 3, 2):.4f},\n{t:.2f},range,B,{np.hypot(t, 4):.4f},\n"
        for t in at
    ))  # fmt: skip
    beacons.write_text("id,x_m,y_m\nA,3,2\nB,0,-4\n")
    truth.write_text("time_s,x_m,y_m,heading_rad\n0,0,0,0\n5.9,5.9,0,0\n")
    typed = ["localize", log, "--beacons", beacons, "--truth", truth, "--start", "0,0,0", "--view"]
    typed += ["--plot", tmp_path / "path.html"]
    with command(*typed) as (process, url):
        browser.open(url)
        browser.wait_for_text("place and heading, ekf")
        browser.wait_for_text("5.9 s")
        x_m = float(browser.evaluate("document.body.innerText.match(/x (\\d\\.\\d+) m ±/)[1]"))
        assert "__VISER_EMBED_DATA__" in (tmp_path / "path.html").read_text()
        assert x_m == pytest.approx(5.9, abs=0.1)
        browser.screenshot(tmp_path / "localize.png")
        leave_without_error(browser)
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 0


def test_a_robot_and_its_excluded_mouse_and_a_chain(browser: Browser) -> None:
    time = 0.1 * np.arange(50)
    tilt = [np.full(50, np.nan), 0 * time]
    rows = np.column_stack(
        [time, *tilt, time, 0 * time + 0.01, 0.1 * time, 0 * time + 0.02, 0 * time, 2.0 * (time > 3.05)]
    )
    with Page(ROBOT, Rig(), "sim://mice") as page:
        page.show(rows, status())
        browser.open(page.url)
        browser.wait_for_text("x 4.900 m ±1.0 cm")
        browser.wait_for_text("mouse 2 LEFT OUT since 3.1 s")
        browser.wait_for(f"{chart_data('heading (°)')}[3].length == 50")
        browser.wait_for("document.querySelectorAll('.uplot canvas').length == 3")
        label, space = browser.evaluate(LABEL_SPACE)
        assert label <= space  # of a label in hundredths of a degree, whose sign would be cut
        rows[-1, 8] = 0.0
        page.show(rows[-1], status())
        page.close()  # the last row is drawn everywhere
        browser.wait_for_text("measurement ended")
        leave_without_error(browser)
    angle = np.radians(30.0)
    chain = np.array([[0.0, 20.0, 10.0, np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0, 1.5, 30.0, 1.2]])
    with Page(CHAIN, ChainRun("hinge").calibrated_rig, "sim://chain") as page:
        page.show(chain, status())
        browser.open(page.url)
        browser.wait_for_text("+30.0° ±1.2°")
        leave_without_error(browser)


def scene_node(page: Page, name: str) -> Any:
    return page._server.scene._handle_from_node_name[name]


def test_the_view_widens_for_a_robot_that_leaves_it() -> None:
    """A browser's camera goes along unless the user has moved it."""
    columns = ["time_s", "mice_x_m", "mice_y_m", "mice_heading_rad"]
    with Page(columns, Rig(), "sim://mice") as page:
        page._has_ended = True  # the updates are made here
        start = page._server.initial_camera.position
        following, moved = (
            SimpleNamespace(camera=SimpleNamespace(position=place, look_at=page._server.initial_camera.look_at))
            for place in (start, start + 1.0)
        )
        page._server.get_clients = lambda: {1: following, 2: moved}  # type: ignore[method-assign, dict-item]
        for x in (1.0, 2.9, 9.0):
            page._redraw()
            page.show(np.array([x, x, 0.5, 0.0]), status())
            page._update()
            if x < 3.0:
                assert np.array_equal(following.camera.position, start)
        x, y, height = following.camera.position
        assert x == pytest.approx(5.0) and y < 0.0 and height == pytest.approx(0.75 * 1.5 * 8.0)
        assert np.allclose(following.camera.look_at, [5.0, 0.5, 0.0])
        assert np.allclose(page._server.initial_camera.position, following.camera.position)
        assert np.array_equal(moved.camera.position, start + 1.0)
        assert scene_node(page, "/ground").width == pytest.approx(1.5 * 1.5 * 8.0)


def test_beacons_below_the_path_are_drawn_on_the_ground() -> None:
    around = Surroundings(beacons={"A": [1.0, 2.0, -18.0], "B": [3.0, 4.0, 2.5]})
    columns = ["time_s", "ekf_x_m", "ekf_y_m", "ekf_heading_rad"]
    with Page(columns, Rig(), "sea.csv", surroundings=around) as page:
        assert scene_node(page, "/beacon/A").position.tolist() == [1.0, 2.0, 0.0]
        assert scene_node(page, "/beacon/B").position.tolist() == [3.0, 4.0, 2.5]


def test_an_estimate_becomes_a_file_that_plays_it(browser: Browser, tmp_path: Path, linkpose: Any) -> None:
    """A robot's tilt filter has columns of the height without a value: the robot is drawn, not a link."""
    estimate = tmp_path / "e.csv"
    rows = [f"{0.1 * at:.1f},,{0.1 * at:.2f},0.5,0.1\n" for at in range(20)]
    estimate.write_text("time_s,tilt_height_m,mice_x_m,mice_y_m,mice_heading_rad\n" + "".join(rows))
    assert linkpose("plot", estimate, "-o", tmp_path / "e.html").status == 0
    text = (tmp_path / "e.html").read_text()
    assert "<title>linkpose</title>" in text
    payload = base64.b64decode(text.split('__VISER_EMBED_DATA__="')[1].split('"')[0])
    inner = zstandard.ZstdDecompressor().decompress(payload[8:], int.from_bytes(payload[:8], "little"))
    recorded = msgspec.msgpack.decode(inner[8 : 8 + int.from_bytes(inner[:8], "little")])
    assert recorded["durationSeconds"] == pytest.approx(1.9)
    places = [m["position"] for _, m in recorded["messages"] if m.get("name") == "/robot" and "position" in m]
    assert places[-1][:2] == pytest.approx([1.9, 0.5])
    browser.open((tmp_path / "e.html").as_uri())
    browser.wait_for("!!document.querySelector('canvas') && !!document.querySelector('input')")
    leave_without_error(browser)
    assert linkpose("plot", estimate, "-o", tmp_path / "e.gif").status == 2
    refused = linkpose("evaluate", estimate, estimate, "--plot", tmp_path / "e.html")
    assert refused.status == 2 and "`linkpose plot ESTIMATE.csv -o FILE.html` plays" in refused.err


def test_what_is_not_excited_yet_is_shown() -> None:
    found = FoundJ2s.of(np.array([0.0, 0.0, 1.6]), np.diag([1e-6, 1e-6, 0.04]))
    assert j2s_text(found) == (
        "J2S 1.600 m ±200 mm; not excited yet: J2S along the sensor's z axis. Turn the link about x or y."
    )
    assert j2s_text(FoundJ2s.of(np.array([0.0, 0.0, 1.6]), 1e-6 * np.eye(3))) == "J2S 1.600 m ±1 mm"


def test_a_gap_in_time_becomes_a_row_without_values() -> None:
    rows = np.column_stack([[0.0, 0.1, 0.2, 1.2, 1.3], np.arange(5.0)])
    with_gap = with_gap_rows(rows)
    assert with_gap[:, 0].tolist() == pytest.approx([0.0, 0.1, 0.2, 0.7, 1.2, 1.3])
    assert np.isnan(with_gap[3, 1]) and np.isfinite(with_gap[:, 1]).sum() == 5
    path = geometry.polyline(np.array([[0, 0, 0], [1, 0, 0], [np.nan] * 3, [2, 0, 0], [3, 0, 0]], float))
    assert path[:, :, 0].tolist() == [[0, 1], [2, 3]]


def test_an_ellipse_of_two_sigma_is_turned_by_the_covariance() -> None:
    segments = geometry.ellipse(np.array([1.0, 2.0, 0.0, 0.1, 0.1, 0.0099]), 0.0)
    points = segments[:, 0, :2] - [1.0, 2.0]
    along, across = points @ [np.sqrt(0.5), np.sqrt(0.5)], points @ [np.sqrt(0.5), -np.sqrt(0.5)]
    assert np.abs(along).max() == pytest.approx(2 * np.sqrt(0.0199), rel=0.01)
    assert np.abs(across).max() == pytest.approx(2 * np.sqrt(0.0001), rel=0.01)


def test_a_covariance_is_no_quantity_of_a_filter() -> None:
    """Its column ends as that of y does."""
    assert list(by_filter(["ekf_x_m", "ekf_y_m", "ekf_cov_x_m_y_m", "ekf_cov_x_m_heading_rad"])) == ["ekf"]


def test_without_a_browser_nothing_waits_and_old_blocks_are_dropped() -> None:
    rows = link_rows()
    with Page(LINK, Rig(), "sim://link") as page:
        for _ in range(100):
            page.show(rows, status())
        page.stopped.set()
        with pytest.raises(KeyboardInterrupt):
            page.raise_if_stopped()
        assert page.url.startswith("http://127.0.0.1:")


def connection(waiting: Callable[[], int], write: Callable[[bytes], None], state: State = State.OPEN) -> Any:
    """A browser that has not read `waiting()` bytes yet."""
    transport = SimpleNamespace(get_write_buffer_size=waiting, write=write)
    return SimpleNamespace(transport=transport, protocol=SimpleNamespace(state=state))


def test_a_browser_that_reads_nothing_gets_no_more_until_it_does() -> None:
    sent: list[int] = []
    waiting = {1: 0, 2: 1_000_000, 3: 0}  # bytes that each browser has not read
    connections = {
        client: connection(
            partial(waiting.__getitem__, client),
            lambda _, client=client: sent.append(client),  # type: ignore[misc]
            State.CLOSING if client == 3 else State.OPEN,
        )
        for client in waiting
    }
    server: Any = SimpleNamespace(_websock_server=SimpleNamespace(_live_connections=connections))
    element: Any = SimpleNamespace(_impl=SimpleNamespace(uuid="text"))
    changes = Changes(server)
    for left in (1_000_000, 0):
        waiting[2] = left
        changes.write(element, "1.5 m")
        changes.broadcast({1, 2, 3})
    assert sent == [1, 1, 2]


@pytest.mark.parametrize("size", [1, 735, 1 << 17, (1 << 17) + 1, 300_000])
def test_messages_travel_as_zstd_frames_without_compression(size: int) -> None:
    data = np.random.default_rng(1).bytes(size)
    frame = uncompressed_frame(data)
    assert zstandard.ZstdDecompressor().decompress(frame) == data
    assert zstandard.frame_content_size(frame) == size


@pytest.mark.parametrize("size", [1, 125, 126, 65_535, 65_536, 300_000])
def test_messages_travel_in_frames_of_a_server(size: int) -> None:
    data = np.random.default_rng(1).bytes(size)
    reader = StreamReader()
    reader.feed_data(websocket_frame(data))
    parsing = Frame.parse(reader.read_exact, mask=False)
    with pytest.raises(StopIteration) as parsed:
        next(parsing)
    assert parsed.value.value == Frame(Opcode.BINARY, data)
    assert len(reader.buffer) == 0


def decoded(message: bytes) -> tuple[list[dict[str, Any]], Callable[[dict[str, Any]], list[float]]]:
    """The messages of viser in one of the server, and a function that reads the array of a placeholder."""
    text_size, frame_size = struct.unpack_from("<QQ", message)
    text = zstandard.ZstdDecompressor().decompress(message[16 : 16 + frame_size])
    assert len(text) == text_size
    content, starts, at = msgspec.msgpack.decode(text), [], 16 + frame_size
    for length in content["binaryBufferLengths"]:
        at += -at % 8
        starts.append(at)
        at += length

    def array(of: dict[str, Any]) -> list[float]:
        index, kind = of["__binary_index"], np.dtype(of["dtype"])
        count = content["binaryBufferLengths"][index] // kind.itemsize
        return list(np.frombuffer(message, kind, count, starts[index]))

    return content["messages"], array


def test_each_update_has_the_newest_row_and_some_have_the_charts() -> None:
    """A sample waits for one update on its way to the screen; charts, which are large, may be later."""
    rows, sent = link_rows(), []
    with Page(LINK, Rig().with_j2s(J2S_M), "sim://link") as page:
        page._has_ended = True  # the updates are made here, from a full one on
        page._redraw()
        page._server.get_clients = lambda: {7: None}  # type: ignore[method-assign, dict-item]
        browser = connection(lambda: 0, lambda frame: sent.append(decoded(frame[4 if frame[1] == 126 else 10 :])))
        page._changes._socket._live_connections = {7: browser}
        for row in rows[:20]:
            page.show(row, status())
            page._update()
    assert len(sent) == 20
    for row, (messages, _) in zip(rows, sent, strict=False):
        assert any(f"{row[1]:.3f} m ±2.0 cm" in str(m.get("updates")) for m in messages)
        turn = next(m["wxyz"] for m in messages if m.get("name") == "/link" and "wxyz" in m)
        assert turn == pytest.approx(geometry.attitude(row[3], row[5], 0.0))
    charts = [[(array, m["updates"]["data"]) for m in messages if "data" in str(m)] for messages, array in sent]
    # All with the first row, to whom opens the page; then one an update, from the one after the tenth row on.
    assert [len(of_update) for of_update in charts] == [3] + 9 * [0] + 3 * [1] + 6 * [0] + [1]
    array, (time, low, high, height) = charts[19][0]
    assert array(time) == pytest.approx(rows[:19, 0])
    assert array(height) == pytest.approx(rows[:19, 1])
    assert np.subtract(array(high), array(low)) == pytest.approx(0.08 * np.ones(19), rel=1e-4)


def test_charts_end_where_a_filter_lost_its_sensor() -> None:
    """What it predicts after that is blank in numbers, too."""
    rows, sent = link_rows(40), []
    with Page(LINK, Rig().with_j2s(J2S_M), "sim://link") as page:
        page._has_ended = True
        page._redraw()
        page._server.get_clients = lambda: {7: None}  # type: ignore[method-assign, dict-item]
        browser = connection(lambda: 0, lambda frame: sent.append(decoded(frame[4 if frame[1] == 126 else 10 :])))
        page._changes._socket._live_connections = {7: browser}
        page.show(rows, status())
        failed = status(imu="silent")()
        assert failed.health is not None
        failed.health.sensors["imu"]["since_s"], failed.health.duration_s = rows[25, 0], rows[-1, 0]  # type: ignore[misc]
        page.show(rows[-1] + np.array([0.05, *[0.0] * 6]), lambda: failed)
        page.show(np.empty(0), lambda: failed)
        page._update()
        ((messages, _),) = sent
        _, _, _, height = next(m["updates"]["data"] for m in messages if "data" in str(m))
    assert height[:25] == pytest.approx(rows[:25, 1]) and height[25:] == [None] * 16


def test_an_error_of_the_sender_ends_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_: Page) -> None:
        raise RuntimeError("cannot draw")

    monkeypatch.setattr(Page, "_update", fail)
    with Page(LINK, Rig(), "sim://link") as page, pytest.raises(RuntimeError, match="cannot draw"):
        while True:
            page.raise_if_stopped()


def test_no_file_of_the_machine_is_served_and_the_page_has_its_title() -> None:
    with Page(LINK, Rig(), "sim://link") as page:
        host, port = page.url.removeprefix("http://").split(":")
        connection = http.client.HTTPConnection(host, int(port), timeout=30)
        connection.request("GET", "/", headers={"Accept-Encoding": "gzip"})
        assert b"<title>linkpose</title>" in connection.getresponse().read()
        connection.close()
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
    # What a browser on another machine can open; "all addresses" is no place to go to.
    assert reachable_address("127.0.0.1") == "127.0.0.1" and reachable_address("localhost") == "localhost"
    for anywhere in ("0.0.0.0", "::"):
        assert reachable_address(anywhere) not in ("0.0.0.0", "::", "")
    assert is_loopback("127.0.0.1") and is_loopback("::1") and is_loopback("localhost")
    assert not is_loopback("0.0.0.0") and not is_loopback("192.0.2.1")


def test_view_options_go_with_what_they_need(refused: Callable[..., str], tmp_path: Path) -> None:
    assert "--view-host and --view-port go with --view" in refused("estimate", "--live", "--view-port", 8080)
    assert "--view goes with --live" in refused("estimate", tmp_path / "r.csv", "--view")
    assert "leave out --output" in refused("plot", "--view", tmp_path / "e.csv", "-o", tmp_path / "x.png")
    recording = tmp_path / "r.csv"
    recording.write_text("time_s,accel_x_m_s2\n0,1\n1,1\n")
    assert "holds no estimates; type: linkpose estimate" in refused("plot", "--view", recording)
    truth = tmp_path / "truth.csv"
    truth.write_text("time_s,height_m\n0,1\n1,1\n")  # of no use to `estimate`
    assert "name a file of estimates as well" in refused("plot", "--view", truth)
    assert "holds no estimates" in refused("plot", "--view", recording, "--view-host", "[::1]")  # is an address
    for mistaken in ("127.0.0.1:9000", "http://localhost", ""):
        assert "--view-port names the port" in refused("plot", "--view", recording, "--view-host", mistaken)


def test_the_drawn_sensor_has_the_estimated_height() -> None:
    roll, pitch = 22.0, 13.0
    w, *part = geometry.attitude(roll, pitch, 40.0)
    d, v = np.array(J2S_M), np.array(part)
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
    for at in range(0, 50_000, 50):
        history.add(np.array([[0.01 * row, float(row)] for row in range(at, at + 50)]))
    window, path = history.window(), history.path()
    assert window[-1, 1] == path[-1, 1] == 49_999
    assert window[0, 0] >= window[-1, 0] - SPAN_S and len(window) > 300
    assert path[0, 1] == 0 and len(path) <= PATH_POINTS + 2


def test_rows_that_share_a_pixel_are_replaced_however_they_arrive() -> None:
    """The newest row stands for those less than 0.05 s after the row before."""
    time_s = np.cumsum(np.random.default_rng(2).choice([0.01, 0.01, 0.01, 0.07], 300))
    rows = np.column_stack([time_s, np.arange(300.0)])
    expected: list[np.ndarray] = []
    for row in rows:
        if len(expected) > 1 and row[0] - expected[-2][0] < POINT_INTERVAL_S:
            expected[-1] = row
        else:
            expected.append(row)
    for size in (1, 7, 300):
        history = History(["time_s", "x_m"])
        for at in range(0, 300, size):
            history.add(rows[at : at + size])
        assert history.window().tolist() == np.array(expected).tolist()


def test_a_connection_that_a_browser_leaves_unused_prints_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    with Page(LINK, Rig(), "sim://link") as page:
        host, port = page.url.removeprefix("http://").split(":")
        for sent in (b"", b"no request\r\n\r\n"):
            with socket.create_connection((host, int(port)), timeout=30) as unused:
                unused.sendall(sent)
                unused.shutdown(socket.SHUT_WR)
                while unused.recv(4096):  # until the server has given up
                    pass
    assert capfd.readouterr() == ("", "")


def test_turns_follow_each_other_as_their_product() -> None:
    first, second = (np.array(geometry.attitude(*angles)) for angles in ((10.0, 0.0, 30.0), (-20.0, 40.0, 5.0)))
    vector = np.array([0.3, -1.0, 2.0])
    one_by_one = geometry.turned(first, geometry.turned(second, vector))
    assert geometry.turned(product(first, second), vector) == pytest.approx(one_by_one)
    assert geometry.turned(np.array(geometry.attitude(0.0, 0.0, 90.0)), np.eye(3)[0]) == pytest.approx(np.eye(3)[1])
