"""Estimate files as the page plays them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from linkpose import quantities
from linkpose.errors import LinkposeError
from linkpose.evaluation.series import Series
from linkpose.plotting.sources import gather, is_reference
from linkpose.quantities import HEIGHT, PITCH, ROLL, X, Y, by_filter, covariance_column, std_column
from linkpose.recording.table import Table
from linkpose.sensors.measurements import Floats
from linkpose.sensors.rig import Rig


def rows_of(tables: Sequence[Table], wanted: Sequence[str]) -> tuple[list[str], Floats]:
    """Columns and values (N, columns) of the first estimate, with the reference at its instants as further columns.

    `wanted` names filters; without any, all are taken. Raises LinkposeError where no file is an estimate.
    """
    table = _first_estimate(tables)
    sources = gather([t for t in tables if t is table or is_reference(t)], wanted)
    time_s = table.columns["time_s"]
    columns, values = ["time_s"], [time_s]
    for name, of in by_filter(table.columns).items():
        if wanted and name not in wanted:
            continue
        for column in of.values():
            found = [c for c in (column, std_column(column)) if c in table.columns and c not in columns]
            columns += [c for c in found if c is not None]
            values += [table.columns[c] for c in found if c is not None]
        covariance = covariance_column(name, X, Y)
        if covariance in table.columns:
            columns.append(covariance)
            values.append(table.columns[covariance])
    if sources.reference is not None:
        for quantity in (HEIGHT, ROLL, PITCH, X, Y):
            if sources.reference.has(quantity):
                shown = sources.reference.values[quantity] / quantity.value.scale
                columns.append(quantity.column)
                values.append(Series(sources.reference.time_s, shown).at(time_s))
    return columns, np.column_stack(values)


def rig_of(tables: Sequence[Table]) -> Rig:
    """The rig with which the first estimate was made, as far as its file states it; J2S as found at the end."""
    table = _first_estimate(tables)
    rig = table.metadata.get("rig")
    rig = dict(rig) if isinstance(rig, dict) else {}
    if table.closing and "j2s_m" in table.closing:
        rig["joint"] = {"j2s_m": table.closing["j2s_m"]}
    return Rig.from_dict(rig, str(table.path))


def _first_estimate(tables: Sequence[Table]) -> Table:
    for table in tables:
        if by_filter(table.columns) and not is_reference(table) and len(table):
            return table
    names = ", ".join(str(table.path) for table in tables)
    if all(map(_has_truth, tables)):
        raise LinkposeError(f"{names} holds a reference and no estimates; name a file of estimates as well")
    raise LinkposeError(f"{names} holds no estimates; type: linkpose estimate {tables[0].path} -o OUT.csv")


def _has_truth(table: Table) -> bool:
    """Whether it holds quantities that filters estimate, and is made by none."""
    parts = [quantities.split(column) for column in table.columns]
    return any(part is not None and not part.prefix and not part.quantity.is_reading for part in parts)
