"""KF-PB: a posterior of the plant, the control filters of least expected error, and a price of power for each loudspeaker.

    y = v * x            asked of the loudspeakers
    e = p * x - s * y    heard by the microphones, and noise

After every block of B samples: the posterior of p and s takes the block (`Plant`), and the filters of all loudspeakers
become those of least expected error at the prices of their power (`PowerBudget`). K microphones, J loudspeakers, I
references, L taps of a control filter, M of a secondary path, N = L + M - 1 of a primary path: all that control can
reach. Equations are written out as matrices; taps of several signals stand side by side.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from oracles.signals import Controller

from kfopc_filterpy.controllers.kf_pb import (
    BLOCK_S,
    DEFAULT_AVERAGING_S,
    DEFAULT_UNCERTAINTY,
    MEMORY_S,
    WINDOW_S,
    WINDOWS,
)
from kfopc_filterpy.core.building import FOLDER


def constants():
    """Return the numbers that the core's sources name; of both builds, those of the one with doubles."""
    named = r"\b([A-Z][A-Z_]*) = (?:\(real\))?([0-9.]+(?:e-?[0-9]+)?)f?\b"
    text = "".join((FOLDER / name).read_text() for name in ("posterior.h", "posterior.c", "budget.c"))
    return {name: int(value) if value.isdigit() else float(value) for name, value in re.findall(named, text)}


core = SimpleNamespace(**constants())


def regressors(z, n):
    """Return the rows [z_c(t), ..., z_c(t - n + 1)] of all signals, (rows, C n); z (C, n - 1 + rows)."""
    return np.concatenate([sliding_window_view(signal, n)[:, ::-1] for signal in z], axis=1)


def lags(z, n):
    """Return sum_t z_a(t) z_c(t - l), l < n, (C, C, n); the first n - 1 samples are only the past."""
    Z = regressors(z, n)
    return (Z[:, ::n].T @ Z).reshape(len(z), len(z), n)


def two_sided(R):
    """Return lags of both signs, (C, C, F), of E x_a(t - l) x_c(t), -l at the end; F is the core's power of two."""
    C, _, n = R.shape
    F = 1 << (2 * n - 1).bit_length()
    return np.concatenate([R.swapaxes(0, 1), np.zeros((C, C, F - 2 * n + 1)), R[..., :0:-1]], axis=2)


def toeplitz(R, n):
    """Return the matrix of the lags i - l, i, l < n, for each pair of signals, (A n, C n)."""
    A, C, _ = R.shape
    return R[:, :, np.subtract.outer(range(n), range(n))].swapaxes(1, 2).reshape(A * n, C * n)


def spectra(R, n=math.inf):
    """Return the spectra of lags of both signs at odd frequencies, under a triangle that ends at n: those of a circulant."""
    F, order = R.shape[2], np.arange(R.shape[2])
    lag = np.where(order < F / 2, order, order - F)
    turn = np.exp(-1j * np.pi * lag / F)  # to the odd frequencies
    return np.fft.fft(R * np.maximum(1 - abs(lag) / n, 0) * turn), turn


def preconditioner(R, turn, n):
    """Return the inverse of a skew-circulant, cut to n taps, from its spectra."""
    return toeplitz((np.fft.ifft(np.linalg.inv(R.T).T) / turn).real, n)


def conjugate_gradients(A, W, b, v, steps):
    """Return the rows v after steps towards v A = b with the preconditioner W."""
    r = b - v @ A
    p = r @ W
    rz = np.sum(r * p, axis=-1, keepdims=True)
    for _ in range(steps):
        goes_on, nothing = rz > 0, np.zeros_like(rz)
        Ap = p @ A
        bend = np.sum(p * Ap, axis=-1, keepdims=True)
        a = np.divide(rz, bend, where=goes_on & (bend > 0), out=nothing.copy())
        v, r = v + a * p, r - a * Ap
        z, before = r @ W, rz
        rz = np.sum(r * z, axis=-1, keepdims=True)
        p = z + np.divide(rz, before, where=goes_on, out=nothing) * p
    return v


