"""Acoustic feedback: what the reference microphones hear of the loudspeakers is subtracted."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from .._taps import feedback_paths
from .._types import NumberOrArray
from .._validate import as_channels
from ..plant import Plant, Secondary, as_constant_plant
from ..power.amplifiers import Amplifiers
from .base import Controller, WrappedController, differing_counts, listening
from .channel_samples import PlayedSound, channel_sample


class FeedbackNeutralizer(WrappedController):
    r"""A controller whose reference is freed of the sound that the loudspeakers send back to the reference microphone.

    The reference microphone hears the noise and, through the feedback path f, the control signal. The controller gets

    .. math:: x(n) - \sum_{k \ge 1} \hat f_k\, y(n - k)

    This is feedback neutralisation with the identified path. The difference :math:`f - \hat f` closes a loop through
    the control filter; `paths.feedback_margin` says how far this loop is from instability.

    Parameters
    ----------
    controller : Controller
        Any controller: a built-in one, a wrapped one, or one of your own.
    feedback : array_like, shape (taps,) or (I, J, taps), control system, Recording, or Plant with a feedback path
        Identified path from the loudspeaker to the reference microphone, or those from J loudspeakers to I reference
        microphones, see `paths.estimate_path`. Its first tap must be 0: sound takes time.
    amplifier : amplifier model or sequence of J of them, optional
        Known amplifiers: the feedback is then computed from what they deliver, not from y.

    Raises
    ------
    TypeError
        An object that is not a controller, or an amplifier that is not a function.
    ValueError
        A path without delay, or one whose numbers of channels differ from the controller's.

    Notes
    -----
    `simulate` calls it from Python sample by sample. The subtraction takes ``I * J * taps`` multiplications per sample.

    References
    ----------
    S. M. Kuo, D. R. Morgan, "Active noise control: a tutorial review", Proc. IEEE 87(6), 1999, section II.D.

    Examples
    --------
    The same result as without feedback, if the path is known exactly:

    >>> import numpy as np
    >>> from kfopc_filterpy import Plant, fx_lms, simulate
    >>> from kfopc_filterpy.controllers import FeedbackNeutralizer
    >>> x = np.random.default_rng(0).standard_normal(2000)
    >>> paths = {"secondary": [0.0, 1.0], "primary": [0.0, 0.0, 0.0, 1.0]}
    >>> plant = Plant(**paths, feedback=[0.0, 0.9, -0.5], fs=16000)
    >>> free = simulate(fx_lms(8, plant, step_size=0.01), x, Plant(**paths, fs=16000))
    >>> result = simulate(FeedbackNeutralizer(fx_lms(8, plant, step_size=0.01), plant), x, plant)
    >>> bool(np.allclose(result.error, free.error))
    True
    """

    def __init__(self, controller: Controller, feedback: Secondary, *, amplifier: Amplifiers = None) -> None:
        super().__init__(controller, "with feedback neutralisation")
        path_fs: float | None
        if isinstance(feedback, Plant):
            as_constant_plant(feedback, "FeedbackNeutralizer")
            if feedback.feedback is None:
                raise ValueError("feedback must be a plant with a feedback path, got one without")
            paths, path_fs = feedback.feedback, feedback.fs
        else:
            paths, path_fs = feedback_paths(feedback)
        for name, own in differing_counts(controller, n_references=len(paths), n_loudspeakers=paths.shape[1]):
            raise ValueError(
                f"feedback must be (I references, J loudspeakers, taps) with the controller's {name} of {own}, "
                f"got {paths.shape}"
            )
        self._n_taps, self._path_fs = paths.shape[2], path_fs
        self._several: bool = getattr(controller, "multichannel", max(paths.shape[:2]) > 1)
        self._sound = PlayedSound(paths[..., 1:], amplifier)  # of the samples before the newest reference

    def __repr__(self) -> str:
        return f"<{self.name}: {self._n_taps} taps, {self.controller!r}>"

    def control_signal(self, reference: NumberOrArray) -> NumberOrArray:
        """Return the control signal y(n), or (J,), for the newest reference sample x(n), or (I,)."""
        x = channel_sample(reference, self._sound.n_outputs, "reference", "references") - self._sound.output()
        y = self.controller.control_signal(x if self._several else float(x[0]))
        self._sound.play(y)
        return y

    def listen(self, references: ArrayLike, errors: ArrayLike) -> None:
        """Let the controller follow `references` and `errors` while the loudspeakers are silent.

        What the loudspeakers played before is still subtracted.
        """
        controller = listening(self.controller)
        x = np.array(np.atleast_2d(as_channels(references, "references")))
        sound = self._sound.branched()
        for n in range(x.shape[1]):
            x[:, n] -= sound.output()
            sound.push(np.zeros(sound.n_inputs))
        controller.listen(x if self._several else x[0], errors)
        self._sound = sound

    def _rates(self) -> dict[str, float | None]:
        return {"feedback path": self._path_fs}
