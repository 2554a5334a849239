"""Secondary paths that change: they are identified while the control runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from math import isfinite
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.signal import oaconvolve
from scipy.special import stdtr

from .._validate import as_generator, as_number, as_positive, as_signal
from ..paths.least_squares import correlation_matrix, cross_correlation, cross_correlation_matrix
from ..power.amplifiers import Amplifier
from ..power.constraint import DEFAULT_FS
from .base import OVERFLOW, FilteredReferenceController, WrappedController
from .channel_samples import amplifier_functions, channel_sample
from .divergence import DivergenceGuard

FRAME_S = 0.02  # the error's power is measured over frames of this length, or of the secondary path's if that is longer
SHORT = 1 / 8  # of the memory: this is the memory of the fit that follows fast changes
FEWEST_FRAMES = 8  # with fewer, no better prediction is significant
LOUDEST_PROBE = 100.0  # times the power that it would have with the paths that the tracker was given
LARGEST_DB = 300.0  # larger settings in dB count as this one; they would overflow
RIDGE = 1e-9  # relative to the mean power of the regressors, so that a narrow-band reference has a solution


@dataclass(frozen=True)
class PathChange:
    """New estimate of the secondary paths to a microphone that a `PathTracker` took over.

    Attributes
    ----------
    time_s : float
        Time since the tracker was made, in s.
    change_db : float
        ``10 log10(sum (new - old)^2 / sum old^2)``: by how much the estimate changed.
    prediction_gain_db : float
        By how many dB less of this microphone's error the new estimate left unexplained, on samples that it had not
        been fitted to.
    memory_s : float
        Memory of the fit that it comes from.
    source : str
        "probe" or "control signal".
    microphone : int
        Error microphone to which the paths lead, from 0; with one channel 0.
    """

    time_s: float
    change_db: float
    prediction_gain_db: float
    memory_s: float
    source: str
    microphone: int = 0


@dataclass(frozen=True)
class Model:
    """What a fit found: the primary paths, (K, I, P), and by source the secondary paths, (K, J, S)."""

    primary: np.ndarray
    secondary: dict[str, np.ndarray]


Sums = tuple[np.ndarray, np.ndarray, np.ndarray, int]  # of a block's products, see `block_sums`


class JointFit:
    """Least squares of the errors ``e_k = sum_i p_ki * x_i - sum_j s_kj * (y_j + v_j)``.

    The sums of the past are forgotten exponentially. All microphones have the regressors in common, and so the matrix.

    Parameters
    ----------
    shape : tuple of int
        Numbers of microphones K, loudspeakers J and references I.
    n_primary, n_secondary : int
        Numbers of taps P of a primary path and S of a secondary path.
    keep : float
        Factor of the past sums at each addition.
    """

    def __init__(self, shape: tuple[int, int, int], n_primary: int, n_secondary: int, keep: float) -> None:
        K, J, n_references = shape
        self.n_x, self.n_y = n_references * n_primary, J * n_secondary  # regressors
        self.n_references, self.keep = n_references, keep
        size = self.n_x + 2 * self.n_y
        self.matrix, self.right = np.zeros((size, size)), np.zeros((size, K))  # of the regressors x, -y, -v
        self.energy, self.noise, self.count = np.zeros(K), np.zeros(K), 0.0

    def take_from(self, other: JointFit) -> None:
        """Replace the sums by those of another fit."""
        self.matrix, self.right = other.matrix.copy(), other.right.copy()
        self.energy, self.noise, self.count = other.energy.copy(), other.noise.copy(), other.count

    def add(self, sums: Sums) -> None:
        """Add the sums of a block, see `block_sums`."""
        matrix, right, energy, count = sums
        self.matrix = self.keep * self.matrix + matrix
        self.right = self.keep * self.right + right
        self.energy, self.count = self.keep * self.energy + energy, self.keep * self.count + count

    def solve(self, known: np.ndarray) -> Model | None:
        r"""Return p and the estimates of s by source; None without a signal.

        "control signal": p and s are fitted together, with the samples of y and v alike. "probe": s is fitted to v alone,
        after subtracting what p * x and s * y explain. Both are drawn towards the `known` paths, (K, J, S). The weight is
        right for paths that may change by all of their energy: :math:`\sigma_k^2 / (|s_{kj}|^2 / S)` with the noise
        that the last fit left at microphone k. So that one matrix serves all microphones, it is their `common_ratio`.
        """
        K, _, S = known.shape
        floor = RIDGE * np.trace(self.matrix) / len(self.matrix)
        if not floor > 0.0:
            return None
        noise = np.where(self.noise > 0.0, self.noise, self.energy / self.count)
        # y and v have the paths in common: their rows and columns are added.
        n_x, before = self.n_x, known.reshape(K, -1).T
        xy, v = slice(n_x + self.n_y), slice(n_x + self.n_y, None)
        matrix, right = self.matrix[xy, xy].copy(), self.right[xy].copy()
        matrix[:, n_x:] += self.matrix[xy, v]
        matrix[n_x:] += np.hstack((self.matrix[v, :n_x], self.matrix[v, n_x : v.start] + self.matrix[v, v]))
        right[n_x:] += self.right[v]
        ridge = np.clip(S * common_ratio(noise, known), floor, floor / RIDGE**2)
        ridges = np.concatenate((np.full(n_x, floor), np.repeat(ridge, S)))
        towards_known = ridges[n_x:, np.newaxis] * before
        drawn = right.copy()
        drawn[n_x:] += towards_known
        try:
            theta = cho_solve(cho_factor(matrix + np.diag(ridges)), drawn)
            left = self.right[v] - self.matrix[v, xy] @ theta + towards_known
            probed = cho_solve(cho_factor(self.matrix[v, v] + np.diag(ridges[n_x:])), left)
        except LinAlgError:
            return None
        unexplained = self.energy + np.sum(theta * (drawn - ridges[:, np.newaxis] * theta - 2.0 * right), axis=0)
        self.noise = np.maximum(unexplained, 1e-12 * self.energy) / self.count
        secondary = {"probe": probed, "control signal": theta[n_x:]}
        return Model(
            theta[:n_x].T.reshape(K, self.n_references, -1),
            {source: taps.T.reshape(K, -1, S) for source, taps in secondary.items()},
        )


def common_ratio(powers: np.ndarray, paths: np.ndarray) -> np.ndarray:
    """Return for each loudspeaker, (J,), a mean of ``powers[k] / sum(paths[k, j]**2)`` over the microphones.

    A harmonic mean does not depend on how sensitive each microphone is. Silent microphones are left out. The result is infinite
    for a loudspeaker that no microphone hears, and 0 if all microphones are silent.
    """
    heard = powers > 0.0
    if not heard.any():
        return np.zeros(paths.shape[1])
    with np.errstate(divide="ignore"):
        return 1.0 / np.mean(np.sum(paths[heard] ** 2, axis=-1) / powers[heard, np.newaxis], axis=0)


def block_sums(
    x: np.ndarray,
    y: np.ndarray,
    v: np.ndarray,
    errors: np.ndarray,
    n_primary: int,
    n_secondary: int,
    unknown: np.ndarray | None = None,
) -> Sums:
    """Return the sums of products for `JointFit.add`: matrix, right sides, energies of the errors, number of samples.

    `errors` is (K, n). The other signals, (I, m), (J, m), (J, m), begin ``n_primary - 1`` samples earlier. The errors of
    samples that are `unknown`, (n,) of bool, must be 0, and these samples are left out.
    """
    n, start = errors.shape[1], n_primary - 1
    parts = [(one, n_primary) for one in x] + [(-one, n_secondary) for one in (*y, *v)]
    ends = np.cumsum([taps for _, taps in parts])
    matrix, right = np.empty((ends[-1], ends[-1])), np.empty((ends[-1], len(errors)))
    for i, (first, taps) in enumerate(parts):
        rows = slice(ends[i] - taps, ends[i])
        right[rows] = np.transpose([cross_correlation(error, first[start - taps + 1 :]) for error in errors])
        matrix[rows, rows] = correlation_matrix(first, taps, start)
        for (second, others), end in zip(parts[i + 1 :], ends[i + 1 :], strict=True):
            columns = slice(end - others, end)
            matrix[rows, columns] = cross_correlation_matrix(first, second, taps, start, others)
            matrix[columns, rows] = matrix[rows, columns].T
    matrix, count = n * matrix, n
    if unknown is not None and unknown.any():
        left_out = np.hstack(
            [sliding_window_view(one[start - taps + 1 :], taps)[:n][unknown, ::-1] for one, taps in parts]
        )
        matrix, count = matrix - left_out.T @ left_out, n - len(left_out)
    return matrix, n * right, np.array([error @ error for error in errors]), count


def through(paths: np.ndarray, signals: np.ndarray) -> np.ndarray:
    """Return what arrives through paths (K, J, taps) of signals (J, n) once the taps are filled, (K, n - taps + 1)."""
    return oaconvolve(signals[np.newaxis], paths, mode="valid", axes=-1).sum(axis=1)


class Evidence:
    """Comparison of two predictions, frame by frame, since the second one began to lead."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Begin anew."""
        self.count, self.total, self.squares = 0, 0.0, 0.0

    def add(self, unexplained: np.ndarray, by_other: np.ndarray) -> None:
        """Add frames, (n,), with the powers that the two predictions left unexplained."""
        both = unexplained + by_other
        shares = (unexplained - by_other)[both > 0.0] / both[both > 0.0]
        self.count += shares.size
        self.total += float(np.sum(shares))
        self.squares += float(np.sum(shares**2))
        if self.total <= 0.0:
            self.forget()

    @property
    def mean(self) -> float:
        """Mean of (A - B) / (A + B) for the powers A and B of the first and the second."""
        return self.total / max(self.count, 1)

    @property
    def p_value(self) -> float:
        """Probability of a mean as large as this by chance, by Student's t test; 1 while there are too few frames."""
        if self.count < FEWEST_FRAMES:
            return 1.0
        variance = (self.squares - self.count * self.mean**2) / (self.count - 1)
        standard_error = np.sqrt(max(variance, np.finfo(float).tiny) / self.count)
        return float(stdtr(self.count - 1, -self.mean / standard_error))

    @property
    def gain_db(self) -> float:
        """Ratio A/B in dB that belongs to the mean."""
        return float(10 * np.log10((1.0 + self.mean) / max(1.0 - self.mean, 1e-12)))


