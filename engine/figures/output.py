"""A figure as the bytes of a file: the same bytes for the same figure, so that an ETag of them holds."""

from __future__ import annotations

import io
import threading
from typing import Literal, get_args

import matplotlib as mpl
from matplotlib.figure import Figure

from engine.errors import FigureError

FigureFormat = Literal["svg", "png"]
FIGURE_FORMATS: tuple[FigureFormat, ...] = get_args(FigureFormat)
DPI = 144
# Texts stay texts: searched, read aloud, and half the size; the salt names the clip paths, else drawn by lot.
_SVG = {"svg.hashsalt": "hostlens", "svg.fonttype": "none"}
_lock = threading.Lock()
"""Matplotlib's settings are those of the whole process."""


def figure_bytes(figure: Figure, kind: FigureFormat, *, dpi: int = DPI) -> bytes:
    """The figure as SVG or PNG, without a date; ``dpi`` is that of a PNG.

    Raises
    ------
    FigureError
        Another format is asked for.
    """
    if kind not in FIGURE_FORMATS:
        raise FigureError(f"format: got {kind!r}, allowed is one of {list(FIGURE_FORMATS)}")
    buffer = io.BytesIO()
    metadata = {"Date": None, "Creator": "hostlens"} if kind == "svg" else {"Software": "hostlens"}
    with _lock, mpl.rc_context(_SVG):
        figure.savefig(buffer, format=kind, dpi=dpi, metadata=metadata)
    return buffer.getvalue()
