"""A secondary path that changes: it is identified while the control runs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.signal import oaconvolve
from scipy.special import stdtr

from .._validate import as_generator, as_number, as_positive, as_signal
from ..paths.least_squares import correlation_matrix, cross_correlation, cross_correlation_matrix
from ..power.constraint import DEFAULT_FS
from .base import FilteredReferenceController, WrappedController

FRAME_S = 0.02  # the error's power is measured over frames of this length, or of the secondary path's if that is longer
SHORT = 1 / 8  # of the memory: this is the memory of the fit that follows fast changes
FEWEST_FRAMES = 8  # with fewer, no better prediction is significant
RIDGE = 1e-9  # relative to the mean power of the regressors, so that a narrow-band reference has a solution


@dataclass(frozen=True)
class PathChange:
    """New estimate of the secondary path that a `PathTracker` took over.

    Attributes
    ----------
    time_s : float
        Time since the tracker was made, in s.
    change_db : float
        ``10 log10(sum (new - old)^2 / sum old^2)``: by how much the estimate changed.
    prediction_gain_db : float
        By how many dB less of the error the new estimate left unexplained, on samples that it had not been fitted to.
    memory_s : float
        Memory of the fit that it comes from.
    source : str
        "probe" or "control signal".
    """

    time_s: float
    change_db: float
    prediction_gain_db: float
    memory_s: float
    source: str


@dataclass(frozen=True)
class Model:
    """What a fit found: taps of the primary path, and of the secondary path by source."""

    primary: np.ndarray
    secondary: dict[str, np.ndarray]


class JointFit:
    """Least squares of the error ``e = p * x - s * (y + v)``, with the sums of the past forgotten exponentially.

    Parameters
    ----------
    n_primary, n_secondary : int
        Numbers of taps of p and s.
    keep : float
        Factor of the past sums at each addition.
    """

    def __init__(self, n_primary: int, n_secondary: int, keep: float) -> None:
        self.n_primary, self.n_secondary, self.keep = n_primary, n_secondary, keep
        size = n_primary + 2 * n_secondary
        self.matrix, self.right = np.zeros((size, size)), np.zeros(size)  # of the regressors x, -y, -v
        self.energy = self.count = self.noise = 0.0

    def take_from(self, other: JointFit) -> None:
        """Replace the sums by those of another fit."""
        self.matrix, self.right = other.matrix.copy(), other.right.copy()
        self.energy, self.count, self.noise = other.energy, other.count, other.noise

    def add(self, sums: tuple[np.ndarray, np.ndarray, float, int]) -> None:
        """Add the sums of a block, see `block_sums`."""
        matrix, right, energy, count = sums
        self.matrix = self.keep * self.matrix + matrix
        self.right = self.keep * self.right + right
        self.energy, self.count = self.keep * self.energy + energy, self.keep * self.count + count

    def solve(self, known: np.ndarray) -> Model | None:
        r"""Return p and the estimates of s by source; None without a signal.

        "control signal": p and s are fitted together, with the samples of y and v alike. "probe": s is fitted to v alone,
        after subtracting what p * x and s * y explain. Both are drawn towards the `known` path. The weight is right for
        a path that may change by all of its energy: :math:`\sigma_e^2 / (|s|^2 / n)`, with the noise that the last fit
        left.
        """
        P, S = self.n_primary, self.n_secondary
        floor = RIDGE * np.trace(self.matrix) / len(self.matrix)
        if not floor > 0.0:
            return None
        noise = self.noise or self.energy / self.count
        ridge = max(noise * S / max(known @ known, np.finfo(float).tiny), floor)
        # y and v have the path in common: their rows and columns are added.
        xy, v = slice(P + S), slice(P + S, None)
        matrix, right = self.matrix[xy, xy].copy(), self.right[xy].copy()
        matrix[:, P:] += self.matrix[xy, v]
        matrix[P:] += np.hstack((self.matrix[v, :P], self.matrix[v, P : P + S] + self.matrix[v, v]))
        right[P:] += self.right[v]
        ridges = np.repeat([floor, ridge], [P, S])
        drawn = right + ridges * np.concatenate((np.zeros(P), known))
        try:
            theta = cho_solve(cho_factor(matrix + np.diag(ridges)), drawn)
            left = self.right[v] - self.matrix[v, xy] @ theta
            probed = cho_solve(cho_factor(self.matrix[v, v] + ridge * np.eye(S)), left + ridge * known)
        except LinAlgError:
            return None
        unexplained = self.energy - 2.0 * theta @ right + theta @ (drawn - ridges * theta)
        self.noise = max(unexplained, 1e-12 * self.energy) / self.count
        return Model(theta[:P], {"probe": probed, "control signal": theta[P:]})


def block_sums(
    x: np.ndarray, y: np.ndarray, v: np.ndarray, error: np.ndarray, n_primary: int, n_secondary: int
) -> tuple[np.ndarray, np.ndarray, float, int]:
    """Return the sums of products for `JointFit.add`: matrix, right side, energy of the error, number of samples.

    `error` is (n,). The other signals begin ``n_primary - 1`` samples earlier.
    """
    P, S, n, start = n_primary, n_secondary, error.size, n_primary - 1
    matrix, right = np.empty((P + 2 * S, P + 2 * S)), np.empty(P + 2 * S)
    parts = ((x, P, slice(P)), (-y, S, slice(P, P + S)), (-v, S, slice(P + S, P + 2 * S)))
    for i, (first, taps, rows) in enumerate(parts):
        right[rows] = cross_correlation(error, first[start - taps + 1 :])
        matrix[rows, rows] = correlation_matrix(first, taps, start)
        for second, others, columns in parts[i + 1 :]:
            matrix[rows, columns] = cross_correlation_matrix(first, second, taps, start, others)
            matrix[columns, rows] = matrix[rows, columns].T
    return n * matrix, n * right, float(error @ error), n


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

    White noise v(n), the probe, is added to the control signal, far below the residual noise. Two least-squares fits, one
    of which remembers the last `memory_s` and the other an eighth of it, describe the error by

    .. math:: e = p * x - s * (y + v)

    Each fit offers two estimates of s. "control signal" is the s of the fit itself, in which the samples of the control
    signal y count like those of the probe. It is exact if only the secondary path changes. If the primary path changes
    and the controller follows it, y and the change of p cannot be told apart, and this estimate is wrong. "probe" is a
    fit of s to v alone, after subtracting :math:`p * x - s * y` from the error. The probe is independent of everything
    else, so this estimate holds in any case, but it takes longer.

    A new estimate is taken over only if a test says that it is better. The test uses samples that no fit has seen yet,
    and only the probe. Over the frames of 20 ms since the new estimate began to lead, it must leave less of the error
    unexplained than the one in use, and the probability of such a difference by chance must be below `p_value`. Then
    the controller's `secondary_path` is set. Its weights stay, so the control signal does not jump.

    The controller does not hear the probe: what the probe contributes to the error, according to the estimate in use,
    is subtracted.

    Between a jump of the path and its discovery, the controller may diverge. So if the error becomes more than
    `hold_db` louder than expected without control, the controller's updates are skipped until the error is 3 dB below
    that threshold or another path is taken over.

    Parameters
    ----------
    controller : FilteredReferenceController
        Any built-in controller of one channel.
    rng : int or numpy.random.Generator
        Seed of the probe.
    fs : float, default 16000
        Sample rate in Hz.
    probe_db : float, default -20
        Power of the probe at the error microphone, in dB of that of the residual noise. At -20 dB it raises the
        residual by 0.04 dB, at -25 dB by 0.014 dB, but a change of the path is then found later.
    probe_filter : array_like, shape (n,), optional
        Impulse response that colours the probe, for example to make it inaudible; only its shape counts. By default the
        probe is white. Where it has no power, the estimate stays as it is.
    memory_s : float, default 8
        Memory of the longer fit in s. A longer one is more accurate on a path that does not change.
    check_s : float, default 0.25
        Time between two tests in s, rounded to whole frames.
    p_value : float, default 1e-6
        Largest probability of a difference by chance with which an estimate is taken over.
    use_control_signal : bool, default True
        Whether the estimates "control signal" take part.
    hold_db : float, default 6
        See above; with a large number, no update is skipped.
    amplifier : callable, optional
        Known amplifier, a function of a sample, as for the controller. An unknown one that clips distorts the fits.

    Attributes
    ----------
    changes : list of PathChange
        The estimates that were taken over.

    Raises
    ------
    TypeError
        A controller that is not built in or has several channels; an amplifier that is not a function.
    ValueError
        A setting that is out of range, `memory_s` below eight times `check_s`, or a probe filter that is all zeros.

    Notes
    -----
    The estimate has as many taps as the controller's. So make the controller with an estimate that is padded with zeros
    to the length of the longest path that may occur. The probe is added after the controller's limiter.

    `simulate` calls it from Python sample by sample. For L taps of the control filter and n of the path, a test takes
    about :math:`(L + 2n)^3 / 3` multiplications for each fit.

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
        amplifier: Callable[[float], float] | None = None,
    ) -> None:
        super().__init__(controller)
        if not isinstance(controller, FilteredReferenceController) or controller.multichannel:
            raise TypeError(f"controller must be a built-in controller of one channel, got {controller!r}")
        if amplifier is not None and not callable(amplifier):
            raise TypeError(f"amplifier must be a function of a sample, or None, got {amplifier!r}")
        self.fs = as_positive(fs, "fs", unit="Hz")
        self.memory_s = as_positive(memory_s, "memory_s", unit="s")
        self.p_value = as_positive(p_value, "p_value")
        self.use_control_signal = bool(use_control_signal)
        self._probe_share = 10 ** (as_number(probe_db, "probe_db", unit="dB") / 10)
        self._hold_share = 10 ** (as_number(hold_db, "hold_db", unit="dB") / 10)
        shape = as_signal(probe_filter, "probe_filter")
        if not shape.any():
            raise ValueError("probe_filter must not be all zeros: the probe would be silent")
        self._shape = shape / np.sqrt(shape @ shape)
        self._rng = as_generator(rng)
        self._amplifier = amplifier
        self.changes: list[PathChange] = []
        self.name = f"{controller.name} with path tracking"
        self._allocate(as_positive(check_s, "check_s", unit="s"))
        self._know(controller.secondary_path)

    def _allocate(self, check_s: float) -> None:
        """Set the lengths, and make the fits and the room for a block of signals."""
        S = self.controller.secondary_path.size
        P = self.controller.n_taps + S - 1  # length of control filter and path in series: s * y has no older x in it
        self._frame = max(round(FRAME_S * self.fs), S)
        self._block = self._frame * max(round(check_s * self.fs / self._frame), 1)
        if self.memory_s * SHORT * self.fs < self._block:
            raise ValueError(
                f"memory_s must be at least {1 / SHORT:g} times check_s, {self._block / self.fs / SHORT:g} s, "
                f"got {self.memory_s:g} s"
            )
        self._memories = (self.memory_s * SHORT, self.memory_s)
        self._fits = [JointFit(P, S, np.exp(-self._block / (memory * self.fs))) for memory in self._memories]
        self._models: list[Model | None] = [None] * len(self._fits)
        self._evidence = {(i, source): Evidence() for i in range(len(self._fits)) for source in self._sources()}
        self._past = P - 1
        self._x, self._y, self._v = np.zeros((3, self._past + self._block))
        self._e = np.zeros(self._block)
        self._n = self._done = 0  # samples of this block, and of all
        self._residual_power = 0.0
        self._level, self._held = 0.0, False
        self._powers, self._frames = np.zeros(2), 0  # of the disturbance estimate and of the reference, over the memory
        self._recovering_from = 0.0  # power of the error when the last path was taken over, until it has fallen
        self._white = self._rng.standard_normal(self._shape.size - 1)
        self._probe = self._next_probe()

    def __repr__(self) -> str:
        return f"<{self.name}: {len(self.changes)} change(s), {self.controller!r}>"

    def _sources(self) -> tuple[str, ...]:
        return ("probe", "control signal") if self.use_control_signal else ("probe",)

    def _next_probe(self) -> np.ndarray:
        """Return the probe of unit power for a frame."""
        white = np.concatenate((self._white, self._rng.standard_normal(self._frame)))
        self._white = white[self._frame :]
        return np.convolve(white, self._shape, mode="valid")

    def _know(self, path: np.ndarray) -> None:
        """Set the path in use."""
        self._path = path
        self._reversed = path[::-1].copy()

    def _take_path(self, path: Any) -> None:
        super()._take_path(path)
        self._know(self.controller.secondary_path)

    def control_signal(self, reference: float) -> float:
        """Return the control signal with the probe, y(n) + v(n), for the newest reference sample x(n)."""
        y = self.controller.control_signal(reference)
        emitted = y + self._level * self._probe[self._n % self._frame]
        if not np.isfinite(emitted):
            return emitted  # a divergence: return it, so that the loop detects it
        at = self._past + self._n
        played, alone = (emitted, y) if self._amplifier is None else (self._amplifier(emitted), self._amplifier(y))
        self._x[at], self._y[at], self._v[at] = reference, alone, played - alone
        return emitted

    def update(self, error: float) -> None:
        """Let the controller adapt to the error e(n), less what the probe is known to contribute."""
        error = as_number(error, "error")
        if not self._held:
            end = self._past + self._n + 1
            self.controller.update(error + self._reversed @ self._v[end - self._reversed.size : end])
        self._take(error)

    def _take(self, error: float) -> None:
        self._e[self._n] = error
        self._n += 1
        if self._n % self._frame == 0:
            self._end_frame()
            if self._n == self._block:
                self._end_block()

    def _end_frame(self) -> None:
        """Set the level of the probe, and whether the adaptation is held, for the next frame."""
        begin, end = self._n - self._frame, self._n
        power = float(np.mean(self._e[begin:end] ** 2))
        rate = self._frame / self._block if self._residual_power > 0.0 else 1.0
        self._residual_power += rate * (power - self._residual_power)
        gain = float(self._path @ self._path)
        self._level = np.sqrt(self._probe_share * self._residual_power / gain) if gain > 0.0 else 0.0
        self._probe = self._next_probe()
        bound = self._hold_share * self._power_without_control(begin)
        if power <= bound:
            self._recovering_from = 0.0
        bound *= 0.5 if self._held else 1.0  # once held, the error must become 3 dB softer than the bound
        self._held = power > max(bound, 2.0 * self._recovering_from)

    def _power_without_control(self, begin: int) -> float:
        """Return the power that the error would have without control, in the frame that starts at sample `begin`.

        It is the mean power of the disturbance estimate over the memory, times the ratio of the reference's power to its
        own mean if that is above 1. The estimate grows if the path is wrong, so a frame counts as `hold_db` above what
        was expected of it at most.
        """
        samples = slice(self._past + begin, self._past + begin + self._frame)
        played = (self._y + self._v)[samples.start - self._path.size + 1 : samples.stop]
        disturbance = self._e[begin : begin + self._frame] + np.convolve(played, self._path, mode="valid")
        power, reference_power = np.mean(disturbance**2), np.mean(self._x[samples] ** 2)
        mean, reference_mean = self._powers
        expected = mean * max(reference_power / reference_mean, 1.0) if reference_mean > 0.0 else np.inf
        self._frames += 1
        rate = max(self._frame / (self.memory_s * self.fs), 1.0 / self._frames)
        self._powers += rate * (np.array([min(power, self._hold_share * expected), reference_power]) - self._powers)
        return expected

    def _end_block(self) -> None:
        """Test the models on this block, take over a better path, then fit the models to this block too."""
        self._done += self._block
        for i, model in enumerate(self._models):
            if model is not None:
                self._judge(i, model)
        sums = block_sums(self._x, self._y, self._v, self._e, self._past + 1, self._path.size)
        for fit in self._fits:
            fit.add(sums)
        self._models = [fit.solve(self._path) for fit in self._fits]
        best = max(self._evidence, key=lambda one: self._evidence[one].mean * self._is_significant(one))
        if self._is_significant(best):
            self._take_over(*best)
        for line in (self._x, self._y, self._v):
            line[: self._past] = line[self._block :].copy()
        self._n = 0

    def _is_significant(self, candidate: tuple[int, str]) -> bool:
        i, _ = candidate
        return self._models[i] is not None and self._evidence[candidate].p_value < self.p_value

    def _judge(self, i: int, model: Model) -> None:
        """Compare how well the path in use and those of a model predict what the probe does, on fresh samples.

        Only the probe counts: it is independent of all else, so that no change of the primary path, and no adaptation
        of the control filter, can make a wrong path look better.
        """
        late = self._past + 1 - self._path.size
        left = self._e - oaconvolve(self._x, model.primary, mode="valid")
        left += oaconvolve(self._y[late:], model.secondary["control signal"], mode="valid")

        def unexplained(path: np.ndarray) -> np.ndarray:
            squares = (left + oaconvolve(self._v[late:], path, mode="valid")) ** 2
            return squares.reshape(-1, self._frame).mean(axis=1)

        in_use = unexplained(self._path)
        for source in self._sources():
            self._evidence[i, source].add(in_use, unexplained(model.secondary[source]))

    def _take_over(self, i: int, source: str) -> None:
        """Give a model's path to the controller."""
        model = self._models[i]
        assert model is not None
        new, old = model.secondary[source], self._path
        self.controller.secondary_path = new
        change = np.sum((new - old) ** 2) / max(old @ old, np.finfo(float).tiny)
        gain = self._evidence[i, source].gain_db
        self.changes.append(
            PathChange(self._done / self.fs, float(10 * np.log10(change)), gain, self._memories[i], source)
        )
        self._know(new)
        self._held, self._recovering_from = False, float(np.mean(self._e[-self._frame :] ** 2))
        for fit in self._fits[i + 1 :]:  # the longer memories hold a path that no longer exists
            fit.take_from(self._fits[i])
        self._models = [fit.solve(new) for fit in self._fits]
        for evidence in self._evidence.values():
            evidence.forget()

    def listen(self, references: Any, errors: Any) -> None:
        """Let the controller and the fits follow `references` and `errors`, (n_samples,), while the output is silent."""
        self.controller.listen(references, errors)
        for x, e in zip(references, errors, strict=True):
            at = self._past + self._n
            self._x[at], self._y[at], self._v[at] = x, 0.0, 0.0
            self._take(float(e))

    def _rates(self) -> dict[str, float | None]:
        return {"path tracker": self.fs}
