"""Plots of linkpose's files, evaluations and experiments.

Each function returns a matplotlib `Figure`; `save` writes it as PNG, SVG or PDF. matplotlib is imported only when a
figure is made.
"""

from linkpose.plotting.canvas import FORMATS, check_output, new_figure, save
from linkpose.plotting.evaluation import evaluation
from linkpose.plotting.experiments import paper_figure_2, redundant_mice, variants
from linkpose.plotting.robots import Scene
from linkpose.plotting.tables import plot_tables

__all__ = [
    "FORMATS",
    "Scene",
    "check_output",
    "evaluation",
    "new_figure",
    "paper_figure_2",
    "plot_tables",
    "redundant_mice",
    "save",
    "variants",
]
