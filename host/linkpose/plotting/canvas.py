"""Figures, files and the style that all plots share."""

from __future__ import annotations

import contextlib
import datetime
import io
import logging
import textwrap
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from linkpose.errors import CannotWrite, UnknownPicture
from linkpose.outputs import STDOUT, check_outputs, new_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Entry = TypeVar("Entry")  # of a legend: its label, or its number
FORMATS = (".png", ".svg", ".pdf")
# Every picture is as wide as the two columns of a journal's page (183 mm), where its lettering is printed as it is. In
# one column (88 mm), 9 and 8 points become 4.3 and 3.9; a picture of 10 inches had 3.5 and 2.8 there.
WIDTH_INCHES = 7.2
LETTERING, SMALL_LETTERING = 9.0, 8.0  # points: labels, ticks and title; legends and notes
DPI = 180

# Okabe and Ito's palette, whose colours colour-blind readers can distinguish: one colour per filter, in every plot.
_BLUE, _PURPLE, _RED, _ORANGE, _GREEN, _SKY = "#0072B2", "#CC79A7", "#D55E00", "#E69F00", "#009E73", "#56B4E9"
_GREY = "#8A8A8A"
COLOURS = {
    "joint-inertial": _BLUE, "tilt-inertial": _PURPLE, "joint": _RED, "tilt": _ORANGE, "imu-baro": _GREEN,
    "baro": _GREY, "planar-ekf": _BLUE, "planar-ukf": _PURPLE, "mice": _ORANGE, "chain": _BLUE,
    "ekf": _BLUE, "ukf": _PURPLE, "mcl": _GREEN, "scan": _RED,
}  # fmt: skip
AXES_COLOURS = {"x": _RED, "y": _GREEN, "z": _BLUE}
OTHERS = (_SKY, _GREEN, _ORANGE, _RED)  # of series that are no filter: mice, beacons
TRUTH: dict[str, Any] = {"color": "black", "linestyle": "--", "linewidth": 0.9, "zorder": 5}
REFERENCES = ("truth", "reference")  # labels of what is drawn as TRUTH
BAND_ALPHA = 0.18
_BEST = ("joint-inertial", "planar-ekf", "chain")  # drawn thick
_BESIDES = ("-", ":", "-.")  # the second and third file
# Fonts of Linux, Windows and macOS with Korean, Japanese and Chinese characters, which matplotlib's own lacks.
_FURTHER_FONTS = (
    "Noto Sans CJK KR", "NanumGothic", "Malgun Gothic", "Apple SD Gothic Neo", "AppleGothic",
    "Noto Sans CJK JP", "Yu Gothic", "Hiragino Sans", "Noto Sans CJK SC", "Microsoft YaHei", "PingFang SC",
)  # fmt: skip


@contextlib.contextmanager
def _without_warnings_of_matplotlib() -> Iterator[None]:
    """For its import: without a writable home it uses a temporary folder, and the pictures are the same."""
    logger = logging.getLogger("matplotlib")
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(before)


