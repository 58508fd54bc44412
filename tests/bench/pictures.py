"""Makes the pictures of README.md: the page in a browser (page.png) and the terminal view (terminal.svg).

`python tests/bench/pictures.py` writes them into host/docs/img; it needs the Debian package chromium.
"""

from __future__ import annotations

import time
from pathlib import Path

from _views import HEALTH, ROOT, Browser
from rich.console import Console

import linkpose as lp
from linkpose.cli.screen import Screen
from linkpose.estimation import Estimates
from linkpose.page import Page, PageStatus
from linkpose.simulation.link import PAPER_J2S_M, simulate

IMAGES = ROOT / "host" / "docs" / "img"
FILTERS = ["joint-inertial", "joint", "tilt"]
TITLE = "sim://link  J2S 1.653 m"


def draw_terminal(estimates: Estimates) -> None:
    """The terminal view at 80 × 24 after the last row."""
    screen = Screen(TITLE, estimates.columns)
    screen.add(estimates.values)
    with Path("/dev/null").open("w") as nowhere:
        console = Console(record=True, width=80, file=nowhere)
        console.print(screen.render(HEALTH, 80, 24))
    console.save_svg(str(IMAGES / "terminal.svg"), title="linkpose estimate --live")


def draw_page(estimates: Estimates) -> None:
    """The page after the last row, without viser's remark on a computer without a graphics card."""
    with Page(estimates.columns, estimates.rig, "sim://link", on_mark=print) as page, Browser(1120, 720, 1) as browser:
        page.show(estimates.values[::5], lambda: PageStatus(HEALTH))
        browser.open(page.url)
        browser.wait_for("document.querySelectorAll('.uplot canvas').length == 3")
        time.sleep(30)  # the scene fades in, slowly on a loaded machine without a graphics card
        remark = "document.querySelector('.mantine-Notification-root')"
        browser.evaluate(f"{remark} && {remark}.remove()")
        browser.screenshot(IMAGES / "page.png")


def main() -> None:
    """Both pictures, of 25 s of the simulated link."""
    measurements = simulate(1, 0, 25.0).measurements()
    estimates = lp.estimate(measurements, FILTERS, j2s_m=PAPER_J2S_M)
    draw_terminal(estimates)
    draw_page(estimates)


if __name__ == "__main__":
    main()
