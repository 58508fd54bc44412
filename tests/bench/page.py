"""What the page costs, and how long a sample takes to the screen: a link with all its filters at 100 Hz in Chromium.

    python tests/bench/page.py [--json]

CPU: of the sender (the server's thread and `Page.show`), as a share of one core; its budget is 1 %. The filters run
between the samples, as they do live, so that no cache is as warm as in a loop that does nothing else.
Latency: of every sample, from `Page.show` until a headless Chromium presents the first frame with it or a newer one;
its bound is 100 ms. It is measured up to the end of the browser's work on that frame; the mean time from there to the
screen, which the browser reports of some frames, is added. The heights are numbered, so that each text belongs to one
sample. A machine without a graphics card renders the scene with its CPU, which delays the browser.
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
from linkpose.sensors.measurements import Floats
from linkpose.simulation.link import PAPER_J2S_M, simulate

WARM_UP_S, MEASURED_S, INTERVAL_S = 5.0, 20.0, 0.01
BUDGET = 0.01  # of a core
BOUND_S = 0.1
STEP_M, STD_M = 0.0001, 0.0004  # of the height from one sample to the next, and its σ: the text ends at the step
# Each height that the headline shows, with the time at which the browser has finished the frame that shows it: a task
# that is posted during a frame runs after it. When the compositor presents it is known of some frames only.
WATCH = """
  window.seen = []; window.presented = [];
  const now = () => performance.timeOrigin + performance.now();
  const afterFrame = new MessageChannel(), request = window.requestAnimationFrame.bind(window);
  let last = "", isInFrame = false, changed = [];
  afterFrame.port1.onmessage = () => {
    isInFrame = false;
    window.seen.push(...changed.map(height => [height, now()]));
    changed = [];
  };
  window.requestAnimationFrame = draw => request(time => {
    if (!isInFrame) { isInFrame = true; afterFrame.port2.postMessage(0); }
    draw(time);
  });
  new PerformanceObserver(list => window.presented.push(...list.getEntries().map(
    entry => [Number(entry.identifier), performance.timeOrigin + entry.presentationTime]
  ))).observe({type: "element"});
  // The element whose content each update replaces. To look for the text in all of the page, with its layout, took more
  // of the browser's time than the update itself.
  const headline = [...document.querySelectorAll("div:not(:has(div))")]
    .find(e => /^\\d\\.\\d{4} m ±/.test(e.innerText)).parentElement.parentElement;
  new MutationObserver(() => {
    const shows = headline.firstElementChild.lastElementChild, height = shows.textContent.slice(0, 6);
    if (!/^\\d\\.\\d{4}$/.test(height) || height === last) return;
    last = height;
    shows.setAttribute("elementtiming", height);
    changed.push(Number(height));
    if (!isInFrame) window.requestAnimationFrame(() => {});
  }).observe(headline, {subtree: true, childList: true, characterData: true});
"""


def thread_seconds() -> dict[str, float]:
    """CPU time (s) of each thread of this process."""
    clock = {}
    for thread in Path("/proc/self/task").iterdir():
        run_ns = int((thread / "schedstat").read_text().split()[0])
        clock[thread.name] = 1e-9 * run_ns
    return clock


def feed(page: Page, estimator: Estimator, samples: lp.Measurements, first: int) -> tuple[Floats, float]:
    """Estimates at 100 Hz, with heights numbered from `first`.

    Returns when each sample was shown (s since 1970), and the CPU of `show` (s).
    """
    height, std = (estimator.columns.index(f"joint_inertial_height_{unit}") for unit in ("m", "std_m"))
    shown = np.empty(len(samples))
    busy_s = 0.0
    began = time.perf_counter()
    for at in range(len(samples)):
        time.sleep(max(0.0, began + at * INTERVAL_S - time.perf_counter()))
        newest = estimator.process(samples[at : at + 1])[-1].copy()
        newest[height], newest[std] = 1.0 + (first + at) * STEP_M, STD_M
        shown[at] = time.time()
        before = time.thread_time()
        page.show(newest, lambda: PageStatus(HEALTH))
        busy_s += time.thread_time() - before
    return shown, busy_s


def latencies(shown: Floats, first: int, seen: Floats) -> Floats:
    """Seconds from each sample to the first frame with it or a newer one.

    `shown` are the times (s) of samples numbered from `first`, `seen` (N, 2) are heights (m) and times (ms) of frames.
    """
    newest = np.maximum.accumulate(np.round((seen[:, 0] - 1.0) / STEP_M))
    frame = np.searchsorted(newest, first + np.arange(len(shown)))
    is_seen = frame < len(newest)  # the last samples may come after the last frame that was noted
    waits: Floats = seen[frame[is_seen], 1] / 1e3 - shown[is_seen]
    return waits


def measure() -> tuple[float, Floats]:
    """The sender's share of a core, and the latencies (s)."""
    samples, warm_up = simulate(1, 0, WARM_UP_S + MEASURED_S).measurements(), round(WARM_UP_S / INTERVAL_S)
    estimator = Estimator.for_measurements((), lp.Rig().with_j2s(PAPER_J2S_M), samples)
    estimator.warm_up()
    with Page(estimator.columns, estimator.rig, "sim://link") as page, Browser(900, 500, 0.4) as browser:
        browser.open(page.url)
        feed(page, estimator, samples[:warm_up], 0)
        browser.wait_for_text("height over the joint")
        browser.evaluate(WATCH)
        before, began = thread_seconds(), time.perf_counter()
        shown, busy_s = feed(page, estimator, samples[warm_up:], warm_up)
        took_s, after = time.perf_counter() - began, thread_seconds()
        main = str(min(map(int, after)))
        busy_s += sum(after[name] - before.get(name, 0.0) for name in after if name != main)
        seen, presented = json.loads(browser.evaluate("JSON.stringify([window.seen, window.presented])"))
    finished = dict(seen)
    later_ms = [time_ms - finished[height] for height, time_ms in presented if height in finished]
    return busy_s / took_s, latencies(shown, warm_up, np.array(seen)) + 1e-3 * float(np.mean(later_ms))


def main() -> None:
    share, waits_s = measure()
    rows = [Row("page: CPU a second", 1e6 * share, "budget", 1e6 * BUDGET)]
    for name, value in (
        ("mean", waits_s.mean()), ("p99", np.quantile(waits_s, 0.99)), ("maximum", waits_s.max())
    ):  # fmt: skip
        rows.append(Row(f"page: sample to screen, {name}", 1e6 * float(value), "bound", 1e6 * BOUND_S))
    report(rows)


if __name__ == "__main__":
    main()
