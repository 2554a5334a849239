"""Control filters of least error for several loudspeakers, each within its own rated power.

Given estimated primary paths P, known secondary paths S and the correlation of the references, the control filters v
solve

    (R_x' + blkdiag(lambda_j R_x)) v = r,    lambda_j >= 0,    lambda_j (v_j' R_x v_j - rho_j) = 0,

where R_x' is the correlation of the filtered references, summed over the microphones, and r is their cross-correlation
with the disturbances. Both follow from the paths and R_x alone, as products of spectra. If the optimal control filters
w for unlimited power are known instead of the primary paths, r = R_x' w.
"""

from __future__ import annotations

import numpy as np
from scipy import fft

from ..kernels.block_toeplitz import (
    circulant_inverse,
    circulant_spectrum,
    conjugate_gradients,
    hermitian,
    nearest_circulant_spectrum,
    toeplitz_energy,
    toeplitz_product,
)
from ..kernels.compiling import compiled
from .spending import MOST, book, new_spending, power_to_spend

SWEEPS, STEPS = 3, 5  # sweeps of so many conjugate-gradient steps; the penalties are adjusted after each sweep
MOST_SWEEPS = 6  # as long as a power exceeds its target by more than
EXCESS = 1.1  # times; what is left after the last sweep is scaled down
RIDGE = 1e-6  # of the mean energy: limits the weights in directions without energy
LARGEST_CHANGE = 10.0  # largest ratio of power to rated power that counts in a sweep
SMALLEST_WEIGHT = 1e-6  # of the natural weight: a penalty that is not needed must be able to grow again


@compiled()
def spend_blocks(spending, level, spent, blocks):
    """Book the means over some blocks, each as one sample, and return the power to spend for each unit of level."""
    for _ in range(min(blocks, int(spending.numbers[0].full) * spending.counts.size)):
        book(spending, level, spent)
    per_level, _ = power_to_spend(spending, MOST, False)
    return per_level