class Plant:
    """The Gaussian posterior of theta = [p, s], for all microphones: they hear the same regressors of z = [x, -y].

    Rows of theta are the microphones' means, then draws over sqrt(q): they change little while q is learned.
    """

    def __init__(self, s_hat, references, taps, block, spread, forget):
        self.s_hat, self.N, self.B, self.spread, self.forget = s_hat, taps, block, spread, forget
        self.K, J, self.M = s_hat.shape
        self.C, self.split, self.exact = references + J, references * taps, spread == 0  # split: taps of p
        self.g = forget ** (1 / block)
        self.mean, self.mask = np.zeros((self.K, self.C, taps)), np.ones((self.C, taps))
        self.mean[:, references:, : self.M] = s_hat
        self.mask[references:, 0 if self.exact else self.M :] = 0.0
        self.mean, self.mask = self.mean.reshape(self.K, -1), self.mask.ravel()
        self.n, self.random = np.sum(self.mask), 1
        self.unit = self.signs(core.DRAWS, self.mask.size) * self.mask
        self.theta = np.concatenate([self.mean, 0 * self.unit])
        self.q, self.significant, self.precision = np.zeros(self.K), 1.0, np.zeros(self.mask.size)
        # waiting: no fit of a whole block since a surprise; on_trial: s is held, and not confirmed yet
        self.begun = self.waiting = self.silent = self.on_trial = False
        self.fits = self.surprises = self.turn = 0
        self.missed = self.expected = 0.0

    def signs(self, rows, n):
        """Return random signs."""
        signs = np.empty((rows, n))
        for i in range(signs.size):
            self.random = (self.random * 1664525 + 1013904223) % 2**32
            signs.flat[i] = 1.0 if self.random >> 31 else -1.0
        return signs

    @property
    def T(self):
        """Return the sums of lags of faded signals, z(t) g^(age/2), (C, C, N): all since the begin, and before it."""
        taper = self.g ** (np.arange(self.N) / 2)
        return self.G[:: self.N].reshape(self.C, self.C, self.N) * taper + self.before

    def energy_of(self, signals):
        """Return the energy of some of the signals in the data."""
        return np.sum(np.diagonal((self.T - self.before)[..., 0])[signals])

    def begin(self, z, newest):
        """Begin the data with the `newest` samples; z (C, N - 1 + B) ends with the block."""
        N = self.N
        before = z[:, : z.shape[1] - newest][:, 1 - N :] * self.g ** (np.arange(N - 2, -1, -1) / 2)
        self.before = lags(np.pad(before, [(0, 0), (N - 1, 0)]), N)
        self.G, self.r, self.ee = np.zeros((self.C * N, self.C * N)), np.zeros_like(self.theta), np.zeros(self.K)
        self.count = self.explained = 0.0
        self.begun = self.fresh = True

    def learn(self, x, y, e, new):
        """Take the `new` last samples of the errors e (K, B) of a block, with which x and y end; 0: they are not known."""
        K, N, I, known = self.K, self.N, len(x), self.fits and not self.waiting  # noqa: E741
        z, w = np.concatenate([x, -y]), self.g ** (np.arange(self.B - 1, -1, -1) / 2)
        heard = np.mean(e**2)
        if self.exact:  # s^ is right: what it plays is no news
            e = e - self.mean @ regressors(z, N).T
            z[I:] = 0.0
        if not self.begun or not (new or known):
            self.begin(z, new)
        if not (new or known):
            return
        Z, e = regressors(z, N) * w[:, None], e * w
        d = self.significant * self.theta[:K, : self.split] @ Z[:, : self.split].T
        noise_gone = False
        if new and known:
            missed = np.mean((e - d - self.theta[:K, self.split :] @ Z[:, self.split :].T) ** 2, axis=0)
            new = new if self.believes(missed, np.sum(d**2) / (K * np.sum(w**2)), heard, z, Z, w) else 0
            quiet = core.LOUDER**2 * np.sum(missed) < np.mean(self.q) * np.sum(w**2)
            noise_gone = self.significant < 0.5 and quiet and heard > 0 and np.any(Z[:, : self.split])
        x2, y2 = (np.sum((z[part, -self.B :] * w) ** 2) for part in (slice(I), slice(I, None)))
        x2_of_data, y2_of_data = self.energy_of(slice(I)), self.energy_of(slice(I, None))
        if new:
            if noise_gone:
                self.q = np.zeros(K)
            if noise_gone or x2 > core.LOUDER * x2_of_data:
                self.begin(z, new)  # what the data told is little
            self.add(Z, d, e, new)
        elif not self.waiting and (self.count == 0 or x2 >= x2_of_data or y2 > y2_of_data):
            self.begin(z, 0)  # the block would stand for more than is known
        elif not self.waiting:
            self.add(Z, d, e, new)
        if new and self.fit() and new == self.B:
            self.waiting = self.silent = False

    def believes(self, missed, d2, heard, z, Z, w):
        """Return whether a block is to be believed; forget all if it tells of another plant."""
        noise = np.mean(self.q)
        if not self.on_trial:  # it grows with the disturbance; on trial, what was missed holds the surprise
            noise = max(noise, self.missed / max(self.expected, 1e-300) * d2)
        if self.exact:
            count = max(self.count, 1.0)
            doubt = np.mean(self.q) * self.n / count + max(1.0 - count / self.n, 0.0) * d2
        else:
            doubt = np.mean(self.q) * np.sum((self.theta[self.K :] @ Z.T) ** 2) / (np.sum(w**2) * core.DRAWS)
        if self.on_trial:
            doubt = min(doubt, d2 / core.SURPRISE**2)
        limit = core.SURPRISE * (noise + doubt)
        last = self.B * (core.PARTS_OF_BLOCK - 1) // core.PARTS_OF_BLOCK
        at_last, missed = (np.sum(missed[i:]) / np.sum(w[i:] ** 2) for i in (last, 0))
        surprised = missed > limit
        if surprised and at_last <= limit:
            return False  # over already
        self.on_trial = False
        if self.count > self.n:  # with fewer samples, what is missed is not learned yet
            self.missed = self.forget * self.missed + min(missed, d2)
            self.expected = self.forget * self.expected + d2
        if surprised:
            self.waiting, self.surprises = True, self.surprises + 1
            self.silent = core.PLAYS_ON * heard >= d2  # listen to p alone
            s = self.paths()[1][self.K :]
            doubt = math.sqrt(np.sum(s**2) / np.sum(self.s_hat**2))
            learned = not self.exact and 2 * doubt < self.spread
            if learned:
                self.mean[:, self.split :] = self.theta[: self.K, self.split :]
            if heard >= d2 or self.spread <= core.HELD:
                self.spread = core.REDRAWN
            elif learned:
                self.spread, self.on_trial = core.HELD, True  # s is as it was
            self.begin(z, 0)
        return not surprised

    def add(self, Z, d, e, new):
        """Add the block, or its newest samples; if there are none, what the posterior expects: nothing changes then."""
        rows = new or self.B
        f, samples, Z = self.g**rows, np.sum(self.g ** np.arange(rows)), Z[-rows:]
        told, noise = self.theta @ Z.T, self.q * samples
        if new:
            told, noise = np.concatenate([e[:, -rows:], self.signs(core.DRAWS, rows)[:, ::-1]]), 0.0
        energy = np.sum(told[: self.K] ** 2, axis=1) + noise
        fade = np.repeat([f, math.sqrt(f)], [self.K, core.DRAWS])[:, None]  # unit noise is drawn for faded samples
        self.before, self.G, self.r = f * self.before, f * self.G + Z.T @ Z, fade * self.r + told @ Z
        self.ee, self.count = f * self.ee + energy, f * self.count + samples
        self.explained = f * self.explained + np.sum(d**2)

    def fit(self):
        """Take some steps towards (G + q P) theta = r + q P mean, and estimate q; return False if nothing can be told."""
        K, N, split, I, T = self.K, self.N, self.split, self.split // self.N, self.T  # noqa: E741
        x2 = self.energy_of(slice(I)) / I
        if not (x2 > 0 and np.sum(self.ee) > 0):
            return False
        if not np.any(self.q):
            self.q = 1e-3 * self.ee / self.count
        # |p|^2 is expected to be E[d^2 + e^2] / E[x^2] of the data of now.
        self.precision[:split] = split * x2 * K / (np.sum(self.ee) + self.explained)
        self.precision[split:] = self.M / ((self.spread or 1.0) ** 2 * np.mean(np.sum(self.s_hat**2, axis=2)))
        q = np.mean(self.q)
        ridge = q * self.precision
        pull = np.concatenate([ridge * self.mean, np.sqrt(ridge) * self.unit])
        if self.fresh:  # from the prior on
            self.theta = pull / ridge
        R = two_sided(T)
        R[range(self.C), range(self.C), 0] += ridge[::N]
        weight = self.mask * np.tile(self.g ** (np.arange(N) / 2), self.C)
        W = preconditioner(*spectra(R, N), N) * np.outer(weight, weight)
        A = self.G + np.diag(ridge)
        due = core.DRAWS if self.fresh else min(math.ceil(core.DRAWS * self.B / self.count), core.DRAWS)
        turns = (self.turn + np.arange(due)) % core.DRAWS
        solved = np.concatenate([np.arange(K), K + turns])  # not all draws: they change little
        pull, theta = (self.r + pull)[solved], self.theta[solved]
        self.theta[solved] = conjugate_gradients(A, W, pull, theta, core.PLANT_STEPS)
        self.turn = (self.turn + due) % core.DRAWS
        theta = self.theta[:K]
        residual = np.maximum(self.ee + np.sum(theta * (theta @ self.G - 2 * self.r[:K]), axis=1), 0.0)
        # The noise, with the earlier estimate counting as n samples: a short record leaves little noise by chance.
        counted = max(self.count - split / 2, 0.0) + self.n
        self.q = np.maximum((residual + self.n * self.q) / counted, 1e-6 * self.ee / self.count)
        self.theta[K:] *= min(math.sqrt(q / np.mean(self.q)), 1.0)  # if q rises, draws keep their size
        # By chance alone, n taps explain n q. James and Stein: what is not significant is not played.
        explained = np.sum(theta[:, :split] @ self.G[:split, :split] * theta[:, :split])
        self.significant = max(0.0, 1.0 - 2 * split * np.sum(self.q) / max(explained, 1e-300))
        self.explained = self.significant**2 * explained
        self.fits, self.fresh = self.fits + 1, False
        return True

    def paths(self):
        """Return primary paths (rows, I, N) and secondary ones (rows, J, M): those of the microphones, then draws.

        The posterior's expectations are sums over the rows. Of p is taken what is significant.
        """
        draws = math.sqrt(self.K / core.DRAWS * np.mean(self.q)) * self.theta[self.K :]  # of the mean noise
        rows = np.concatenate([self.theta[: self.K], draws])
        p, s = (part.reshape(len(rows), -1, self.N) for part in np.split(rows, [self.split], axis=1))
        return self.significant * p, s[..., : self.M]


