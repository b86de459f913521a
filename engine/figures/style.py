"""How figures of biases look: colours that the colour-blind tell apart, and never colour alone."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.markers import CARETDOWN, CARETUP
from matplotlib.patches import Patch

from engine.biases import BiasPoint, HostQuantity, Trend
from engine.conventions import FloatArray
from engine.errors import FigureError, NothingToShowError
from engine.result import INDEX_RANGES, IndexPrior

OKABE_ITO = ("#0072B2", "#D55E00", "#009E73", "#E69F00", "#56B4E9", "#CC79A7", "#000000", "#F0E442")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "p")
LINES = ("-", "--", "-.", ":")
INK = "0.15"
TARGET_BANDS = ((0.5, "0.84"), (1.25, "0.93"))
"""Half-widths [mag] and greys: what is wanted, and the scatter of black-hole masses (0.5 dex), as in the paper."""
Limits = Literal["bands", "data"]
LIMITS: tuple[Limits, ...] = get_args(Limits)
"""How far magnitudes are shown: the whole of both bands at least, or as near as the points are."""
MINUS = "\N{MINUS SIGN}"
# Plain words wherever they do: mathematics is drawn letter by letter, and nobody finds it or reads it aloud.
AXIS_LABELS: dict[HostQuantity, str] = {
    "magnitude": f"magnitude, found {MINUS} true [mag]",
    "r_eff": f"effective radius, found {MINUS} true [arcsec]",
    "r_eff_galfit": f"radius on the major axis, found {MINUS} true [arcsec]",
    "n": f"n, found {MINUS} true",
    "q": f"axis ratio, found {MINUS} true",
    "position_angle": f"position angle, found {MINUS} true [deg]",
    "x": f"x, found {MINUS} true [arcsec]",
    "y": f"y, found {MINUS} true [arcsec]",
}
NAMES: dict[HostQuantity, str] = {
    "magnitude": "magnitude",
    "r_eff": "effective radius",
    "r_eff_galfit": "effective radius on the major axis",
    "n": "Sérsic index",
    "q": "axis ratio",
    "position_angle": "position angle",
    "x": "position in x",
    "y": "position in y",
}
TREND_LABELS: dict[Trend, str] = {
    "arc_magnitude": "host arc in the image plane [AB mag]",
    "agn_contrast": f"AGN {MINUS} host arc [mag]",
    "surface_brightness": "host surface brightness [mag arcsec⁻²]",
}
_MOST_VECTORS = 2_000
_CHARACTERS_AN_INCH = 11.0
_LEAST_REACH: dict[HostQuantity, float] = {"magnitude": 1.5}
_FAR, _ROOM, _LEAST_SIDE = 4.0, 1.08, 0.15


def new_figure(width: float, height: float) -> Figure:
    """An empty figure [inches] whose legends and labels find their room."""
    return Figure(figsize=(width, height), layout=ConstrainedLayoutEngine(w_pad=0.05, h_pad=0.05))


def plain(text: str) -> str:
    """A name of anybody's as a text that is shown as it stands: no mathematics, nothing that XML cannot hold."""
    return "".join(letter if letter.isprintable() else " " for letter in text).replace("$", r"\$")


