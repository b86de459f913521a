"""Light on sub-pixels through a PSF stamp, both interpolated by the same cubic B-spline."""

from __future__ import annotations

import numpy as np
from scipy import fft, sparse

from engine.conventions import FloatArray
from engine.imaging.optics.spline import spline_weights


def deposit_matrix(pixels: int, subrays: int) -> sparse.csr_matrix:
    """Matrix (pixels, pixels * subrays) that lays rays on pixels by cubic B-spline weights."""
    rows, columns, values = [], [], []
    for sub in range(subrays):
        first, weights = spline_weights((sub + 0.5) / subrays - 0.5)
        for k, weight in enumerate(weights):
            to = np.arange(pixels) + first + k
            inside = (to >= 0) & (to < pixels)
            rows.append(to[inside])
            columns.append((np.arange(pixels) * subrays + sub)[inside])
            values.append(np.full(inside.sum(), weight))
    where = (np.concatenate(rows), np.concatenate(columns))
    return sparse.csr_matrix((np.concatenate(values), where), shape=(pixels, pixels * subrays))


class StampBlur:
    """Light on sub-pixels through the PSF, on a window of the image and ``outside`` pixels round it.

    ``x`` and ``y`` are the centres of the sub-pixels, ``side`` [arcsec] apart. Light that was integrated over the
    sub-pixels has been smoothed by them, beside what the PSF does: the PSF is divided by their transfer function.
    """

    def __init__(
        self, spline: FloatArray, x: FloatArray, y: FloatArray, scale: float, subrays: int, outside: int
    ) -> None:
        self.side = scale / subrays
        self._outside, self._shape = outside, (y.size, x.size)
        beyond = scale * np.arange(1, outside + 1)
        offsets = ((np.arange(subrays) + 0.5) / subrays - 0.5) * scale
        wide = [np.concatenate([axis[0] - beyond[::-1], axis, axis[-1] + beyond]) for axis in (x, y)]
        self.x, self.y = (np.add.outer(axis, offsets).ravel() for axis in wide)
        self._deposit_x, self._deposit_y = (deposit_matrix(axis.size, subrays) for axis in wide)
        middle = spline.shape[0] // 2
        columns, rows = (axis.size for axis in wide)
        high, across = min(middle, rows - 1), min(middle, columns - 1)
        self._fft_shape = (fft.next_fast_len(rows + high, real=True), fft.next_fast_len(columns + across, real=True))
        kernel = np.zeros(self._fft_shape)
        kernel[: 2 * high + 1, : 2 * across + 1] = spline[
            middle - high : middle + high + 1, middle - across : middle + across + 1
        ]
        self._kernel = fft.rfft2(np.roll(kernel, (-high, -across), axis=(0, 1)))
        height, width = self._fft_shape
        smoothed = np.outer(np.sinc(fft.fftfreq(height) / subrays), np.sinc(fft.rfftfreq(width) / subrays))
        self._sharper = self._kernel / smoothed

    def __call__(self, fine: FloatArray, *, integrated: bool) -> FloatArray:
        """Images (..., ny, nx) of the window from the flux of each sub-pixel (..., rows, columns).

        That flux is integrated over the sub-pixel or sampled in its middle.
        """
        rows, columns = fine.shape[-2:]
        across = (self._deposit_x @ fine.reshape(-1, columns).T).T.reshape(-1, rows, self._deposit_x.shape[0])
        k, (ny, nx), (height, width) = self._outside, self._shape, self._fft_shape
        out = np.empty((across.shape[0], ny, nx))
        for m, image in enumerate(across):
            # Along x only rows with light are transformed, and only those of the window are transformed back.
            spectrum = fft.fft(fft.rfft(self._deposit_y @ image, width, axis=1), height, axis=0)
            spectrum *= self._sharper if integrated else self._kernel
            wanted = fft.ifft(spectrum, axis=0, overwrite_x=True)[k : k + ny]
            out[m] = fft.irfft(wanted, width, axis=1)[:, k : k + nx]
        return out.reshape(*fine.shape[:-2], ny, nx)
