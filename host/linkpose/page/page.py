"""`Page`: estimates in a browser, while they are made or from a file."""

from __future__ import annotations

import errno
import math
import socket
import threading
from collections import deque
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from linkpose import quantities
from linkpose.errors import LinkposeError
from linkpose.exclusions import Exclusions
from linkpose.filters import required_sensors
from linkpose.localization.surroundings import Surroundings
from linkpose.page.changes import Changes
from linkpose.page.drawing import Drawing
from linkpose.page.history import History, Replay
from linkpose.page.origin import own_requests_only
from linkpose.page.status import PageStatus
from linkpose.presentation import fault_lines, lost_filters, lost_since, working_sensors
from linkpose.sensors.measurements import Floats
from linkpose.sensors.rig import Rig

if TYPE_CHECKING:
    import viser

    from linkpose.device.session import Health
    from linkpose.estimation import FoundJ2s

LOOPBACK = "127.0.0.1"
FIRST_PORT = 8080
# Seconds between two updates of the page. A sample waits that long at most, a browser needs up to 45 ms more for the
# frame that it draws and the next one, and the sum is to stay below 0.1 s. An update costs about half a millisecond of
# CPU (tests/bench/page.py).
UPDATE_INTERVAL_S = 0.055
CHART_INTERVAL = 9  # updates between two of the same chart and of a path, which are the largest messages
STATUS_INTERVAL = 25  # blocks between two updates of the health, which sums over all sensors
J2S_GOAL_M = 0.03  # 1σ in the worst direction below which the guide requests no other motion
FAREWELL_S = 1.0  # that the end of a run waits for the last update of the page, at most
QUEUE_BLOCKS = 256  # that wait for the page; more than a second of them, older ones are dropped
_PORTS_TRIED = 100