def title(figure: Figure, *lines: str) -> None:
    """A title that is broken where the figure ends, its first line larger than the page's text."""
    room = int(_CHARACTERS_AN_INCH * figure.get_figwidth())
    broken = []
    for line in lines:
        # Parts of like length, rather than a last word alone.
        parts = max(1, -(-len(line) // room))
        broken += textwrap.wrap(line, room if parts == 1 else min(room, len(line) // parts + 6))
    figure.suptitle("\n".join(broken), fontsize=10.5)


def legend(
    figure: Figure, handles: Sequence[Line2D | Patch], columns: int, *, side: str = "center", name: str = ""
) -> None:
    """A legend for all panels, below them; two stand beside one another at the sides left and right."""
    figure.legend(
        handles=list(handles), loc=f"outside lower {side}", ncols=columns, fontsize=9, frameon=False,
        title=name or None, title_fontsize=9, alignment="left", handlelength=1.6, columnspacing=1.4,
    )  # fmt: skip


def mark(label: str, look: Look, *, line: str = "none") -> Line2D:
    """An entry of a legend."""
    return Line2D(
        [], [], marker=look.marker, color=look.colour, linestyle=line, markersize=7, label=label, fillstyle=look.fill,
        markerfacecoloralt="white", markeredgecolor=INK, markeredgewidth=0.5,
    )  # fmt: skip


def bar(label: str) -> Line2D:
    """The legend's entry of the error bars."""
    return Line2D([], [], marker="|", color=INK, linestyle="none", markersize=13, markeredgewidth=1.0, label=label)


def prior_label(prior: IndexPrior) -> str:
    """What was assumed about the Sersic index."""
    if prior == "fixed":
        return "n fixed to the truth"
    low, high = INDEX_RANGES[prior]
    return f"n free in {low:g}–{high:g}"  # noqa: RUF001 - a range


def prior_markers(priors: Iterable[IndexPrior]) -> dict[IndexPrior, str]:
    """A circle for n free and a star for n fixed, as in the paper; a diamond for its 1-4 beside the wider range."""
    there = set(priors)
    known: dict[IndexPrior, str] = {"wide": "o", "free": "D" if "wide" in there else "o", "fixed": "*"}
    return {prior: known[prior] for prior in known if prior in there}


def shades(count: int) -> list[str]:
    """Colours of an ordered quantity, dark to light; told apart by their lightness too."""
    return [to_hex(mpl.colormaps["cividis"](0.92 * step / max(count - 1, 1))) for step in range(count)]


def target_bands(axes: Axes) -> None:
    """The paper's bands of 0.5 and 1.25 mag round zero."""
    for half, grey in reversed(TARGET_BANDS):
        axes.axhspan(-half, half, facecolor=grey, edgecolor="none", zorder=0.1, gid=f"band-{half:g}")


def band_patches() -> list[Patch]:
    """The bands' entries of a legend."""
    return [
        Patch(facecolor=grey, edgecolor="0.6", linewidth=0.5, label=f"±{half:g} mag") for half, grey in TARGET_BANDS
    ]


def zero_line(axes: Axes) -> None:
    """Where nothing is biased."""
    axes.axhline(0.0, color="0.35", linewidth=0.8, zorder=0.5)


@dataclass(frozen=True)
class Look:
    """Symbol of a series: marker, colour, size [points], which part is filled, and its name in the SVG."""

    marker: str
    colour: str
    size: float
    name: str
    fill: Literal["full", "left", "right", "bottom", "top"] = "full"


def limit_biases(
    axes: Axes, quantity: HostQuantity, biases: Sequence[float], errors: Sequence[float], limits: Limits
) -> None:
    """Set limits round zero that show all but far outliers, and say how many are beyond them.

    Far is four times further than nine tenths of all; :func:`draw_points` puts those at the edge.

    Raises
    ------
    FigureError
        There are no such limits.
    """
    if limits not in LIMITS:
        raise FigureError(f"limits: got {limits!r}, allowed is one of {list(LIMITS)}")
    values, bars = np.asarray(biases, dtype=float), np.asarray(errors, dtype=float)
    least = _LEAST_REACH.get(quantity, 0.0) if limits == "bands" else 0.0
    usual = max(_FAR * float(np.quantile(np.abs(values), 0.9)), least)
    reach = [float((bars - values).max()), float((bars + values).max())]
    ends = [end if end <= 1.5 * usual else usual for end in (max(end, 0.0) for end in reach)]
    ends = [max(_ROOM * end, least, _LEAST_SIDE * sum(ends)) or 1.0 for end in ends]
    axes.set_ylim(-ends[0], ends[1])
    beyond = int(((values < -ends[0]) | (values > ends[1])).sum())
    if beyond:
        axes.text(
            1.0, 1.0, f"{beyond} beyond, at the edge", transform=axes.transAxes, ha="right", va="bottom", fontsize=8
        )


def within(axes: Axes, biases: Sequence[float] | FloatArray) -> FloatArray:
    """Biases moved to just within the panel's limits."""
    low, high = axes.get_ylim()
    inset = 0.03 * (high - low)
    return np.asarray(np.clip(biases, low + inset, high - inset), dtype=float)


def draw_points(axes: Axes, x: Sequence[float], bias: Sequence[float], error: Sequence[float], look: Look) -> None:
    """Points with error bars; those beyond the limits as carets at the edge, without bars."""
    low, high = axes.get_ylim()
    values, at = np.asarray(bias, dtype=float), np.asarray(x, dtype=float)
    below, above = values < low, values > high
    inside = ~(below | above)
    container = axes.errorbar(
        at[inside], values[inside], yerr=np.asarray(error, dtype=float)[inside], linestyle="none", elinewidth=0.9,
        ecolor=look.colour, color=look.colour, marker=look.marker, markersize=look.size, fillstyle=look.fill,
        markerfacecoloralt="white", markeredgecolor=INK, markeredgewidth=0.4, rasterized=len(at) > _MOST_VECTORS,
    )  # fmt: skip
    container.lines[0].set_gid(look.name)
    edge: FloatArray = within(axes, values)
    for gone, caret in ((below, CARETDOWN), (above, CARETUP)):
        if gone.any():
            axes.plot(
                at[gone], edge[gone], linestyle="none", marker=caret, markersize=7, color=look.colour,
                markeredgecolor=INK, markeredgewidth=0.4, gid=f"{look.name}-beyond",
            )  # fmt: skip


def tidy(axes: Axes) -> None:
    """Ticks of a size that can be read on a phone."""
    axes.tick_params(labelsize=9)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def in_order(points: Iterable[BiasPoint]) -> list[BiasPoint]:
    """Points in an order of their own, so that a figure does not depend on how they were read.

    Raises
    ------
    NothingToShowError
        There are none.
    """
    ordered = sorted(
        points,
        key=lambda p: (p.system, p.magnitude, p.setting.order(), p.estimator, p.index_prior, p.seed, p.run_id),
    )
    if not ordered:
        raise NothingToShowError("points: got none, allowed is at least one result")
    return ordered


def only(points: Sequence[BiasPoint], field: str) -> str:
    """The one value of a field; a FigureError where points differ in it."""
    values = sorted({str(getattr(point, field)) for point in points})
    if len(values) > 1:
        raise FigureError(f"{field}: got {', '.join(values)}, allowed is one of them in a figure")
    return values[0]