class ChannelBudget:
    """Control filters of J loudspeakers for I references; each solution continues from the last one.

    Parameters
    ----------
    secondary : ndarray, shape (K, J, n_secondary)
        Secondary paths, the rows of each microphone times the square root of the weight of its squared error.
    n_taps, n_primary : int
        Taps of a control filter, and of an estimated primary path (0 if the control filters are estimated instead).
    n_references : int
        Number of references I.
    rated_power : ndarray, shape (J,)
        Rated power of each loudspeaker.
    averaging_blocks : float
        Time over which the mean powers are kept to the rated ones, in blocks, see `spend`.
    guard : ndarray, shape (n_guard,), optional
        Guard filter W against uncertain secondary paths; by default none.
    """

    def __init__(
        self,
        secondary: np.ndarray,
        n_taps: int,
        n_primary: int,
        n_references: int,
        rated_power: np.ndarray,
        averaging_blocks: float,
        guard: np.ndarray | None = None,
    ) -> None:
        self.n_taps, self.n_primary, self.n_references, self.rated_power = n_taps, n_primary, n_references, rated_power
        self._spending = [new_spending(averaging_blocks) for _ in rated_power]
        self._share = np.full(len(rated_power), np.inf)  # of the rated power to spend for each unit of level
        self._gain = np.zeros(len(rated_power))  # power of a control signal for each unit of level
        self.target_power = rated_power.copy()
        _, self.n_loudspeakers, n_secondary = secondary.shape
        self.n_guard = 1 if guard is None else guard.size
        self._inner = n_taps + n_secondary + self.n_guard - 1  # lags of R_x that the left side depends on
        self.n_lags = max(n_taps + n_secondary + n_primary, self._inner)  # and the right side
        self._size = fft.next_fast_len(self.n_lags + max(n_primary, self._inner), real=True)
        self._inner_size = fft.next_fast_len(2 * self._inner, real=True)
        self.use_paths(secondary, guard)
        self.weights = np.zeros((self.n_loudspeakers, n_references, n_taps))
        self.penalty: np.ndarray | None = None  # lambda, (J,)

    def use_paths(self, secondary: np.ndarray, guard: np.ndarray | None) -> None:
        """Solve for other secondary paths, (K, J, n_secondary), and another guard of `n_guard` taps, or none."""
        self._spectra = fft.rfft(secondary, self._size)
        inner = fft.rfft(secondary, self._inner_size)
        self._gram = np.einsum("kaf,kbf->fab", inner.conj(), inner)
        guard = np.zeros(1) if guard is None else guard
        self._guarded = 1.0 + np.abs(fft.rfft(guard, self._inner_size)[:, np.newaxis]) ** 2

    def spend(self, level: float, power: np.ndarray | None, blocks: int = 1) -> None:
        """Process the mean powers of the last blocks, which decide what the next solution spends (see `spending`).

        Parameters
        ----------
        level : float
            Sum of the references' powers.
        power : ndarray, shape (J,), or None
            Power of each control signal; None for a block without control. No power is saved in it, nor before the
            first solution.
        blocks : int, default 1
            Number of blocks since the last solution.
        """
        for j, spending in enumerate(self._spending):
            seen, spent = level, 1.0
            if power is not None and self._gain[j] > 0.0:
                # The level as the control filter sees it: the power that it spent, over what it spends at level 1.
                seen = power[j] / self._gain[j]
                spent = power[j] / self.rated_power[j]
            self._share[j] = spend_blocks(spending, seen, spent, blocks)

    def solve(self, correlation: np.ndarray, primary: np.ndarray) -> None:
        """Move `weights` and `penalty` towards the solution for given primary paths.

        Parameters
        ----------
        correlation : ndarray, shape (n_lags, I, I)
            Correlation of the references, E[x_i(n - m) x_k(n)] at [m, i, k].
        primary : ndarray, shape (K, I, n_primary)
            Primary paths.
        """
        self._move(correlation, self._right_side(correlation, primary))

    def solve_near(self, correlation: np.ndarray, free: np.ndarray) -> None:
        """Move `weights` and `penalty` towards the solution, given the optimal control filters for unlimited power.

        Parameters
        ----------
        correlation : ndarray, shape (n_lags, I, I)
            As for `solve`.
        free : ndarray, shape (J, I, n_taps)
            Control filters w, from which the right-hand side follows: r = R_x' w.
        """
        lags, w = self._lags_of(self._filtered_spectrum(correlation)), free.reshape(-1, self.n_taps)
        product = toeplitz_product(hermitian(circulant_spectrum(lags, self.n_taps), len(w)), self.n_taps)
        self._move(correlation, product(w))

    def _move(self, correlation: np.ndarray, r: np.ndarray) -> None:
        """Move `weights` and `penalty` towards the solution for the right-hand side r."""
        lags = self._lags_of(self._guarded * self._filtered_spectrum(correlation))
        J, n_references, n = self.n_loudspeakers, self.n_references, self.n_taps
        of_x = _two_sided(correlation[:n], 2 * n)
        blocks, level = J * n_references, np.trace(of_x[0])
        energy = lags[0, np.equal(*np.triu_indices(blocks))].sum()
        natural = energy / max(J * level, np.finfo(float).tiny)
        ridge = RIDGE * energy / blocks
        if not (natural > 0.0 and np.any(r)):
            return  # silence, or nothing known yet
        share = np.where(np.isfinite(self._share), self._share * level, 1.0)
        self.target_power = self.rated_power * share
        if self.penalty is None:
            self.penalty = np.full(J, 1e-3 * natural)
        whole = hermitian(circulant_spectrum(lags, n), blocks)
        nearest = hermitian(nearest_circulant_spectrum(lags, n), blocks)
        whole_x, nearest_x = circulant_spectrum(of_x, n), nearest_circulant_spectrum(of_x, n)
        inverse = circulant_inverse(_with_penalty(nearest, nearest_x, self.penalty, ridge), n)
        v = self.weights.reshape(blocks, n)
        for sweep in range(1, MOST_SWEEPS + 1):
            product = toeplitz_product(_with_penalty(whole, whole_x, self.penalty, ridge), n)
            v = conjugate_gradients(product, inverse, r, v, STEPS)
            filters = v.reshape(J, n_references, n)
            power = toeplitz_energy(whole_x, filters)
            self._adjust_penalty(power, natural)
            if sweep >= SWEEPS and np.all(power <= EXCESS * self.target_power):
                break
        excess = np.maximum(power / (EXCESS * self.target_power), 1.0)
        self.weights = filters / np.sqrt(excess)[:, np.newaxis, np.newaxis]
        self._gain = power / excess / level

    def _adjust_penalty(self, power: np.ndarray, natural: float) -> None:
        """Correct each penalty by the ratio of its loudspeaker's power to the rated power, raised to an exponent.

        The logarithm of the ratio is split into the mean over the loudspeakers, weighted by the penalties, and the
        deviation from it. For the mean, the exponent is the inverse of the slope on a flat path, where the power is
        proportional to ``(1 + penalty/natural)^-2``. For the deviations it is 1/2: of coupled loudspeakers, one takes
        over what another gives up, as the inverse square of their penalties, and without this damping they would
        oscillate.
        """
        assert self.penalty is not None
        ratio = np.log(np.clip(power / self.target_power, 1.0 / LARGEST_CHANGE, LARGEST_CHANGE))
        floor = SMALLEST_WEIGHT * natural  # at the floor, the rated power is not used up, and the ratio does not count
        common = np.average(ratio, weights=np.maximum(self.penalty - floor, np.finfo(float).tiny))
        exponent = min(0.5 + 0.5 * natural / self.penalty.mean(), 1.0)
        change = np.exp(exponent * common + 0.5 * (ratio - common))
        self.penalty = np.maximum(self.penalty * change, floor)

    def _right_side(self, correlation: np.ndarray, primary: np.ndarray) -> np.ndarray:
        """Return r, (J I, n_taps)."""
        of_x = fft.rfft(_two_sided(correlation, self._size), axis=0)
        disturbances = np.einsum("kpf,fip->kif", fft.rfft(primary, self._size), of_x)
        r = np.einsum("kjf,kif->jif", self._spectra.conj(), disturbances)
        return fft.irfft(r, self._size)[..., : self.n_taps].reshape(-1, self.n_taps)

    def _filtered_spectrum(self, correlation: np.ndarray) -> np.ndarray:
        """Return the spectrum of R_x', the correlation of the filtered references, summed over microphones, (f, pairs).

        The pairs are those of `np.triu_indices`; the others follow by symmetry, see `hermitian`.
        """
        of_x = fft.rfft(_two_sided(correlation[: self._inner], self._inner_size), axis=0)
        rows, columns = np.triu_indices(self.n_loudspeakers * self.n_references)
        (j, i), (other_j, other_i) = np.divmod(rows, self.n_references), np.divmod(columns, self.n_references)
        return self._gram[:, j, other_j] * of_x[:, i, other_i]

    def _lags_of(self, spectrum: np.ndarray) -> np.ndarray:
        """Return the lags of a spectrum, (lags, pairs)."""
        return fft.irfft(spectrum, self._inner_size, axis=0)


def _two_sided(correlation: np.ndarray, size: int) -> np.ndarray:
    """Return a correlation with its negative lags at the end of `size` samples: at -m, the transpose of that at m."""
    lags = len(correlation)
    both = np.zeros((size, *correlation.shape[1:]))
    both[:lags] = correlation
    both[size - lags + 1 :] += correlation[:0:-1].transpose(0, 2, 1)
    return both


def _with_penalty(filtered: np.ndarray, of_x: np.ndarray, penalty: np.ndarray, ridge: float) -> np.ndarray:
    """Return the spectrum of R_x' + blkdiag(penalty_j R_x) + ridge I, (f, J I, J I)."""
    J, n_references = penalty.size, of_x.shape[-1]
    spectrum = filtered.reshape(-1, J, n_references, J, n_references).copy()
    for j in range(J):
        spectrum[:, j, :, j, :] += penalty[j] * of_x + ridge * np.eye(n_references)
    return spectrum.reshape(filtered.shape)