@contextlib.contextmanager
def _without_warnings_of_glyphs() -> Iterator[None]:
    """While a figure is drawn: without a font for it, a file's name has boxes."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing from")
        yield


def new_figure(height_inches: float, title: str = "") -> Figure:
    """An empty figure of WIDTH_INCHES with a title at its left edge."""
    with _without_warnings_of_matplotlib():
        from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH_INCHES, height_inches), layout="constrained")
    if title:
        figure.suptitle(wrapped(title, WIDTH_INCHES, LETTERING), fontsize=LETTERING, x=0.01, ha="left")
    return figure


# Mean width of a character of matplotlib's font, as a share of its size, measured over labels of these plots.
_CHARACTER = 0.5
_NO_BREAK = "\N{NO-BREAK SPACE}"


def wrapped(text: str, inches: float, size: float) -> str:
    """The text in lines that are not longer than `inches` at a size in points, as far as its words allow."""
    characters = max(8, int(72 * inches / (_CHARACTER * size)))
    lines = text.replace(" (", f"{_NO_BREAK}(").split("\n")  # a unit stays with its quantity
    filled = (textwrap.fill(line, characters, break_long_words=False, break_on_hyphens=False) for line in lines)
    return "\n".join(filled).replace(f"{_NO_BREAK}(", " (")


def line_style(name: str, file: int = 0) -> dict[str, Any]:
    """How a filter is drawn; `file` numbers the files that are drawn together."""
    colour = COLOURS.get(name) or OTHERS[sum(name.encode()) % len(OTHERS)]
    return {
        "color": colour,
        "linewidth": 1.6 if name in _BEST else 0.8,
        "linestyle": _BESIDES[min(file, len(_BESIDES) - 1)],
        "zorder": 3 if name in _BEST else 2,
    }


_MORE = 1.08  # of the size of axes when they are added: the layout, which comes last, leaves less about them free


def finish(axes: Axes, label: str) -> None:
    """Label of the y axis, no longer than the axis, grid, and no frame above and right."""
    from matplotlib.ticker import ScalarFormatter

    axes.set_ylabel(wrapped(label, _MORE * axes.get_window_extent().height / axes.figure.dpi, LETTERING))
    axes.yaxis.label.set_fontsize(LETTERING)
    axes.xaxis.label.set_fontsize(LETTERING)
    axes.tick_params(labelsize=LETTERING)
    axes.grid(alpha=0.25, linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    axes.margins(x=0.0)
    for axis in (axes.xaxis, axes.yaxis):
        if isinstance(formatter := axis.get_major_formatter(), ScalarFormatter):
            formatter.set_useOffset(False)  # 1015.4 hPa, not 0.4 + 1.015e3


# Seconds in a unit of time, the unit, and the shortest axis (s) that has it: ten minutes, two hours.
_TIME_UNITS = ((3600.0, "h", 7200.0), (60.0, "min", 600.0))


def label_time(axes: Axes) -> None:
    """Label and ticks of a time axis (s), of long runs in minutes or hours, at round numbers of them."""
    from matplotlib.ticker import FuncFormatter, MaxNLocator

    class Locator(MaxNLocator):
        """Ticks at round numbers of the unit."""

        def tick_values(self, vmin: float, vmax: float) -> list[float]:
            return [factor * tick for tick in super().tick_values(vmin / factor, vmax / factor)]

    first, last = axes.get_xlim()
    factor, unit = next(((f, u) for f, u, least in _TIME_UNITS if last - first >= least), (1.0, "s"))
    axes.set_xlabel(f"time ({unit})")
    if factor > 1.0:
        axes.xaxis.set_major_locator(Locator(nbins=9, steps=[1, 2, 5, 10]))
        axes.xaxis.set_major_formatter(
            FuncFormatter(lambda time_s, _: f"{time_s / factor:g}".replace("-", "\N{MINUS SIGN}"))
        )


def legend_above(axes: Axes, best_first: Sequence[str] = (), title: str = "") -> None:
    """A legend above the axes, where it hides nothing: the reference, the filters from the best on, then the rest.

    `title` is above the legend.
    """
    rank = {label: i for i, label in enumerate(best_first)}

    def place(item: tuple[object, str]) -> int:
        return -1 if item[1] in REFERENCES and best_first else rank.get(item[1], len(rank))

    order = sorted(zip(*axes.get_legend_handles_labels(), strict=True), key=place)
    once = {label: handle for handle, label in order}
    if once:
        columns = _columns_that_fit(list(once), _MORE * axes.get_window_extent().width / axes.figure.dpi)
        _fill_legend(axes, once, columns, title)


def legend_of_new(axes: Axes, named: set[str], best_first: Sequence[str] = ()) -> None:
    """A legend above the axes if they show anything that is not in `named` yet; adds all that they show to it."""
    shown = set(axes.get_legend_handles_labels()[1])
    if not shown <= named:
        legend_above(axes, best_first)
        named |= shown


def _fill_legend(axes: Axes, handles: dict[str, Any], columns: int, title: str) -> None:
    """A legend above the axes with these labels row by row, in so many columns."""
    labels = _by_rows(list(handles), columns)
    legend = axes.legend(
        [handles[label] for label in labels], labels, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=columns,
        frameon=False, fontsize=SMALL_LETTERING, borderaxespad=0.2, borderpad=0.2, handlelength=_HANDLE - 0.8,
        columnspacing=1.0, title=title or None, title_fontsize=LETTERING, alignment="left",
    )  # fmt: skip
    for text in legend.get_texts():
        text.set_parse_math(False)


_OVERHANG = 1.08  # of a legend's width over that of its axes: into the space between two panels, not beyond


def fit_legends(figure: Figure) -> Figure:
    """The figure, whose legends have fewer columns where they are wider than their axes.

    The layout, which comes last, makes axes so narrow that the widest legend has its place in the picture.
    """
    with _without_warnings_of_glyphs():
        legends = [(axes, legend) for axes in figure.axes if (legend := axes.get_legend()) is not None]
        if all(legend.get_window_extent().width <= axes.bbox.width for axes, legend in legends):
            return figure  # the layout, which takes a quarter of a second, leaves the axes at least this width
        figure.draw_without_rendering()
        for axes in figure.axes:
            _narrow_legend(axes)
    return figure


def _narrow_legend(axes: Axes) -> None:
    """Refills the legend with fewer and fewer columns until it is as wide as the axes."""
    while (legend := axes.get_legend()) is not None:
        columns = int(legend._ncols)  # type: ignore[attr-defined]  # matplotlib has no reader for it
        if columns == 1 or legend.get_window_extent().width <= _OVERHANG * axes.bbox.width:
            break
        texts = [text.get_text() for text in legend.get_texts()]
        by_place = dict(zip(_by_rows(list(range(len(texts))), columns), texts, strict=True))
        handles, labels = axes.get_legend_handles_labels()
        handle_of = dict(zip(labels, handles, strict=True))
        in_rows = {by_place[place]: handle_of[by_place[place]] for place in range(len(texts))}
        _fill_legend(axes, in_rows, columns - 1, legend.get_title().get_text())


_HANDLE = 2.4  # of an entry of a legend, with its distance from the label: in sizes of the lettering


def _columns_that_fit(labels: Sequence[str], inches: float) -> int:
    """The most columns of a legend, filled row by row, that are together not wider than `inches`."""
    for columns in range(len(labels), 1, -1):
        longest = [max(map(len, labels[column::columns])) for column in range(columns)]
        sizes = sum(_CHARACTER * length + _HANDLE for length in longest) + columns - 1
        if sizes * SMALL_LETTERING / 72 <= inches:
            return columns
    return 1


def _by_rows(labels: list[Entry], columns: int) -> list[Entry]:
    """Entries in the order in which matplotlib, which fills a legend column by column, shows them row by row."""
    return [label for column in range(columns) for label in labels[column::columns]]


def without_formulas(figure: Figure) -> Figure:
    """The figure, with each `$` as it is: in the names of files and columns, it does not begin a formula."""
    from matplotlib.text import Text

    for text in figure.findobj(Text):
        text.set_parse_math(False)
    return figure


def check_output(path: Path | None, force: bool, formats: Sequence[str] = FORMATS) -> None:
    """Raises FileError where a picture of this name cannot be written: better before the work than after it."""
    if path is None or path == STDOUT:
        return
    if path.suffix.lower() not in formats:
        raise UnknownPicture(path, formats)
    check_outputs((path,), force)


def picture_files(place: Path, whole: str, names: Sequence[str], force: bool) -> dict[str, Path]:
    """A file for each of several pictures, `whole` and `names`.

    A folder `place` holds them all. A picture file `place` is that of `whole`, and the others lie beside it, after its
    name. Makes the folder. Raises FileError where one of the pictures cannot be written.
    """
    if place.suffix and not place.is_dir():
        files = {whole: place} | {name: place.with_name(f"{place.stem}-{name}{place.suffix}") for name in names}
    else:
        files = {name: place / f"{name}.png" for name in (whole, *names)}
        try:
            place.mkdir(exist_ok=True)
        except OSError as error:
            raise CannotWrite(place, error.strerror) from error
    for file in files.values():
        check_output(file, force)
    return files


def save(figure: Figure, path: Path, force: bool) -> None:
    """Writes the picture in the format that the file's ending names, to STDOUT as PNG.

    Raises FileError as `check_output` does, and where the file cannot be written.
    """
    check_output(path, force)
    ending = "png" if path == STDOUT else path.suffix[1:].lower()
    # Two pictures of the same data are the same file.
    metadata = {"pdf": {"CreationDate": datetime.datetime(1970, 1, 1)}, "svg": {"Date": None}}
    _add_fonts(figure)
    # The file is made when the picture is whole: matplotlib seeks in files, and a pipe has no place to seek.
    with _without_warnings_of_glyphs():
        figure.savefig(picture := io.BytesIO(), dpi=DPI, format=ending, metadata=metadata.get(ending))
    with new_file(path, force) as file:
        file.write(picture.getvalue())


def _add_fonts(figure: Figure) -> None:
    """Lets texts, such as names of files, take characters from other fonts that are installed."""
    from matplotlib.font_manager import fontManager
    from matplotlib.text import Text

    texts = [text for text in figure.findobj(Text) if isinstance(text, Text) and not text.get_text().isascii()]
    installed = fontManager.get_font_names() if texts else []
    further = [name for name in _FURTHER_FONTS if name in installed]
    for text in texts:
        text.set_fontfamily([*text.get_fontfamily(), *further])
