"""Localises from a stream of rows as they come, for `linkpose localize -`."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from pathlib import Path

from linkpose.errors import LinkposeError
from linkpose.localization.events import Event, is_negative, stream_events
from linkpose.localization.localizer import Localizer, Method, Row, check
from linkpose.localization.settings import Settings
from linkpose.localization.tables import Beacons

# The beginning of the stream from which the motion model and the start follow (s of the log, and rows at the most).
# Longer delays the first pose; shorter may miss a slow sensor.
HEAD_S, HEAD_ROWS = 1.0, 500


def localize_stream(
    lines: Iterable[str], method: Method, settings: Settings, beacons: Beacons
) -> Iterator[tuple[tuple[str, ...], Row]]:
    """Yields the names of the states and the estimate after each row, as soon as the head of the stream is read.

    Negative ranges, and rows older than the one before, are left out. Raises LinkposeError for what cannot be a
    measurement, as `localize` does.
    """
    events = (event for event in stream_events(lines, Path("-")) if not is_negative(event))
    head: list[Event] = []
    for event in events:
        head.append(event)
        if event.time_s >= head[0].time_s + HEAD_S or len(head) >= HEAD_ROWS:
            break
    if not head:
        raise LinkposeError("standard input holds no measurements; send the header time_s,kind,a,b,c and rows")
    head.sort(key=lambda event: event.time_s)
    check(list(head), method, settings, None, beacons, "standard input")
    run = Localizer(list(head), method, settings, None, beacons)
    for event in itertools.chain(head, events):
        if event.time_s < run.now:
            continue
        if event.beacon and event.beacon not in beacons:
            raise LinkposeError(f"standard input line {event.line}: beacon {event.beacon} is not in the beacon file")
        yield run.filter.motion.states, run.feed([event])