class Level:
    """The mean square of the references in a window of blocks."""

    def __init__(self, fade):
        self.fade, self.sum, self.weight = fade, 0.0, 0.0

    def is_above(self, times, block):
        """Return whether it is more than so many times the mean square of a block."""
        return self.sum > times * block * self.weight

    def take(self, block, *, anew=False):
        """Take the mean square of a block; a soft past counts no more."""
        if anew or block * self.weight > core.LOUDER * self.sum:
            self.sum, self.weight = block, 1.0
        self.sum, self.weight = self.fade * self.sum + block, self.fade * self.weight + 1

    def over(self, other):
        """Return it over another one, 1 in silence."""
        return self.sum / self.weight / (other.sum / other.weight) if other.sum > 0 else 1.0


@dataclass(kw_only=True)
class PowerBudget(Controller):
    """KF-PB; `w` is the control filter."""

    rated_power: np.ndarray  # (J,)
    fs: float = 16000.0
    averaging_s: float = DEFAULT_AVERAGING_S
    spread: float = DEFAULT_UNCERTAINTY  # of the secondary paths at the start; 0: they are exact

    def __post_init__(self):
        super().__post_init__()
        (_, J, M), (_, I, L) = self.s_hat.shape, self.w.shape  # noqa: E741
        self.N, self.B = L + M - 1, max(round(BLOCK_S * self.fs), 1)
        self.g = math.exp(-1 / (min(self.averaging_s / WINDOWS, WINDOW_S) * self.fs))  # of the window of x, a sample
        self.plant = Plant(self.s_hat, I, self.N, self.B, self.spread, math.exp(-self.B / (MEMORY_S * self.fs)))
        self.R_sums = np.zeros((I, I, self.N))  # lags of x in an exponential window
        self.x_past, self.y_past = np.zeros((I, self.N - 1 + self.B)), np.zeros((J, self.N - 1 + self.B))
        self.new, self.asked = [], []  # samples of this block: x, y, e; the squares asked for
        self.peak, self.e_peak = np.zeros(I), np.zeros(len(self.s_hat))  # of |x| and |e| of late
        self.heard = 0  # samples that the delay lines hold, as they were
        self.blocks = max(round(self.averaging_s * self.fs / self.B), core.BLOCK_LASTS)  # T, of the averaging time
        self.current, self.usual = Level(self.g ** (core.SHORTER * self.B)), Level(self.g**self.B)
        self.recent, self.late = Level(self.g**self.B), Level(1 - 1 / self.blocks)  # without pauses
        self.pause = 0  # blocks so far
        self.book = np.ones((self.blocks, J))  # power of each block over the rating, newest first: all is spent
        self.set_room()
        self.price, self.now = np.zeros(J), np.zeros((J, I * L))  # filters at these prices

    def hear(self, x):
        """Take the newest references, without clicks."""
        cut, self.peak = self.without_clicks(x, self.peak)
        if np.any(cut != x):  # nothing is learned until the delay lines hold no more of it
            self.heard = -1 - len(self.new)
        super().hear(cut)

    def without_clicks(self, signal, peak):
        """Return samples without clicks, and the peaks of late."""
        most = np.where(peak > 0, core.GROWTH * peak, np.inf)
        cut = np.clip(signal, -most, most)
        return cut, np.maximum(np.abs(cut), self.g * peak)

    def output(self):
        """Return y_j = sum_i v_ji * x_i, cut to what the account has left, and note what is asked."""
        y = super().output()
        most = np.sqrt(np.maximum(self.room - sum(self.asked), 0.0))
        y = np.clip(y, -most, most)
        self.asked.append(y**2)
        return y

    def adapt(self, e):
        """Note the sample; e is nan if it was not heard."""
        if np.all(np.isfinite(e)):
            cut, self.e_peak = self.without_clicks(e, self.e_peak)
            if self.plant.fits:
                e = np.where(cut == e, e, np.nan)  # nothing is learned from a block with a click
        self.new.append((self.x[:, 0].copy(), self.output_line[:, 0].copy(), e))
        if len(self.new) == self.B:
            self.end_block(*(np.transpose(signals) for signals in zip(*self.new, strict=True)))

    def follow(self):
        """Note a sample before the control is on."""
        self.adapt(self.d)

    def end_block(self, x, y, e):
        """Learn from a block: x (I, B), played y (J, B), e (K, B)."""
        self.x_past = np.concatenate([self.x_past, x], axis=1)[:, self.B :]
        self.y_past = np.concatenate([self.y_past, y], axis=1)[:, self.B :]
        self.take_references()
        if self.asked:
            spent = sum(self.asked) / (self.B * self.rated_power)
            self.book = np.concatenate([[spent], self.book[:-1]])
        self.new, self.asked = [], []
        self.set_room()
        self.heard += self.B
        loud, soft = (np.mean(np.sum(part**2, axis=0)) for part in (x, self.x_past[:, : -self.B]))
        if self.plant.begun and loud > core.LOUDER**2 * soft:  # after a fault, the delay lines are not known
            self.heard = 0
        rows = self.heard - self.N  # whose delay lines are known; at first, as many as a path has taps
        if self.plant.begun or rows >= self.N:
            whole = np.all(np.isfinite(e)) and (rows >= self.B or not self.plant.begun)
            self.plant.learn(self.x_past, self.y_past, e, min(rows, self.B) if whole else 0)
        if self.plant.silent:
            self.w = np.zeros_like(self.w)
        elif self.plant.fits and not self.plant.waiting:
            self.solve()

    def take_references(self):
        """Set the lags of the window, into which the newest block fades in, and how loud it was of late."""
        block = np.sum(np.mean(self.x_past[:, -self.B :] ** 2, axis=1))
        self.current.take(block), self.usual.take(block)
        soft = self.recent.is_above(core.LOUDER**2, block)
        self.pause = self.pause + 1 if soft else 0
        stays_soft = self.pause > self.blocks  # no pause is longer than the account
        if stays_soft or not soft:
            self.pause = 0
            self.recent.take(block, anew=stays_soft), self.late.take(block, anew=stays_soft)
        self.later = min(self.current.over(self.usual), self.late.over(self.recent))
        fade_in = np.ones(self.x_past.shape[1])  # no edge at the window's end, on which a filter would ring
        fade_in[-self.B :] = 1 - ((np.arange(self.B) + 0.5) / self.B) ** 2
        faded = self.x_past * self.g ** (np.arange(fade_in.size - 1, -1, -1) / 2)
        past = self.g**self.B * self.R_sums
        self.R_sums, self.lags = (past + lags(x, self.N) for x in (faded, faded * fade_in))
        self.lags *= self.usual.sum / self.usual.weight / max(np.trace(self.lags[:, :, 0]), 1e-300)

    def set_room(self):
        """Set the sum of squares that each loudspeaker may play in the next block, whatever its filter asks for."""
        left = np.maximum(core.MOST * self.blocks - np.sum(self.book, axis=0), 0.0)
        self.room = left * self.B * self.rated_power

    def solve(self):
        """Set the prices at which the accounts afford the filters of least expected error; what a step leaves is cut."""
        self.set_equations()
        self.now = self.solved(self.price, self.now)
        last, self.price = self.price, self.next_price(self.price, self.now, self.afforded())
        if np.any(self.price != last):
            self.now = self.solved(self.price, self.now)
        share = self.afforded() / np.maximum(power_of(self.now, self.R), 1e-300)
        self.w = (self.now * np.sqrt(np.minimum(share, 1.0))[:, None]).reshape(self.w.shape)

    def set_equations(self):
        """Set A and b of (A + price R) v = b: correlations of the filtered references, and of these with the disturbance."""
        (J, I, L), (p, s) = self.w.shape, self.plant.paths()  # noqa: E741
        self.R_lags = two_sided(self.lags)
        self.R_lags[range(I), range(I), 0] *= 1 + core.REGULAR
        self.R = toeplitz(self.R_lags, L)
        P, S, X = (np.fft.rfft(u, self.R_lags.shape[2]) for u in (p, s, self.R_lags))
        A = np.einsum("kjf,kaf,icf->jiacf", S.conj(), S, X, optimize=True)
        self.A_lags = np.fft.irfft(A).reshape(J * I, J * I, -1)
        self.SS, self.turn = spectra(np.fft.irfft(np.einsum("kjf,kaf->jaf", S.conj(), S)))
        b = np.einsum("kjf,kcf,icf->jif", S.conj(), P, X, optimize=True)
        self.b = np.fft.irfft(b)[..., :L].ravel()
        self.gain = np.sum(s**2, axis=(0, 2))

    def solved(self, price, v):
        """Return filters after some steps from v towards those at the prices."""
        priced = np.diag(price + core.LEAKED * self.gain)[..., None]
        lags, L = self.A_lags + np.kron(priced, self.R_lags), self.w.shape[2]
        near = np.einsum("jaf,icf->jiacf", self.SS + priced, spectra(self.R_lags, L)[0])
        self.W = preconditioner(near.reshape(lags.shape), self.turn, L)
        return conjugate_gradients(toeplitz(lags, L), self.W, self.b, v.ravel(), core.FILTER_STEPS).reshape(v.shape)

    def next_price(self, price, v, target):
        """Return prices after a step of Newton's method for the powers, of which power^-1/2 is nearly a line.

        The slopes are -2 u_i' A^-1 u_j, u_j = R v_j; the preconditioner stands for A^-1. The sums of their sizes over j are
        slopes as well, with which no price moves too far if all move.
        """
        u, power = v @ self.R, power_of(v, self.R)
        H = np.einsum("jm,jman,an->ja", u, self.W.reshape(u.shape * 2), u, optimize=True)
        step = power * (np.sqrt(power / target) - 1) / np.maximum(np.sum(abs(H), axis=1), 1e-300)
        price = np.maximum(price + step, 0.0)
        return np.where(price < 1e-9 * self.gain, 0.0, price)

    def afforded(self):
        """Return the powers that the accounts afford, if the noise goes on.

        As in the last block for T/20; as in the window of x for T/5; and for any longer time at the lower one of the levels
        of now and of late. So what a silence has left is spent evenly.
        """
        T, window, block = self.blocks, self.blocks // core.WINDOW_LASTS, self.blocks // core.BLOCK_LASTS
        spent = np.concatenate([np.zeros((1, len(self.now))), np.cumsum(self.book, axis=0)])
        X = regressors(self.x_past, self.w.shape[2])[-self.B :]
        power, of_block = power_of(self.now, self.R), np.mean((X @ self.now.T) ** 2, axis=0)
        in_block = np.divide(of_block, power, where=(of_block > 0) & (power > 0), out=np.ones_like(power))

        def each(n, planned):
            return np.maximum((planned * T - spent[T - n]) / n, core.PLANNED - 1) * self.rated_power

        longer = [each(n, 1.0) / self.later for n in range(window + 1, T - block + 1)]
        return np.min([each(block, core.PLANNED) / in_block, each(window, core.PLANNED), *longer], axis=0)


def power_of(v, R):
    """Return the powers of filters (J, I L) for the correlations R of x."""
    return np.sum(v @ R * v, axis=1)
