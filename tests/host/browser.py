"""A headless Chromium that is driven over the DevTools protocol."""

from __future__ import annotations

import base64
import json
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

from websockets.sync.client import ClientConnection, connect

FLAGS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--enable-unsafe-swiftshader",
    "--hide-scrollbars",
    "--remote-debugging-port=0",
]
PATIENCE_S = 240.0  # (s) a bound on a loaded machine, never a wait


class Browser:
    """One tab. A context manager: leaving it ends the browser."""

    def __init__(self, width: int = 900, height: int = 500, scale: float = 0.4) -> None:
        """The tab has `width` × `height` CSS pixels. WebGL is rendered by the CPU: a small `scale` saves most of it."""
        program = shutil.which("chromium")
        assert program is not None, "install the Debian package chromium"
        self._profile = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        self._process = subprocess.Popen(
            [
                program,
                *FLAGS,
                f"--user-data-dir={self._profile.name}",
                f"--window-size={width},{height}",
                "about:blank",
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        self.console: list[str] = []  # errors: exceptions, failed requests, console.error
        self._number = 0
        self._session = ""
        self._socket = self._connect()
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        self.call(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=scale, mobile=False
        )
        for domain in ("Runtime", "Log", "Page"):
            self.call(f"{domain}.enable")

    def _connect(self) -> ClientConnection:
        """Waits for the line in which the browser reports the address of its DevTools."""
        assert self._process.stderr is not None
        for line in self._process.stderr:
            if "DevTools listening on " in line:
                # No pings: a browser on a loaded machine answers late, and PATIENCE_S bounds each wait anyway.
                return connect(line.split(" on ", 1)[1].strip(), max_size=None, ping_interval=None)
        raise AssertionError("chromium ended without a DevTools address")

    def call(self, method: str, **params: Any) -> Any:
        """A DevTools method and its result; events that arrive meanwhile are looked through for errors."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": params}
        self._socket.send(json.dumps(message | ({"sessionId": self._session} if self._session else {})))
        while True:
            answer = json.loads(self._socket.recv(timeout=PATIENCE_S))
            if answer.get("id") == self._number:
                assert "error" not in answer, answer
                return answer["result"]
            self._note(answer)

    def _note(self, event: dict[str, Any]) -> None:
        params = event.get("params", {})
        match event.get("method"):
            case "Runtime.exceptionThrown":
                self.console.append(json.dumps(params["exceptionDetails"])[:500])
            case "Runtime.consoleAPICalled" if params["type"] == "error":
                self.console.append(json.dumps(params["args"])[:500])
            case "Log.entryAdded" if params["entry"]["level"] == "error":
                self.console.append(json.dumps(params["entry"])[:500])

    def open(self, url: str) -> None:
        """Goes to a page."""
        self.call("Page.navigate", url=url)

    def evaluate(self, expression: str) -> Any:
        """The value of an expression of JavaScript, a promise's after it is kept."""
        answer = self.call("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def wait_for(self, condition: str) -> Any:
        """The value of the expression as soon as it is true; it is looked at again on each change of the document."""
        return self.evaluate(
            f"""new Promise((resolve, reject) => {{
              const look = () => {{
                const value = ({condition});
                if (value) {{ observer.disconnect(); resolve(value); }}
              }};
              const observer = new MutationObserver(look);
              observer.observe(document, {{subtree: true, childList: true, characterData: true, attributes: true}});
              setTimeout(() => reject("not so: " + document.body.innerText), {1000 * PATIENCE_S / 2});
              look();
            }})"""
        )

    def wait_for_text(self, text: str) -> None:
        """Returns as soon as the page shows this text."""
        self.wait_for(f"document.body && document.body.innerText.includes({json.dumps(text)})")

    def screenshot(self, path: Path) -> None:
        """Writes what the tab shows as a PNG."""
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"]))

    def close(self) -> None:
        """Ends the browser."""
        self._session = ""
        self.call("Browser.close")
        self._socket.close()
        self._process.wait(PATIENCE_S)
        assert self._process.stderr is not None
        self._process.stderr.close()
        self._profile.cleanup()

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