class PathTracker(WrappedController):
    r"""A controller that identifies its secondary path while it runs, and follows it if it changes.

    White noise v(n), the probe, is added to the control signal, far below the residual noise. Each loudspeaker has a
    probe of its own, independent of the others. Two least-squares fits, one of which remembers the last `memory_s` and
    the other an eighth of it, describe the error at microphone k by

    .. math:: e_k = \sum_i p_{ki} * x_i - \sum_j s_{kj} * (y_j + v_j)

    Each fit offers two estimates of s. "control signal" is the s of the fit itself, in which the samples of the control
    signal y count like those of the probe. It is exact if only the secondary path changes. If the primary path changes
    and the controller follows it, y and the change of p cannot be told apart, and this estimate is wrong. "probe" is a
    fit of s to v alone, after subtracting :math:`p * x - s * y` from the error. The probe is independent of everything
    else, so this estimate holds in any case, but it takes longer.

    A new estimate is taken over only if a test says that it is better. The test uses samples that no fit has seen yet,
    and only the probe. Over the frames of 20 ms since the new estimate began to lead, it must leave less of the error
    unexplained than the one in use, and the probability of such a difference by chance must be below `p_value`. Then
    the controller's `secondary_path` is set. Its weights stay, so the control signal does not jump. Each microphone has a
    test of its own, for all paths that lead to it; the other microphones keep their paths.

    The controller does not hear the probe: what the probe contributes to the error, according to the estimate in use,
    is subtracted.

    If a loudspeaker's paths become weaker, its probe becomes louder, but at most by 20 dB in comparison with the paths
    that the tracker was given. Otherwise the probe of a loudspeaker that is not connected would grow without limit.

    A sample after which `update` is not called is played, but fits and tests leave out its error, which is not known.

    Between a jump of the path and its discovery, the controller may diverge. Two things keep the noise from becoming
    much more than `hold_db` louder than it is expected to be without control, as a sum of powers over the microphones.
    The controller's updates are skipped, until the error at full volume is 3 dB below that limit or another path is
    taken over. And the control signal is turned down. Both act within a frame, as soon as the error exceeds the limit.
    From then on the gain falls or rises by 2 dB in each frame, to where the error is 3 dB below the limit, or to 1.

    What is expected is the mean power of the disturbance estimates over the memory, times the power of the reference
    relative to its own mean if that is above 1. So noise that becomes much louder than the reference tells is taken for
    a divergence at first: the control signal is turned down, which shows that the noise is to blame, and up again. This
    takes a second or two.

    Parameters
    ----------
    controller : FilteredReferenceController
        Any built-in controller, of one channel or several.
    rng : int or numpy.random.Generator
        Seed of the probe.
    fs : float, default 16000
        Sample rate in Hz.
    probe_db : float, default -20
        Power of the probe at the error microphone, in dB of that of the residual noise. At -20 dB it raises the
        residual by 0.04 dB, at -25 dB by 0.014 dB, but a change of the path is then found later. With several
        microphones it is the mean of these ratios; every loudspeaker has an equal share in it.
    probe_filter : array_like, shape (n,), optional
        Impulse response that colours the probe, for example to make it inaudible; only its shape counts. By default the
        probe is white. Where it has no power, the estimate stays as it is.
    memory_s : float, default 8
        Memory of the longer fit in s. A longer one is more accurate on a path that does not change.
    check_s : float, default 0.25
        Time between two tests in s, rounded to whole frames.
    p_value : float, default 1e-6
        Largest probability of a difference by chance with which an estimate is taken over. It is divided among the
        microphones. Once the paths to one are found to have changed, its square root is enough for the others.
    use_control_signal : bool, default True
        Whether the estimates "control signal" take part.
    hold_db : float, default 6
        See above. It must be above 3.01. With a large number, no update is skipped, and the control signal is never
        turned down.
    amplifier : callable or sequence of J of them, optional
        Known amplifiers, functions of a sample, as for the controller. An unknown one that clips distorts the fits.

    Attributes
    ----------
    changes : list of PathChange
        The estimates that were taken over, one for each microphone.

    Raises
    ------
    TypeError
        A controller that is not built in; an amplifier that is not a function, or not one for each loudspeaker.
    ValueError
        A setting that is out of range, `memory_s` below eight times `check_s`, or a probe filter that is all zeros.

    Notes
    -----
    The estimate has as many taps as the controller's. So make the controller with an estimate that is padded with zeros
    to the length of the longest path that may occur. The probe is added after the controller's limiter.

    `simulate` calls it from Python sample by sample. For I references, J loudspeakers, L taps of a control filter and n
    of a path, a test takes about :math:`(I (L + n) + J n)^3 / 3` multiplications for each fit, however many microphones
    there are, and each fit stores a matrix of :math:`(I (L + n) + 2 J n)^2` numbers. In real time, this work is due
    within one sample, at the end of every `check_s`.

    The path must be heard in the error. Where neither probe nor control signal reaches the microphone above its noise,
    the estimate is drawn towards the one in use.

    References
    ----------
    L. J. Eriksson, M. C. Allie, "Use of random noise for on-line transducer modeling in an adaptive active attenuation
    system", J. Acoust. Soc. Am. 85(2), 1989. M. Zhang, H. Lan, W. Ser, "Cross-updated active noise control system with
    online secondary path modeling", IEEE Trans. Speech Audio Process. 9(5), 2001. The block fits and the test are this
    package's own.

    Examples
    --------
    The estimate has the wrong sign and delay. FxLMS alone diverges:

    >>> import numpy as np
    >>> from kfopc_filterpy import FxLMS, noise_reduction_db, simulate
    >>> from kfopc_filterpy.controllers import PathTracker
    >>> x, noise = np.random.default_rng(0).standard_normal((2, 16000))
    >>> disturbance = np.roll(x, 5) + 0.1 * noise
    >>> plant = {"disturbance": disturbance, "secondary_path": [0.0, 0.0, -0.8], "fs": 2000.0}
    >>> simulate(FxLMS(8, [0.0, 1.0, 0.0], step_size=0.005), x, **plant).diverged_at_s is not None
    True
    >>> tracker = PathTracker(FxLMS(8, [0.0, 1.0, 0.0], step_size=0.005), rng=1, fs=2000.0)
    >>> result = simulate(tracker, x, **plant)
    >>> tracker.secondary_path.round(1) + 0.0
    array([ 0. ,  0. , -0.8])
    >>> bool(noise_reduction_db(result.error, result.disturbance) > 19)
    True
    """

    controller: Any  # a FilteredReferenceController

    def __init__(
        self,
        controller: FilteredReferenceController,
        *,
        rng: Any,
        fs: float = DEFAULT_FS,
        probe_db: float = -20.0,
        probe_filter: Any = (1.0,),
        memory_s: float = 8.0,
        check_s: float = 0.25,
        p_value: float = 1e-6,
        use_control_signal: bool = True,
        hold_db: float = 6.0,
        amplifier: Amplifier | Sequence[Amplifier] | None = None,
    ) -> None:
        super().__init__(controller)
        if not isinstance(controller, FilteredReferenceController):
            raise TypeError(f"controller must be a built-in controller, not one around another one, got {controller!r}")
        self._amplifiers = amplifier_functions(amplifier, controller.n_loudspeakers)
        self.fs = as_positive(fs, "fs", unit="Hz")
        self.memory_s = as_positive(memory_s, "memory_s", unit="s")
        self.p_value = as_positive(p_value, "p_value")
        self.use_control_signal = bool(use_control_signal)
        self._probe_share = 10 ** (min(as_number(probe_db, "probe_db", unit="dB"), LARGEST_DB) / 10)
        self._hold_share = 10 ** (min(as_number(hold_db, "hold_db", unit="dB"), LARGEST_DB) / 10)
        if not self._hold_share > 2.0:
            raise ValueError(
                f"hold_db must be above 3.01 dB, got {hold_db:g} dB: held, the error must fall 3 dB below it"
            )
        shape = as_signal(probe_filter, "probe_filter")
        if not shape.any():
            raise ValueError("probe_filter must not be all zeros: the probe would be silent")
        self._shape = shape / np.sqrt(shape @ shape)
        self._rng = as_generator(rng)
        self.changes: list[PathChange] = []
        self.name = f"{controller.name} with path tracking"
        self._allocate(as_positive(check_s, "check_s", unit="s"))
        self._begin_with(controller.secondary_path)

    def _allocate(self, check_s: float) -> None:
        """Set the lengths, and make the fits and the room for a block of signals."""
        K, J, n_references = (
            self.controller.n_microphones,
            self.controller.n_loudspeakers,
            self.controller.n_references,
        )
        S = self.controller.secondary_path.shape[-1]
        P = self.controller.n_taps + S - 1  # length of control filter and path in series: s * y has no older x in it
        self._frame = max(round(FRAME_S * self.fs), S)
        self._block = self._frame * max(round(check_s * self.fs / self._frame), 1)
        if self.memory_s * SHORT * self.fs < self._block:
            raise ValueError(
                f"memory_s must be at least {1 / SHORT:g} times check_s, {self._block / self.fs / SHORT:g} s, "
                f"got {self.memory_s:g} s"
            )
        self._memories = (self.memory_s * SHORT, self.memory_s)
        self._fits = [
            JointFit((K, J, n_references), P, S, np.exp(-self._block / (m * self.fs))) for m in self._memories
        ]
        self._models: list[Model | None] = [None] * len(self._fits)
        candidates = product(range(K), range(len(self._fits)), self._sources())
        self._evidence = {candidate: Evidence() for candidate in candidates}
        self._past = P - 1
        # References, control signal as emitted, probe, and control signal as the controller has made it.
        self._x, self._y, self._v, self._own = (
            np.zeros((n, self._past + self._block)) for n in (n_references, J, J, J)
        )
        self._e, self._known = np.zeros((K, self._block)), np.zeros(self._block, dtype=bool)
        self._n = self._done = 0  # samples of this block, and of all
        self._awaits_error = False  # whether a control signal was given, and no error so far
        self._residual_power = np.zeros(K)
        self._level = np.zeros(J)
        self._guard = DivergenceGuard(n_references, self._frame, self.memory_s * self.fs, self._hold_share)
        self._white = self._rng.standard_normal((J, self._shape.size - 1))
        self._probe = self._next_probe()

    def __repr__(self) -> str:
        return f"<{self.name}: {len(self.changes)} change(s), {self.controller!r}>"

    def _sources(self) -> tuple[str, ...]:
        return ("probe", "control signal") if self.use_control_signal else ("probe",)

    def _next_probe(self) -> np.ndarray:
        """Return the probes of unit power for a frame, (J, n)."""
        white = np.concatenate((self._white, self._rng.standard_normal((len(self._white), self._frame))), axis=1)
        self._white = white[:, self._frame :]
        return np.array([np.convolve(one, self._shape, mode="valid") for one in white])

    def _know(self, path: np.ndarray) -> None:
        """Set the paths in use, from those of the controller."""
        K, J = self.controller.n_microphones, self.controller.n_loudspeakers
        self._paths = np.reshape(path, (K, J, -1))
        self._reversed = self._paths[..., ::-1].copy().reshape(K, -1)  # oldest sample first, as in the signals

    def _begin_with(self, path: np.ndarray) -> None:
        """Set the paths in use, which also limit how loud the probe can become."""
        self._know(path)
        self._given = self._paths

    def _shaped(self, channels: np.ndarray) -> Any:
        """Return values as the controller has them: without an axis of channels if it has one channel."""
        return channels if self.controller.multichannel else float(channels[0])

    def _pass_on(self, name: str, value: Any) -> None:
        super()._pass_on(name, value)
        if name == "secondary_path":
            self._begin_anew()

    def _begin_anew(self) -> None:
        """Start with the controller's path, and forget what was found in comparison with the one before."""
        self._begin_with(self.controller.secondary_path)
        self._guard.begin_anew()
        self._models = [fit.solve(self._paths) for fit in self._fits]
        for evidence in self._evidence.values():  # it was against the path in use before
            evidence.forget()

    def control_signal(self, reference: Any) -> Any:
        """Return the control signal with the probe, y(n) + v(n), for the newest reference sample x(n).

        With several channels, x(n) is (I,), and the control signal is (J,).
        """
        own = np.reshape(self.controller.control_signal(reference), -1)
        self._end_sample()
        y = self._guard.gain * own
        emitted = y + self._level * self._probe[:, self._n % self._frame]
        if np.isfinite(emitted).all():  # otherwise it is a divergence, which the loop detects
            at = self._past + self._n
            played = self._amplified(y)
            self._x[:, at], self._y[:, at], self._v[:, at] = reference, played, self._amplified(emitted) - played
            self._own[:, at] = self._amplified(own)
        self._awaits_error = True
        return self._shaped(emitted)

    def _end_sample(self) -> None:
        """Go on to the next sample if the last one was played and its error never came."""
        if self._awaits_error:
            self._take(None)

    def _amplified(self, y: np.ndarray) -> np.ndarray:
        if self._amplifiers is None:
            return y
        return np.array([amplifier(float(one)) for amplifier, one in zip(self._amplifiers, y, strict=True)])

    def update(self, error: Any) -> None:
        """Let the controller adapt to the error e(n), or (K,), that it would hear if it played alone and at full volume."""
        if self.controller.multichannel:
            errors = channel_sample(error, len(self._e), "error", "microphones")
        else:
            errors = np.array([as_number(error, "error")])
        disturbance, alone = self._without_probe(errors)
        references = self._x[:, self._past + self._n]
        with np.errstate(over="ignore"):
            if not isfinite(errors @ errors + disturbance @ disturbance + alone @ alone):
                raise ValueError(OVERFLOW)
        if self._guard.allows(alone, references):
            self.controller.update(self._shaped(alone))
        self._guard.add(errors, alone, disturbance, references)
        self._take(errors)

    def _without_probe(self, errors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the disturbance estimate, (K,), and the error if the controller played alone and with a gain of 1, (K,)."""
        newest = slice(self._past + self._n + 1 - self._paths.shape[-1], self._past + self._n + 1)
        played = self._y[:, newest] + self._v[:, newest]
        disturbance = errors + self._reversed @ played.reshape(-1)
        return disturbance, disturbance - self._reversed @ self._own[:, newest].reshape(-1)

    def _take(self, errors: np.ndarray | None) -> None:
        """Take the errors of a sample; None if they are not known."""
        self._awaits_error = False
        self._known[self._n] = errors is not None
        self._e[:, self._n] = 0.0 if errors is None else errors
        self._n += 1
        if self._n % self._frame == 0:
            self._end_frame()
            if self._n == self._block:
                self._end_block()

    def _end_frame(self) -> None:
        """Set the level of the probe for the next frame, and let the guard decide for it."""
        frame = slice(self._n - self._frame, self._n)
        count = np.count_nonzero(self._known[frame])
        if count:
            powers = np.sum(self._e[:, frame] ** 2, axis=1) / count
            rate = np.where(self._residual_power > 0.0, self._frame / self._block, 1.0)
            self._residual_power += rate * (powers - self._residual_power)
        ratio, given = (common_ratio(self._residual_power, paths) for paths in (self._paths, self._given))
        ratio = np.minimum(ratio, np.where(np.isfinite(given), LOUDEST_PROBE * given, np.inf))
        self._level = np.sqrt(self._probe_share / ratio.size * np.where(np.isfinite(ratio), ratio, 0.0))
        self._probe = self._next_probe()
        self._guard.end_frame()

    def _end_block(self) -> None:
        """Test the models on this block, take over better paths, then fit the models to this block too."""
        self._done += self._block
        for i, model in enumerate(self._models):
            if model is not None:
                self._judge(i, model)
        if self._known.any():
            lines = (self._x, self._y, self._v)
            sums = block_sums(*lines, self._e, self._past + 1, self._paths.shape[-1], ~self._known)
            for fit in self._fits:
                fit.add(sums)
        self._models = [fit.solve(self._paths) for fit in self._fits]
        if any(self._is_better(candidate, self.p_value / len(self._e)) for candidate in self._evidence):
            self._take_over([best for k in range(len(self._e)) if (best := self._best(k)) is not None])
        for line in (self._x, self._y, self._v, self._own):
            line[:, : self._past] = line[:, self._block :].copy()
        self._n = 0

    def _is_better(self, candidate: tuple[int, int, str], p_value: float) -> bool:
        """Return whether the evidence for a candidate (microphone, fit, source) is significant."""
        return self._models[candidate[1]] is not None and self._evidence[candidate].p_value < p_value

    def _best(self, microphone: int) -> tuple[int, int, str] | None:
        """Return the significant candidate (microphone, fit, source) of the largest gain, once any candidate is significant.

        If it belongs to another microphone, the paths to this one have probably changed too. With only some of the paths
        right, the controller may diverge, so less evidence is enough.
        """
        for p_value in (self.p_value / len(self._e), np.sqrt(self.p_value)):
            found = [one for one in self._evidence if one[0] == microphone and self._is_better(one, p_value)]
            if found:
                return max(found, key=lambda one: self._evidence[one].mean)
        return None

    def _judge(self, i: int, model: Model) -> None:
        """Compare how well the paths in use and those of a model predict what the probe does, on fresh samples.

        Only the probe counts: it is independent of all else, so that no change of the primary path, and no adaptation
        of the control filter, can make a wrong path look better.
        """
        late = self._past + 1 - self._paths.shape[-1]
        left = self._e - through(model.primary, self._x)
        left += through(model.secondary["control signal"], self._y[:, late:])

        def unexplained(paths: np.ndarray) -> np.ndarray:
            squares = self._known * (left + through(paths, self._v[:, late:])) ** 2
            return squares.reshape(len(left), -1, self._frame).sum(axis=2)

        in_use = unexplained(self._paths)
        for source in self._sources():
            for k, (one, other) in enumerate(zip(in_use, unexplained(model.secondary[source]), strict=True)):
                self._evidence[k, i, source].add(one, other)

    def _take_over(self, better: list[tuple[int, int, str]]) -> None:
        """Give models' paths to the controller: for each candidate (microphone, fit, source) those to its microphone."""
        new, old = self._paths.copy(), self._paths
        for k, i, source in better:
            new[k] = self._models[i].secondary[source][k]  # type: ignore[union-attr]  # a better candidate has a model
        self.controller.secondary_path = new if self.controller.multichannel else new[0, 0]
        for k, i, source in better:
            change = np.sum((new[k] - old[k]) ** 2) / max(np.sum(old[k] ** 2), np.finfo(float).tiny)
            gain = self._evidence[k, i, source].gain_db
            self.changes.append(
                PathChange(self._done / self.fs, float(10 * np.log10(change)), gain, self._memories[i], source, k)
            )
        self._know(new)
        self._guard.begin_anew(self._power_alone())
        shortest = min(i for _, i, _ in better)
        for fit in self._fits[shortest + 1 :]:  # the longer memories hold paths that no longer exist
            fit.take_from(self._fits[shortest])
        self._models = [fit.solve(new) for fit in self._fits]
        changed = {k for k, _, _ in better}
        for (k, i, _), evidence in self._evidence.items():
            if k in changed or i > shortest:
                evidence.forget()

    def _power_alone(self) -> float:
        """Return the power, in the last frame of a block, of the error if the controller played alone with a gain of 1.

        It is by the paths that have just been taken over, unlike what the guard has heard in that frame.
        """
        late = slice(-(self._frame + self._paths.shape[-1] - 1), None)
        errors = self._e[:, -self._frame :] + through(self._paths, (self._y + self._v - self._own)[:, late])
        known = self._known[-self._frame :]
        return float(np.sum(known * errors**2)) / max(int(np.count_nonzero(known)), 1)

    def listen(self, references: Any, errors: Any) -> None:
        """Let the controller and the fits follow the noise while the output is silent.

        `references` and `errors` are (n_samples,), with several channels (I, n_samples) and (K, n_samples).
        """
        self.controller.listen(references, errors)
        self._end_sample()
        for x, e in zip(np.atleast_2d(references).T, np.atleast_2d(errors).T, strict=True):
            at = self._past + self._n
            self._x[:, at], self._y[:, at], self._v[:, at], self._own[:, at] = x, 0.0, 0.0, 0.0
            self._guard.follow(self._without_probe(np.atleast_1d(e))[0], self._x[:, at])
            self._take(np.atleast_1d(e))

    def _rates(self) -> dict[str, float | None]:
        return {"path tracker": self.fs}