class Page:
    """Serves a page that shows estimates. A context manager: leaving it ends the server.

    `show` only puts a block into a queue: the server's thread sends it, and drops old blocks rather than let anything
    wait for a slow browser. The server sends the files of its own client program and no other file of the machine.
    """

    def __init__(
        self,
        columns: Sequence[str],
        rig: Rig,
        title: str,
        *,
        host: str = LOOPBACK,
        port: int | None = None,
        on_mark: Callable[[float], None] | None = None,
        replay: Replay | None = None,
        surroundings: Surroundings | None = None,
    ) -> None:
        """Starts the server.

        Args:
            columns: of the estimates: `time_s`, `<filter>_<quantity>_<unit>`; columns without a filter are a reference.
            rig: its J2S is the length and direction of the link in the scene.
            title: a line such as the port or the file.
            host: address of the server; any other than a loopback address opens the page to the network.
            port: TCP port; None: the first free one from 8080.
            on_mark: called with the time (s) of the newest row when the user presses "mark".
            replay: rows of a file to play, instead of `show`.
            surroundings: map and beacons around a robot.

        Raises LinkposeError where the address cannot be used, or the port is taken.
        """
        self.stopped = threading.Event()  # set when the user presses "stop"
        self._title, self._on_mark = title, on_mark
        self._columns = list(columns)
        self._history: History | Replay = replay or History(columns)
        self._replay = replay
        self._of_filter = quantities.by_filter(columns)
        self._needed = {name: required_sensors(name) for name in self._of_filter}
        self._lost_at: list[int] = []  # columns whose values are not shown
        self._exclusions = Exclusions(self._columns)
        self._queue: deque[tuple[Floats, bool]] = deque(maxlen=QUEUE_BLOCKS)  # rows, and whether they replace all
        self._status, self._blocks = PageStatus(), 0
        self._updates = 0  # since everything was drawn last
        self._clients: set[int] = set()
        self._marks: list[float] = []
        self._is_changed = self._is_status_changed = True  # since the last update
        self._server = serve(host, port or free_port(host), is_named=port is not None)
        reachable = reachable_address(host)
        self.url = f"http://{f'[{reachable}]' if ':' in reachable else reachable}:{self._server.get_port()}"
        self._build(rig, surroundings or Surroundings())
        self._is_ending = self._has_ended = False
        self._error: Exception | None = None
        self._loop = self._server.get_event_loop()
        self._loop.call_soon_threadsafe(self._send)

    def show(self, estimates: Floats, status: Callable[[], PageStatus]) -> None:
        """Takes estimates (N, columns) or the newest row (columns,). Never waits.

        `status` is called now and then, in the thread of the caller.
        """
        if estimates.size:
            self._queue.append((estimates, False))
        if self._blocks % STATUS_INTERVAL == 0 or not estimates.size:
            self._status = status()
            self._is_status_changed = True
        self._blocks += 1
        self._is_changed = True

    def restart(self, estimates: Floats) -> None:
        """Takes estimates (N, columns) in place of all before: a filter has caught up with the samples so far."""
        self._queue.append((estimates, True))

    def raise_if_stopped(self) -> None:
        """Raises KeyboardInterrupt once the user has pressed "stop", which ends a run as Ctrl-C does.

        Raises the error with which the sender ended, if it did.
        """
        if self.stopped.is_set():
            raise KeyboardInterrupt
        if self._error is not None:
            raise self._error

    def close(self) -> None:
        """Draws the last row everywhere, and ends the server."""
        if self._is_ending:
            return
        is_drawn = threading.Event()
        self._loop.call_soon_threadsafe(self._finish, is_drawn)
        is_drawn.wait(FAREWELL_S)
        # viser waits up to 6 s for the farewell of browsers; the end of a measurement does not.
        threading.Thread(target=self._server.stop, name="linkpose page stop", daemon=True).start()

    def __enter__(self) -> Page:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _build(self, rig: Rig, surroundings: Surroundings) -> None:
        from linkpose.page.panel import Panel

        server = self._server
        server.gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        server.gui.main_panel.dock_right()
        known = self._replay.values if self._replay is not None else None
        self._changes = Changes(server)
        self._drawing = Drawing(server, self._changes, self._columns, rig, surroundings, known)
        self._panel = Panel(server, self._changes, self._columns, self._drawing.charted, self._redraw)
        if self._replay is not None:
            self._build_player(self._replay)
        elif self._on_mark is not None:
            self._mark_button = server.gui.add_button("mark", hint="note this instant in the recording")
            self._mark_button.on_click(lambda _: self._mark())
        if self._replay is None:
            stop = server.gui.add_button("stop", color="red", hint="end the measurement")
            stop.on_click(lambda _: self.stopped.set())
        self._panel.add_charts()

    def _redraw(self) -> None:
        """Draws everything with the next update."""
        self._is_changed = self._is_status_changed = True
        self._updates = 0

    def _build_player(self, replay: Replay) -> None:
        """A slider over the time of the file, and "play"."""
        start, end = (round(time_s, 2) for time_s in replay.span_s)
        replay.seek(start)
        self._place_s = start
        self._slider: Any = self._server.gui.add_slider("time (s)", start, max(end, start + 0.01), 0.01, start)
        self._play: Any = self._server.gui.add_checkbox("play", True)

        def jump(event: viser.GuiEvent[Any]) -> None:
            if event.client is not None:  # moved by the user, not by the player
                self._place_s = float(self._slider.value)
                self._redraw()

        self._slider.on_update(jump)

    def _mark(self) -> None:
        newest = self._newest()
        if newest is not None and self._on_mark is not None:
            self._marks.append(float(newest[0]))
            self._on_mark(self._marks[-1])
            self._redraw()

    def _send(self) -> None:
        """The sender: shows the newest row, and now and then all rows that arrived. Calls itself again after a while.

        It runs on the server's event loop: with a thread of its own, each update would wake two threads, which wait for
        each other.
        """
        if self._has_ended:
            return
        try:
            self._update()
        except Exception as error:
            self._error = error
        else:
            self._loop.call_later(UPDATE_INTERVAL_S, self._send)

    def _finish(self, is_drawn: threading.Event) -> None:
        """Sends the last update, after which browsers keep numbers, link and charts of the same row."""
        self._is_ending = True
        self._redraw()
        if self._error is None:
            self._send()
        self._has_ended = True
        is_drawn.set()

    def _update(self) -> None:
        is_full = self._updates % CHART_INTERVAL == 0
        self._updates += 1
        if is_full:
            self._take()
            clients = self._server.get_clients().keys()
            if clients != self._clients:
                self._clients = set(clients)
                self._is_changed = self._is_status_changed = True
        if not self._clients:
            return
        if self._replay is not None:
            self._advance(self._replay)
        if self._is_changed or is_full or self._panel.has_due_charts:  # charts catch up with the last rows
            self._is_changed = False
            self._draw(is_full)

    def _take(self) -> None:
        """Takes the rows that wait into the history."""
        if not isinstance(self._history, History):
            return
        blocks: list[Floats] = []
        for _ in range(len(self._queue)):
            rows, is_restart = self._queue.popleft()
            if is_restart:
                blocks = []
                self._history, self._exclusions = History(self._columns), Exclusions(self._columns)
            blocks.append(rows.ravel())
        if not blocks:
            return
        rows = np.concatenate(blocks).reshape(-1, len(self._columns))
        self._history.add(rows)
        self._exclusions.follow(rows)

    def _newest(self) -> Floats | None:
        """The newest row (columns,), which may still wait."""
        try:
            rows, _ = self._queue[-1]
        except IndexError:
            return self._history.newest
        return rows if rows.ndim == 1 else rows[-1]

    def _advance(self, replay: Replay) -> None:
        """Plays on."""
        _, end = replay.span_s
        if self._play.value:
            self._place_s += UPDATE_INTERVAL_S
            if self._place_s >= end:
                self._place_s, self._play.value = end, False
            self._slider.value = round(self._place_s, 2)
            self._is_changed = self._is_status_changed = True
        replay.seek(self._place_s)

    def _draw(self, is_full: bool) -> None:
        """Draws the newest row; `is_full` also draws what is large and may be late."""
        newest = self._newest()
        values = [] if newest is None else newest.tolist()
        if self._replay is not None:
            self._exclusions.follow(self._replay.newest[np.newaxis])
        if is_full and self._is_status_changed:
            self._is_status_changed = False
            self._draw_status(values[0] if values else None, self._status)
        for at in self._lost_at:
            values[at] = math.nan
        name = self._panel.chosen or self._drawing.best(values) if values else None
        if name is not None:
            row = self._drawing.draw(values, name)
            self._panel.draw_headline(row[name], name)
            if is_full:
                self._panel.draw_details(row[name])
                self._drawing.draw_slow(row, name, self._history)
                self._panel.renew_charts(self._history.window(), name)
            if self._updates == 1 or not is_full:
                self._panel.draw_charts(is_whole=self._updates == 1)
        self._changes.broadcast(self._clients)

    def _lose_filters(self, health: Health) -> None:
        """Blanks the filters that have lost a sensor which they need, from the time on at which they lost it."""
        needed, self._lost_at = self._needed.__getitem__, []
        for name in lost_filters(self._of_filter, health, needed):
            columns = [self._columns.index(column) for column in self._of_filter[name].values()]
            self._lost_at += columns
            if isinstance(self._history, History):
                self._history.forget(columns, lost_since(name, health, needed))

    def _draw_status(self, time_s: float | None, status: PageStatus) -> None:
        """Draws what changes with the health, at the time (s) of the newest row, if there is one."""
        health, words = status.health, []
        if health is not None:
            self._lose_filters(health)
        if time_s is not None:
            words.append(f"{time_s:.1f} s")
        if health is not None:
            words.append(f"{health.rate_hz:.0f} Hz   {health.lost} lost")
        if status.j2s is not None:
            self._drawing.set_j2s(status.j2s.mean_m)
            words.append(j2s_text(status.j2s))
        if self._marks:
            words.append(f"marks: {len(self._marks)}, last at {self._marks[-1]:.1f} s")
        if status.line:
            words.append(status.line)
        if self._is_ending and self._replay is None:
            words.append("measurement ended")
        faults = fault_lines(health, self._exclusions) if health is not None else self._exclusions.lines()
        working = working_sensors(health) if health is not None else []
        self._panel.draw_health(self._title, "   ".join(words), working, faults)


