"""What the page costs, and how long a sample takes to the screen: a link with all its filters at 100 Hz in Chromium.

    python tests/bench/page.py [--json]

CPU: of the sender (the server's thread and `Page.show`), as a share of one core; its budget is 1 %. The filters run
between the samples, as they do live, so that no cache is as warm as in a loop that does nothing else.
Latency: from `Page.show` to the change of the height in the document of a headless Chromium; its bound is 100 ms. A
machine without a graphics card renders the scene with its CPU, which delays the browser.
"""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
from _report import Row, report
from _views import HEALTH, Browser

import linkpose as lp
from linkpose.estimation import Estimator
from linkpose.page import Page, PageStatus
from linkpose.simulation.link import PAPER_J2S_M, simulate

WARM_UP_S, MEASURED_S, INTERVAL_S = 5.0, 20.0, 0.01
BUDGET = 0.01  # of a core
BOUND_S = 0.1
# Each change of the headline with the time at which the document had it.
WATCH = """
  window.seen = [];
  new MutationObserver(() => {
    const found = document.body.innerText.match(/\\d\\.\\d{4} m ±/);
    const last = window.seen.at(-1);
    if (found && (!last || last[0] !== found[0]))
      window.seen.push([found[0], performance.timeOrigin + performance.now()]);
  }).observe(document, {subtree: true, childList: true, characterData: true});
"""


def thread_seconds() -> dict[str, float]:
    """CPU time (s) of each thread of this process."""
    clock = {}
    for thread in Path("/proc/self/task").iterdir():
        run_ns = int((thread / "schedstat").read_text().split()[0])
        clock[thread.name] = 1e-9 * run_ns
    return clock


def feed(page: Page, estimator: Estimator, samples: lp.Measurements) -> tuple[dict[str, list[float]], float]:
    """Estimates at 100 Hz. Returns the times of each text of the height (s since 1970), and the CPU of `show` (s)."""
    height = estimator.columns.index("joint_inertial_height_m")
    shown: dict[str, list[float]] = {}
    busy_s = 0.0
    began = time.perf_counter()
    for at in range(len(samples)):
        time.sleep(max(0.0, began + at * INTERVAL_S - time.perf_counter()))
        newest = estimator.process(samples[at : at + 1])[-1]
        before = time.thread_time()
        page.show(newest, lambda: PageStatus(HEALTH))
        busy_s += time.thread_time() - before
        shown.setdefault(f"{newest[height]:.4f} m ±", []).append(time.time())
    return shown, busy_s


def measure() -> tuple[float, list[float]]:
    """The sender's share of a core, and the latencies (s)."""
    samples, warm_up = simulate(1, 0, WARM_UP_S + MEASURED_S).measurements(), round(WARM_UP_S / INTERVAL_S)
    estimator = Estimator.for_measurements((), lp.Rig().with_j2s(PAPER_J2S_M), samples)
    estimator.warm_up()
    with Page(estimator.columns, estimator.rig, "sim://link") as page, Browser(900, 500, 0.4) as browser:
        browser.open(page.url)
        feed(page, estimator, samples[:warm_up])
        browser.wait_for_text("height over the joint")
        browser.evaluate(WATCH)
        before, began = thread_seconds(), time.perf_counter()
        shown, busy_s = feed(page, estimator, samples[warm_up:])
        took_s, after = time.perf_counter() - began, thread_seconds()
        main = str(min(map(int, after)))
        busy_s += sum(after[name] - before.get(name, 0.0) for name in after if name != main)
        seen = json.loads(browser.evaluate("JSON.stringify(window.seen)"))
    # A height may occur again: the document shows the last row before.
    ages = [[at / 1e3 - time_s for time_s in shown.get(text, []) if time_s < at / 1e3] for text, at in seen]
    return busy_s / took_s, [min(age) for age in ages if age]


def main() -> None:
    share, latencies = measure()
    report(
        [
            Row("page: CPU a second", 1e6 * share, "budget", 1e6 * BUDGET),
            Row("page: latency, median", 1e6 * float(np.median(latencies)), "bound", 1e6 * BOUND_S),
            Row("page: latency, p95", 1e6 * float(np.quantile(latencies, 0.95)), "bound", 1e6 * BOUND_S),
        ]
    )


if __name__ == "__main__":
    main()
