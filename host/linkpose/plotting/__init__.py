"""Plots of linkpose's files, evaluations and experiments.

Each function returns a matplotlib `Figure`; `save` writes it as PNG, SVG or PDF. matplotlib is imported only when a
figure is made.
"""

from linkpose.plotting.canvas import FORMATS, check_output, new_figure, picture_files, save
from linkpose.plotting.evaluation import evaluation
from linkpose.plotting.experiments import paper_figure_2, redundant_mice, variants
from linkpose.plotting.tables import plot_tables
from linkpose.plotting.thesis import INDOOR_FIGURES, UNDERWATER_FIGURES, indoor_figures, underwater_figures

__all__ = [
    "FORMATS",
    "INDOOR_FIGURES",
    "UNDERWATER_FIGURES",
    "check_output",
    "evaluation",
    "indoor_figures",
    "new_figure",
    "paper_figure_2",
    "picture_files",
    "plot_tables",
    "redundant_mice",
    "save",
    "underwater_figures",
    "variants",
]