def j2s_text(found: FoundJ2s) -> str:
    """J2S as estimated so far, and the motion that is missing to estimate it better."""
    length = float(np.linalg.norm(found.mean_m))
    text = f"J2S {length:.3f} m ±{1e3 * found.worst_std_m:.0f} mm"
    if found.worst_std_m > J2S_GOAL_M:
        # A rotation about an axis moves the sensor only across that axis, so it leaves J2S along the axis unknown.
        others = " or ".join(axis for axis in "xyz" if axis != found.worst_axis)
        text += f"; not excited yet: J2S along the sensor's {found.worst_axis} axis. Turn the link about {others}."
    return text


def reachable_address(host: str) -> str:
    """The address that a browser can open: for "all addresses" (0.0.0.0, ::), that of this machine in its network."""
    anywhere = {"0.0.0.0": (socket.AF_INET, "192.0.2.1"), "::": (socket.AF_INET6, "2001:db8::1")}
    if host not in anywhere:
        return host
    family, far_away = anywhere[host]  # an address for documentation (RFC 5737, RFC 3849), to which nothing is sent
    try:
        with socket.socket(family, socket.SOCK_DGRAM) as route:
            route.connect((far_away, 9))
            return str(route.getsockname()[0])
    except OSError:  # no network
        return "localhost"


def free_port(host: str) -> int:
    """The first free TCP port from 8080 at this address. Raises LinkposeError where the address cannot be used."""
    for port in range(FIRST_PORT, FIRST_PORT + _PORTS_TRIED):
        try:
            _try_to_bind(host, port)
        except PermissionError:
            continue
        except OSError as reason:
            if reason.errno != errno.EADDRINUSE:
                raise LinkposeError(f"the page cannot be served at {host}: {reason.strerror or reason}") from None
            continue
        return port
    raise LinkposeError(f"ports {FIRST_PORT} to {FIRST_PORT + _PORTS_TRIED - 1} at {host} are taken; name another port")


def _try_to_bind(host: str, port: int) -> None:
    """Raises OSError where a server could not open that port."""
    family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    with socket.socket(family, kind, protocol) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        probe.bind(address)


def serve(host: str, port: int, is_named: bool) -> viser.ViserServer:
    """The server. It prints nothing: stdout is for results."""
    if is_named:  # viser itself would take the next free port, and wait forever for an address of another machine
        try:
            _try_to_bind(host, port)
        except OSError as reason:
            raise LinkposeError(f"the page cannot be served at {host}:{port}: {reason.strerror or reason}") from None
    import rich
    import viser

    class Server(viser.ViserServer):
        """A server that never opens a tunnel to the network, even if a browser requests one."""

        def request_share_url(self, verbose: bool = True) -> str | None:
            return None

    rich.reconfigure(quiet=True)  # the global console, with which viser prints; linkpose has its own
    with own_requests_only(host):  # returns when the server accepts connections
        return Server(host, port, label="linkpose", verbose=False)
