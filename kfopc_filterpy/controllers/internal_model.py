"""Feedback and hybrid control: an internal model gives a controller the disturbance as a reference."""

from __future__ import annotations

from copy import deepcopy
from typing import TypeVar

from .core_controller import CoreController

_Made = TypeVar("_Made", bound=CoreController)


def with_internal_model(controller: _Made) -> _Made:
    r"""Return a controller as a feedback controller, or with reference microphones as a hybrid one.

    The internal model computes the disturbance at each error microphone from the error there and from what the
    loudspeakers play. Its last sample is a reference of the controller:

    .. math::

       x_k(n) = \hat d_k(n - 1),

       \hat d_k(n) = e_k(n) + \sum_j (\hat s_{kj} * y_j)(n)

    The error e(n) is only known after y(n) has been played, so the newest sample is that of n - 1. With an exact
    estimate of the secondary path, the controller is that of a feedforward system whose reference is d(n - 1): it
    predicts the disturbance over the delay of the secondary path. Otherwise, the error of the estimate closes a loop
    through the control filter; `paths.internal_model_margin` says which error this loop tolerates.

    This is not what `FeedbackNeutralizer` is for: that class removes the sound of the loudspeakers from the signal
    of a reference microphone (acoustic feedback).

    Parameters
    ----------
    controller : CoreController
        Any controller whose steps are in the core, made with ``n_references=K`` for K error microphones, or
        ``n_references=I + K`` for hybrid control with I reference microphones.
        It is not changed.

    Returns
    -------
    CoreController
        A copy with an internal model, and with `n_references` the number I of reference microphones. Where other
        controllers take a reference, it takes those of the microphones, (I,), or None if there are none.

    Raises
    ------
    TypeError
        An object that is not a `CoreController`: a wrapper (wrap the result instead), or a controller that adapts once
        per block or is in plain Python.
    ValueError
        A controller with fewer references than error microphones, or one that already has an internal model.

    Notes
    -----
    In the weights, (J, I + K, L), those for the disturbances come last. An error that is refused, or never given,
    counts as silence: the next reference is 0. If a limiter or a known amplifier changes the control signal, the model
    uses the signal that results. `process` takes the errors of samples with ``adapt=False`` as references, too.

    References
    ----------
    S. J. Elliott, Signal Processing for Active Control, Academic Press 2001, ch. 6 (internal model control).
    S. M. Kuo, D. R. Morgan, "Active noise control: a tutorial review", Proc. IEEE 87(6), 1999, sections IV and V.

    Examples
    --------
    A tone can be predicted, so no reference microphone is needed:

    >>> from kfopc_filterpy import Plant, kf_opc, simulate
    >>> from kfopc_filterpy.controllers import with_internal_model
    >>> from kfopc_filterpy.signals import tone
    >>> plant = Plant([0.0, 0.0, 0.8], fs=16000)
    >>> plain = kf_opc(16, plant, rated_power=1.0, state_noise=1e-6, measurement_noise=1e-3)
    >>> controller = with_internal_model(plain)
    >>> simulate(controller, None, plant, disturbance=tone(400.0, 1.0, fs=16000)).noise_reduction_db > 20
    True
    """
    if not isinstance(controller, CoreController):
        raise TypeError(
            f"controller must be one whose steps are in the core, got {type(controller).__name__}: wrap the result, not "
            "the controller, or subtract s^ * y in your own update"
        )
    if controller.internal_model:
        raise ValueError(
            f"{controller.name} already has an internal model: pass the controller that was made without one"
        )
    if controller.n_references < controller.n_microphones:
        raise ValueError(
            f"controller must have a reference for each of the {controller.n_microphones} error microphones, which the "
            f"internal model gives, and those of its reference microphones: got n_references={controller.n_references}"
        )
    other = deepcopy(controller)
    other._add_internal_model()
    return other
