"""Figure of the tests of a filter: NIS, NEES and the correlation of the innovations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..filters.filter_consistency import Consistency
from .style import labelled, line_style, new_axes

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_BOUND = {"color": "0.35", "linestyle": "--", "linewidth": 1.0}


def plot_consistency(result: Consistency, *, ax: Sequence[Axes] | None = None) -> NDArray[Any]:
    """Draw the NIS of each sample, the NEES if the truth is known, and the correlation of the innovations, with bounds.

    Parameters
    ----------
    result : Consistency
        What `consistency` returned.
    ax : sequence of two or three matplotlib.axes.Axes, optional
        Axes for the NIS, the NEES if there is one, and the correlation; by default new ones.

    Returns
    -------
    ndarray of matplotlib.axes.Axes, shape (2,) or (3,)
        The axes drawn into.

    Raises
    ------
    TypeError
        If `result` is not a Consistency.
    ValueError
        If `ax` has another number of axes.

    Examples
    --------
    >>> import matplotlib.pyplot as plt
    >>> import numpy as np
    >>> from filterpy.common import Saver
    >>> from kfopc_filterpy import KFOPC
    >>> from kfopc_filterpy.filters import consistency
    >>> from kfopc_filterpy.plot import plot_consistency
    >>> kf = KFOPC(dim_x=1)
    >>> saver = Saver(kf)
    >>> for z in np.random.default_rng(0).standard_normal(200):
    ...     kf.predict()
    ...     kf.update(z)
    ...     saver.save()
    >>> axes = plot_consistency(consistency(saver))
    >>> [ax.get_ylabel() for ax in axes]
    ['NIS', 'Correlation']
    >>> plt.close(axes[0].figure)
    """
    if not isinstance(result, Consistency):
        raise TypeError(f"result must be what consistency() returned, got {type(result).__name__}")
    errors = [("NIS", result.nis, result.nis_bounds)]
    if result.nees is not None and result.nees_bounds is not None:
        errors.append(("NEES", result.nees, np.tile(result.nees_bounds[:, np.newaxis], result.nees.size)))
    axes = np.asarray(new_axes(ax, len(errors) + 1, sharex=False))
    within = f"{100 * result.coverage:g} % bounds"
    for panel, (name, values, bounds) in zip(axes, errors, strict=False):
        samples = np.arange(values.size)
        panel.plot(samples, values, ".", markersize=3, color=line_style(0)["color"], label=f"{name} of each sample")
        panel.plot(samples, bounds[0], label=within, **_BOUND)
        panel.plot(samples, bounds[1], **_BOUND)
        panel.set(xlabel="Sample", ylabel=name, xlim=(0, values.size - 1))
    lags = np.arange(1, result.autocorrelation.size + 1)
    axes[-1].bar(lags, result.autocorrelation, color=line_style(0)["color"], label="Correlation of the innovations")
    axes[-1].plot(lags, result.autocorrelation_bounds, label=within, **_BOUND)
    axes[-1].plot(lags, -result.autocorrelation_bounds, **_BOUND)
    axes[-1].set(xlabel="Lag (samples)", ylabel="Correlation")
    axes[-1].xaxis.get_major_locator().set_params(integer=True)
    for panel in axes:
        labelled(panel)
    return axes
