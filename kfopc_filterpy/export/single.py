"""A controller in single precision, as it runs where it was exported to."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .._types import NumberOrArray
from ..core.block import reasons
from .c99 import exportable
from .precision import in_precision

if TYPE_CHECKING:
    from ..controllers.core_controller import CoreController


class Float32Controller:
    """A controller that computes in `simulate` what its export in float32 computes, bit for bit.

    It shows what single precision changes before anything is embedded. References and errors are rounded to float32, as
    converters would give them.

    Parameters
    ----------
    controller : CoreController
        Controller that `export_c` takes. It is not changed.

    Attributes
    ----------
    name : str
        The controller's.
    rated_power : float, ndarray (J,) or None
        The controller's.
    n_references : int
        The controller's.

    Raises
    ------
    TypeError, ValueError
        As `export_c`.

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy import Plant, fx_lms, simulate
    >>> from kfopc_filterpy.export import Float32Controller
    >>> plant = Plant([0.0, 1.0], [0.0, 0.0, 0.5], fs=16000)
    >>> controller = fx_lms(8, plant, step_size=0.01)
    >>> x = np.random.default_rng(0).standard_normal(1000)
    >>> single = simulate(Float32Controller(controller), x, plant).error
    >>> difference = single - simulate(controller, x, plant).error
    >>> bool(1e-9 < np.abs(difference).max() < 1e-6)
    True
    """

    def __init__(self, controller: CoreController) -> None:
        self._block = in_precision(exportable(controller), np.dtype(np.float32))
        self._multichannel = controller.multichannel
        self.name, self.rated_power = controller.name, controller.rated_power
        self.n_references = controller.n_references

    def control_signal(self, reference: NumberOrArray | None) -> NumberOrArray:
        """Return the control signal y(n) for the newest reference sample x(n), with several channels (J,) and (I,)."""
        self._block.reference[:] = reference
        self._require(self._block.emit())
        y = self._block.control_signal
        return y.astype(np.float64) if self._multichannel else float(y[0])

    def update(self, error: NumberOrArray) -> None:
        """Adapt to the error e(n), with several channels (K,)."""
        self._block.error[:] = error
        self._require(self._block.update())

    def _require(self, answer: int) -> None:
        if answer:
            raise ValueError(f"{reasons('float')[answer]}; nothing was changed")
