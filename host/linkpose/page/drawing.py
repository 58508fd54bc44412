"""Draws rows of estimates into a scene, for the live page and for files that hold an animation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from linkpose import quantities
from linkpose.localization.surroundings import Surroundings
from linkpose.page.changes import Changes
from linkpose.page.history import History, Replay
from linkpose.page.scene import LinkScene, scene_of
from linkpose.presentation import Row, RowReader
from linkpose.quantities import HEADING, Quantity, X, Y
from linkpose.sensors.measurements import Floats
from linkpose.sensors.rig import Rig

if TYPE_CHECKING:
    import viser


class Drawing:
    """A scene and the columns of the estimates that it shows."""

    def __init__(
        self,
        server: viser.ViserServer,
        changes: Changes,
        columns: Sequence[str],
        rig: Rig,
        surroundings: Surroundings,
        known: Floats | None = None,
    ) -> None:
        """`columns` are those of the estimates: `time_s`, `<filter>_<quantity>_<unit>`; others are a reference.

        What moves goes into `changes`.

        `known` (N, columns) are all rows of a file, whose paths the camera shows from the start.
        """
        self._rows = RowReader(columns)
        self._at = {column: at for at, column in enumerate(columns)}
        self._of_filter = quantities.by_filter(columns)
        self._reference_at = [
            (part.quantity, at)
            for column, at in self._at.items()
            if (part := quantities.split(column)) is not None and not (part.prefix or part.is_std)
        ]
        places = self._corners(np.empty((0, len(columns))) if known is None else known)
        self._scene = scene_of(server, changes, self._of_filter.values(), rig, surroundings, places)
        self._candidates = [
            (self._at[of[q]], name) for q in self._scene.shown_by for name, of in self._of_filter.items() if q in of
        ]

    @property
    def charted(self) -> tuple[Quantity, ...]:
        """The quantities that belong to what the scene shows."""
        return self._scene.charted

    def best(self, newest: Sequence[float]) -> str | None:
        """The best filter with a value in this row (columns,); without any value, the best filter at all."""
        for at, name in self._candidates:
            if math.isfinite(newest[at]):
                return name
        return self._candidates[0][1] if self._candidates else None

    def draw(self, newest: Sequence[float], name: str) -> Row:
        """Draws the newest row (columns,) as the filter `name` estimates it.

        Returns the values of this filter at least, by filter and quantity.
        """
        row = self._rows.read(newest, None if self._scene.combines_filters else (name,))
        self._scene.draw(row, name, self._reference(newest))
        return row

    def draw_slow(self, row: Row, name: str, history: History | Replay) -> None:
        """Draws what changes slowly or is large, as the filter `name` estimates it: σ and the path."""
        self._scene.draw_slow(row, name, self._path(name, history))

    def set_j2s(self, j2s_m: Floats) -> None:
        """Draws a link with this J2S (3,), which is being estimated."""
        if isinstance(self._scene, LinkScene):
            self._scene.set_j2s(j2s_m)

    def _corners(self, rows: Floats) -> Floats:
        """Two opposite corners (2, 2) of the area that the paths in these rows cover; (0, 2) without a path."""
        paths = [rows[:, [self._at[of[X]], self._at[of[Y]]]] for of in self._of_filter.values() if X in of and Y in of]
        places = np.vstack([np.empty((0, 2)), *(path[np.isfinite(path).all(axis=1)] for path in paths)])
        return np.array([places.min(axis=0), places.max(axis=0)]) if len(places) else places

    def _reference(self, newest: Sequence[float]) -> dict[Quantity, float]:
        return {quantity: newest[at] for quantity, at in self._reference_at}

    def _path(self, name: str, history: History | Replay) -> Floats | None:
        """x, y, heading, σ of x and of y, their covariance, and the reference's x and y (N, 8) along the path.

        None of a filter that estimates no path.
        """
        of = self._of_filter.get(name, {})
        if not {X, Y, HEADING} <= of.keys():
            return None
        rows = history.path()
        names = [of[X], of[Y], of[HEADING], quantities.std_column(of[X]), quantities.std_column(of[Y])]
        names += [quantities.covariance_column(name, X, Y), X.column, Y.column]
        unknown = np.full(len(rows), math.nan)
        path = np.column_stack([rows[:, self._at[n]] if n in self._at else unknown for n in names])
        path[:, 5] = np.nan_to_num(path[:, 5])  # without its column: the axes of the ellipse are those of the map
        return path
