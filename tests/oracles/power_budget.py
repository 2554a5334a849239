"""KF-PB: a posterior of the plant, the control filters of least expected error, and a price of power for each loudspeaker.

    y = v * x            asked of the loudspeakers
    e = p * x - s * y    heard by the microphones, and noise

After every block of B samples: the posterior of p and s takes the block (`Plant`), and the filters of all loudspeakers
become those of least expected error at the prices of their power (`PowerBudget`). K microphones, J loudspeakers, I
references, L taps of a control filter, M of a secondary path, N = L + M - 1 of a primary path: all that control can
reach. All sums are correlations of faded signals, and all products those of Toeplitz matrices, with period F.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

import numpy as np
from oracles.signals import Controller

from kfopc_filterpy.controllers.kf_pb import MEMORY_S, WINDOW_S, WINDOWS
from kfopc_filterpy.core.building import FOLDER


def constants() -> dict[str, float]:
    """Return the numbers that the core's sources name; of both builds, those of the one with doubles."""
    named = r"\b([A-Z][A-Z_]*) = (?:\(real\))?([0-9.]+(?:e-?[0-9]+)?)f?\b"
    text = "".join((FOLDER / name).read_text() for name in ("posterior.h", "posterior.c", "budget.c"))
    return {name: float(value) for name, value in re.findall(named, text)}


_core = constants()
SURPRISE, REDRAWN, FOREIGN = (_core[name] for name in ("SURPRISE", "REDRAWN", "FOREIGN"))
FADES, LOUDER, ENOUGH = (_core[name] for name in ("FADES", "LOUDER", "ENOUGH"))
PARTS, DRAWS, SHORTER = (int(_core[name]) for name in ("EIGHTHS", "DRAWS", "SHORTER"))
PLANT_STEPS, FILTER_STEPS, PRICE_STEPS = (int(_core[name]) for name in ("PLANT_STEPS", "FILTER_STEPS", "PRICE_STEPS"))
GROWTH, CHEAPER, CHEAPEST, WORTHWHILE = (_core[name] for name in ("GROWTH", "CHEAPER", "CHEAPEST", "WORTHWHILE"))
MOST, PLANNED, LEAST_SHARE, PRICE_RISES = (_core[name] for name in ("MOST", "PLANNED", "LEAST_SHARE", "PRICE_RISES"))
WINDOW_LASTS, BLOCK_LASTS, REGULAR = int(_core["WINDOW_LASTS"]), int(_core["BLOCK_LASTS"]), _core["REGULAR"]


def period(n):
    """Return the power of two that holds the lags of n taps of both signs."""
    return 1 << math.ceil(math.log2(2 * n))


def block_lags(u, v, n):
    """Return sum over the block of u_a(t) v_c(t - l), l < n: u (A, B); v (C, B + n - 1) ends with the block."""
    return np.array([[np.correlate(c, a, "valid")[::-1] for c in v[:, -u.shape[1] - n + 1 :]] for a in u])


def two_sided(R, F):
    """Return circular lags (A, A, F) from R_ab(l), l >= 0: R_ab(-l) = R_ba(l)."""
    c, n = np.zeros((*R.shape[:2], F)), R.shape[2]
    c[..., :n] = R
    c[..., F - n + 1 :] = np.swapaxes(R, 0, 1)[..., :0:-1]
    return c


def spectra(R, F):
    """Return the spectra of the adjoint lags, (A, A, F/2 + 1)."""
    return np.fft.rfft(two_sided(np.swapaxes(R, 0, 1), F))


def smoothed(X, n):
    """Return the spectra of the circulant that is nearest to n of the lags: definite if their Toeplitz matrix is."""
    F = 2 * (X.shape[2] - 1)
    triangle = np.maximum(1 - np.minimum(np.arange(F), F - np.arange(F)) / n, 0)
    return np.fft.rfft(np.fft.irfft(X, F) * triangle)


def inverted(A):
    """Return the inverses of small matrices (n, n, F/2 + 1)."""
    return np.moveaxis(np.linalg.inv(np.moveaxis(A, 2, 0)), 0, 2)


def filtered(h, u, B):
    """Return the last B samples of sum_i h_i * u_i; h (I, n)."""
    return sum((np.convolve(a[len(a) - B - len(b) + 1 :], b, "valid") for b, a in zip(h, u, strict=True)), np.zeros(B))


def conjugate_gradients(product, precondition, b, v, steps, axes, enough=0.0):
    """Return v after steps towards A v = b until `enough`, and b - A v; the scalars are sums over `axes`."""

    def dot(a, c):
        return np.sum(a * c, axis=axes, keepdims=True)

    def ratio(a, c):
        return np.where(c > 0, a / np.where(c > 0, c, 1.0), 0.0)

    r = b - product(v)
    p = z = precondition(r)
    rz = dot(r, z)
    for _ in range(steps):
        q = product(p)
        a = np.where(rz > enough, ratio(rz, dot(p, q)), 0.0)
        v, r = v + a * p, r - a * q
        z = precondition(r)
        new = dot(r, z)
        p, rz = z + ratio(new, rz) * p, new
    return v, r


class Plant:
    """The Gaussian posterior of theta = [p, s], for all microphones: they hear the same regressors z = [x, -y].

    Signals are faded, z(t) g^(age/2); theta is in these units, times g^(-i/2). So the data are G = T - E'E - S'S:
    the Toeplitz matrix T of all lags less what it has beyond the newest sample and before the first row.
    """

    def __init__(self, s, n_references, n_primary, block, spread, forget):
        self.s_hat, self.I, self.N, self.B, self.forget, self.exact = (
            s,
            n_references,
            n_primary,
            block,
            forget,
            spread == 0,
        )
        K, J, M = s.shape
        C, draws = n_references + (0 if self.exact else J), 0 if self.exact else DRAWS
        self.F, self.g, self.spread = period(n_primary), forget ** (1 / block), spread
        self.taper = self.g ** (np.arange(n_primary) / 2)
        self.mask = np.ones((C, n_primary))
        self.mask[self.I :, M:] = 0.0
        self.n, self.random = np.sum(self.mask), 1
        self.mean = np.zeros((K + draws, C, n_primary))
        if not self.exact:
            self.mean[:K, self.I :, :M] = s
        self.theta = self.mean / self.taper
        self.unit = self.signs(draws, C, n_primary) * self.mask
        self.q, self.significant, self.precision = np.zeros(K), 1.0, np.zeros((C, 1))
        self.waiting = self.silent = False  # waiting: no fit of a whole block since a surprise
        self.fits = self.surprises = 0
        self.missed = self.expected = self.loud = self.taught = 0.0
        self.T = None  # no data yet

    def signs(self, *shape):
        """Return random signs."""
        signs = np.empty(shape)
        for i in range(signs.size):
            self.random = (self.random * 1664525 + 1013904223) % 2**32
            signs.flat[i] = 1.0 if self.random >> 31 else -1.0
        return signs

    @property
    def known(self):
        """Return the posterior means in plain units, (K, C, N)."""
        return self.theta[: len(self.q)] * self.taper

    @property
    def p(self):
        """Return the primary paths, (K, I, N), as far as they are significant."""
        return self.significant * self.known[:, : self.I]

    @property
    def s(self):
        """Return the secondary paths, (K, J, M)."""
        return self.s_hat if self.exact else self.known[:, self.I :, : self.s_hat.shape[2]]

    def begin(self, z, newest):
        """Begin the data with the `newest` samples; z (C, N - 1 + B) ends with the block."""
        N, rows = self.N, len(self.theta)
        first = z[:, : z.shape[1] - newest][:, 1 - N :]
        self.first = first * self.g ** (np.arange(N - 2, -1, -1) / 2)
        self.T = block_lags(self.first, np.pad(self.first, [(0, 0), (N - 1, 0)]), N)
        self.r, self.ee, self.count = np.zeros((rows, len(z), N)), np.zeros(len(self.q)), 0.0
        self.explained, self.taught, self.fresh = 0.0, 0.0, True

    def learn(self, x, y, e, new):
        """Take the `new` last samples of a block of errors e, (K, B), with which x and y end; 0: e is not known."""
        B, I, known = self.B, self.I, self.fits and not self.waiting  # noqa: E741
        z = np.concatenate([x, -y])[: len(self.mask), 1 - self.N - B :]
        if self.T is None or not (new or known):
            self.begin(z, new)
        if not (new or known):
            return
        d = np.array([filtered(p, z[:I], B) for p in self.p])
        if new:
            heard = np.mean(e**2)
            if self.exact:  # s^ is right: what it plays is no news
                e = e + np.array([filtered(s, y, B) for s in self.s_hat])
            told = d + np.array([filtered(theta[I:], z[I:], B) for theta in self.known])
            loud = np.any(y[:, -B - self.s_hat.shape[2] + 1 :])
            if known and (self.exact or not loud or self.taught > 0):
                new = self.judge(np.mean((e - told) ** 2, 0), np.mean(d**2, 0), heard, z)
        if (
            not new
            and not self.waiting
            and np.sum(z[:I, -B:] ** 2) >= (self.count > 0) * np.sum([self.T[i, i, 0] for i in range(I)])
        ):
            self.begin(z, 0)  # what it would stand for is more than what is known
        elif new or not self.waiting:
            self.add(z, d, e, new)
        if new and self.fit() and new == B:
            self.waiting = self.silent = False

    def judge(self, missed, d2, heard, z):
        """Return how many of the newest samples are to be believed; forget all if they tell of another plant."""
        ends = self.B * np.arange(1, PARTS + 1) // PARTS
        self.loud = max(np.mean(d2), FADES * self.loud)
        noise = max(np.mean(self.q), self.missed / max(self.expected, 1e-300) * self.loud)
        if self.exact:
            doubt = np.mean(self.q) * self.n / self.count
        else:
            draws = self.theta[len(self.q) :] * self.taper * math.sqrt(np.mean(self.q))
            doubt = sum(np.mean(filtered(draw, z, self.B) ** 2) for draw in draws) / DRAWS
        limit = SURPRISE * (noise + doubt)
        new = self.B
        if np.mean(missed) > limit:
            of_part, last = [np.mean(part) for part in np.split(missed, ends[:-1])], np.mean(d2[ends[-2] :])
            usual = self.explained / (max(self.count, 1.0) * len(self.q))
            if of_part[-1] <= limit or (of_part[-1] > FOREIGN * last and FOREIGN * last < usual):
                return 0  # over already, or none of x: it tells nothing of the plant
            new = self.B - ends[np.argmax(np.array(of_part) > limit)]
            self.spread, self.waiting, self.surprises = REDRAWN, True, self.surprises + 1
            self.silent = heard >= np.mean(d2)  # the control does no good: listen to p alone
            self.begin(z, new)
        self.missed = self.forget * self.missed + min(np.mean(missed), np.mean(d2))
        self.expected = self.forget * self.expected + np.mean(d2)
        return new

    def add(self, z, d, e, new):
        """Add the block, or its newest samples; if there are none, what the posterior expects."""
        N, rows = self.N, new or self.B
        w = self.g ** (np.arange(rows - 1, -1, -1) / 2)
        z = z[:, 1 - N - rows :] * self.g ** (np.arange(N + rows - 2, -1, -1) / 2)
        if new:
            of_rows = np.concatenate([e[:, -rows:] * w, self.signs(len(self.theta) - len(self.q), rows)[:, ::-1]])
            energy = np.sum(of_rows[: len(self.q)] ** 2, 1)
        else:  # nothing changes then
            of_rows = np.array([filtered(theta, z, rows) for theta in self.theta])
            energy = np.sum(of_rows[: len(self.q)] ** 2, 1) + self.q * np.sum(w**2)
        f = self.g**rows
        self.first = math.sqrt(f) * self.first
        self.T = f * self.T + block_lags(z[:, 1 - rows - 1 :], z, N)
        fade = np.where(np.arange(len(self.theta)) < len(self.q), f, math.sqrt(f))[:, None, None]
        self.r = fade * self.r + block_lags(of_rows, z, N) * self.mask
        self.ee, self.count = f * self.ee + energy, f * self.count + np.sum(w**2)
        self.explained = f * self.explained + np.sum((d[:, -rows:] * w) ** 2)
        self.newest = z[:, -N:]

    def fit(self):
        """Take some steps towards the posterior, and estimate the noise; return False if there is nothing to fit."""
        K, I, N, F = len(self.q), self.I, self.N, self.F  # noqa: E741
        x2 = np.mean([self.T[i, i, 0] for i in range(I)])
        if not (x2 > 0 and np.all(self.ee > 0)):
            return False
        if not np.any(self.q):
            self.q = 1e-3 * self.ee / self.count
        # |p|^2 is expected to be E[d^2 + e^2] / E[x^2] of the data of now
        prior = I * N * x2 * K / (np.sum(self.ee) + self.explained)
        self.fresh |= prior > LOUDER * self.precision[0, 0]  # what soft data told is no start for loud ones
        self.precision[:I] = prior
        if not self.exact:
            size = np.mean(np.sum(self.s_hat**2, axis=2))
            self.precision[I:] = self.s_hat.shape[2] / (self.spread**2 * size)
        q = np.mean(self.q)
        ridge = q * self.precision * self.taper**2
        b = self.r + ridge * self.mean / self.taper
        b[K:] += np.sqrt(ridge) * self.unit  # draws over sqrt(q): they change little while q is learned
        if self.fresh:  # from the prior on
            self.theta = self.mean / self.taper
            self.theta[K:] = self.unit / np.sqrt(ridge)
        self.T_f = spectra(self.T, F)
        smooth = smoothed(self.T_f, N)
        self.E_f, self.S_f = (np.fft.rfft(u, F) for u in (self.newest, self.first))
        inverse = inverted(smooth + q * self.precision[:, :, None] * np.eye(len(smooth))[:, :, None])

        def precondition(r):
            return np.fft.irfft(np.einsum("acf,kcf->kaf", inverse, np.fft.rfft(r, F)), F)[..., :N] * self.mask

        enough = ENOUGH * self.n * np.where(np.arange(len(b)) < K, q, 1.0)[:, None, None]
        self.theta, rest = conjugate_gradients(
            lambda t: self.product(t) + ridge * t, precondition, b, self.theta, PLANT_STEPS, (1, 2), enough
        )
        theta = self.theta[:K]
        G_theta = (b - rest - ridge * self.theta)[:K]
        residual = np.maximum(self.ee + np.sum(theta * (G_theta - 2 * self.r[:K]), axis=(1, 2)), 0.0)
        # The noise, with the earlier estimate counting as n samples: a short record leaves little noise by chance.
        counted = max(self.count - I * N / 2, 0.0) + self.n
        self.q = np.maximum((residual + self.n * self.q) / counted, 1e-6 * self.ee / self.count)
        # By chance alone, n taps explain n q. James and Stein: what is not significant is not played.
        of_x = theta * (np.arange(len(self.mask)) < I)[:, None]
        explained = np.sum(of_x * self.product(of_x))
        self.significant = max(0.0, 1.0 - 2 * I * N * np.sum(self.q) / max(explained, 1e-300))
        self.explained = self.significant**2 * explained
        self.fits, self.fresh = self.fits + 1, False
        self.taught = np.sum([self.T[c, c, 0] for c in range(I, len(self.T))])
        return True

    def product(self, t):
        """Return G t."""
        F, N, T = self.F, self.N, np.fft.rfft(t, self.F)
        beyond = np.fft.irfft(np.einsum("cf,kcf->kf", self.E_f, T), F)[:, N : 2 * N - 1]
        beyond = np.fft.rfft(np.pad(beyond, [(0, 0), (N, 0)]), F)
        before = np.fft.rfft(np.fft.irfft(np.einsum("cf,kcf->kf", self.S_f, T), F)[:, : N - 1], F)
        out = np.einsum("acf,kcf->kaf", self.T_f, T)
        out = out - self.E_f.conj() * beyond[:, None] - self.S_f.conj() * before[:, None]
        return np.fft.irfft(out, F)[..., :N] * self.mask

    def paths(self):
        """Return rows of primary paths, (rows, I, N), and of secondary ones, whose sums are the posterior's expectations."""
        K = len(self.q)
        rows = self.theta * self.taper
        rows[K:] *= math.sqrt(K / DRAWS * np.mean(self.q))  # draws are of the mean noise
        return rows[:, : self.I], self.s_hat if self.exact else rows[:, self.I :, : self.s_hat.shape[2]]


class Window:
    """An exponential window of the references: its lags, and those of one into which the newest block fades in."""

    def __init__(self, references, lags, g, block):
        self.g, self.B, self.weight, self.sums = g, block, 0.0, np.zeros((references, references, lags))
        self.fade_in = 1 - ((np.arange(block) + 0.5) / block) ** 2  # no edge at its end, on which a filter would ring

    def take(self, x):
        """Take a block, with which x ends."""
        n, B, f = self.sums.shape[2], self.B, self.g**self.B
        loud, usual = np.sum(np.mean(x[:, -B:] ** 2, 1)), np.trace(self.sums[:, :, 0])
        if loud * self.weight > LOUDER * usual:  # a soft past counts less
            self.weight = usual / loud
        x = x[:, 1 - n - B :] * self.g ** (np.arange(n + B - 2, -1, -1) / 2)
        soft = x.copy()
        soft[:, -B:] *= self.fade_in
        w = self.g ** np.arange(B - 1, -1, -1)
        self.lags = (f * self.sums + block_lags(soft[:, -B:], soft, n)) / (
            f * self.weight + np.sum(w * self.fade_in**2)
        )
        self.sums, self.weight = f * self.sums + block_lags(x[:, -B:], x, n), f * self.weight + np.sum(w)


@dataclass(kw_only=True)
class PowerBudget(Controller):
    """KF-PB; `w` is the control filter."""

    rated_power: np.ndarray  # (J,)
    fs: float = 16000.0
    averaging_s: float = 10.0
    spread: float = 0.3  # of the secondary paths at the start; 0: they are exact
    block_s: float = 0.032

    def __post_init__(self):
        super().__post_init__()
        (_, J, M), (_, I, L) = self.s_hat.shape, self.w.shape  # noqa: E741
        N, B = L + M - 1, max(round(self.block_s * self.fs), 1)
        self.B, self.N = B, N
        self.g = math.exp(-1 / (min(self.averaging_s / WINDOWS, WINDOW_S) * self.fs))  # of the window of x, a sample
        self.plant = Plant(self.s_hat, I, N, B, self.spread, math.exp(-B / (MEMORY_S * self.fs)))
        self.window, self.short = Window(I, N, self.g, B), Window(I, N, self.g**SHORTER, B)
        self.blocks = max(round(self.averaging_s * self.fs / B), BLOCK_LASTS)  # over which the power is averaged
        self.x_past, self.y_past = np.zeros((I, N + B)), np.zeros((J, N + B))
        self.new = []  # samples of this block: x, y, e, asked^2, or None while silent
        self.peak = np.zeros(I)  # largest magnitude of x of late
        self.heard = 0  # samples that the delay lines hold, as they were
        self.book = np.ones(
            (self.blocks, J)
        )  # power of each block over the rating, newest first; spent before the start
        self.set_room()
        self.price, self.steady_price = np.zeros(J), np.zeros(J)
        self.now, self.steady = np.zeros((J, I, L)), np.zeros((J, I, L))  # filters at these prices

    @property
    def alarms(self):
        """Return the number of surprises."""
        return self.plant.surprises

    def hear(self, x):
        """Take the newest references, without clicks."""
        most = np.where(self.peak > 0, GROWTH * self.peak, np.inf)
        if np.any(np.abs(x) > most):  # false: nothing is learned until the delay lines hold no more of it
            self.heard = -1 - len(self.new)
        x = np.clip(x, -most, most)
        self.peak = np.maximum(np.abs(x), self.g * self.peak)
        super().hear(x)

    def output(self):
        """Return y_j = sum_i v_ji * x_i, and note what is asked."""
        y, left = super().output(), np.maximum(self.room - self.sum, 0.0)
        self.asked = np.where(y**2 <= left, y, np.copysign(np.sqrt(left), y))
        return self.asked

    def adapt(self, e):
        """Note the sample; `e` None: it was not heard."""
        self.sum = self.sum + self.asked**2
        self.note(e, self.asked**2)

    def follow(self):
        """Note a sample before the control is on."""
        self.note(self.d, None)

    def note(self, e, asked):
        """Note a sample; at the end of a block, learn."""
        self.new.append((self.x[:, 0].copy(), self.output_line[:, 0].copy(), e, asked))
        if len(self.new) == self.B:
            x, y, e, asked = zip(*self.new, strict=True)
            self.new = []
            missing = any(sample is None for sample in e)
            spent = [sample for sample in asked if sample is not None]
            self.end_block(
                np.transpose(x),
                np.transpose(y),
                None if missing else np.transpose(e),
                np.sum(spent, axis=0) / self.B if spent else None,
            )

    def end_block(self, x, y, e, asked):
        """Learn from a block: x (I, B), played y (J, B), e (K, B) or None, mean square asked (J,) or None if silent."""
        B = self.B
        self.x_past = np.concatenate([self.x_past[:, B:], x], axis=1)[:, -self.N - B :]
        self.y_past = np.concatenate([self.y_past[:, B:], y], axis=1)[:, -self.N - B :]
        self.window.take(self.x_past)
        self.short.take(self.x_past)
        if asked is not None:
            self.book = np.concatenate([[asked / self.rated_power], self.book[:-1]])
        self.set_room()
        self.heard += B
        rows = self.heard - self.N  # whose delay lines are known; at first, as many as a path has taps
        if self.plant.T is not None or rows >= self.N:
            whole = e is not None and (rows >= B or self.plant.T is None)
            self.plant.learn(self.x_past, self.y_past, e, min(rows, B) if whole else 0)
        if self.plant.silent:
            self.w = np.zeros_like(self.w)
        elif self.plant.fits and not self.plant.waiting:
            self.solve()

    def set_room(self):
        """Set what each loudspeaker may spend in the next block, whatever its filter asks for."""
        left = np.maximum(MOST * self.blocks - np.sum(self.book, axis=0), 0.0)
        self.room, self.sum = left * self.B * self.rated_power, np.zeros(len(left))

    def solve(self):
        """Set the prices, and the filters of least expected error at these prices."""
        J, F = len(self.w), self.plant.F
        self.set_equations()
        # 1 The prices at which the filters spend the rating, for the spectrum of the window of x and the level of the
        # shorter one, which the last filters tell.
        usual, now = (power_of(self.w, R) for R in (self.R, spectra(self.short.lags, F)))
        level = np.where((usual > 0) & (now > 0), now / np.where(usual > 0, usual, 1.0), 1.0)
        for _ in range(PRICE_STEPS):
            self.steady = self.solved(self.steady_price, self.steady)
            self.steady_price = self.next_price(self.steady_price, self.steady, self.rated_power / level)
        # 2 What the account holds makes power cheaper, but none that saves little of the noise.
        left = np.maximum(1.0 - np.mean(self.book, axis=0), 0.0)
        floor = WORTHWHILE * np.sum(self.plant.q) / (self.rated_power * J)
        self.price = np.maximum(self.steady_price * np.maximum(1.0 - CHEAPER * left, CHEAPEST), floor)
        self.now = self.solved(self.price, self.now)
        # 3 The account must stand it, and for longer if a silence has left more than the price follows.
        later = np.where(CHEAPER * left > 1.0 - CHEAPEST, np.minimum(level, 1.0), 0.0)
        share, power = self.share(self.now, later), power_of(self.now, self.R)
        if np.any(share < 1.0):
            self.price = self.next_price(self.price, self.now, np.minimum(share, 1.0) * power)
            self.now = self.solved(self.price, self.now)
            share = self.share(self.now, later)
        self.w = self.now * np.sqrt(np.minimum(share, 1.0))[:, None, None]

    def set_equations(self):
        """Set A = SS R and b: correlations of the filtered references, and with the disturbance, over the posterior."""
        F, L, p = self.plant.F, self.w.shape[2], self.plant
        lags = self.window.lags.copy()
        lags[range(len(lags)), range(len(lags)), 0] *= 1 + REGULAR
        self.R = spectra(lags, F)
        self.smooth_R = smoothed(self.R, L)
        P, S = (np.fft.rfft(rows, F) for rows in p.paths())
        self.SS = np.einsum("kjf,kaf->jaf", S.conj(), S)
        K = len(p.q)
        PS = p.significant * np.einsum("kcf,kjf->jcf", P[:K], S[:K].conj())
        PS = PS + p.significant * np.einsum("kcf,kjf->jcf", P[K:], S[K:].conj())
        self.b = np.fft.irfft(np.einsum("jcf,icf->jif", PS, self.R), F)[..., :L]
        (J, I, _), bins = self.w.shape, F // 2 + 1  # noqa: E741
        A = np.einsum("jaf,icf->jiacf", self.SS, self.R).reshape(J * I, J * I, bins)
        self.smooth_A = smoothed(A, L).reshape(J, I, J, I, bins)
        self.gain = np.array([np.fft.irfft(self.SS[j, j], F)[0] for j in range(J)])

    def solved(self, price, v):
        """Return filters after some steps from v towards those at the prices."""
        (J, I, L), F = v.shape, self.plant.F  # noqa: E741
        price = price + REGULAR * self.gain
        SS = self.SS + np.diag(price)[:, :, None]
        A = self.smooth_A + np.einsum("ja,icf->jiacf", np.diag(price), self.smooth_R)
        self.inverse = inverted(A.reshape(J * I, J * I, -1)).reshape(A.shape)

        def product(u):
            return np.fft.irfft(np.einsum("jaf,icf,acf->jif", SS, self.R, np.fft.rfft(u, F), optimize=True), F)[..., :L]

        def precondition(u):
            return np.fft.irfft(np.einsum("jiacf,acf->jif", self.inverse, np.fft.rfft(u, F)), F)[..., :L]

        return conjugate_gradients(product, precondition, self.b, v, FILTER_STEPS, (0, 1, 2))[0]

    def next_price(self, price, v, target):
        """Return prices after a step of Newton's method for the powers, of which power^-1/2 is nearly a line.

        The slopes are -2 u_i' A^-1 u_j, u_j = R v_j; the preconditioner stands for A^-1.
        """
        F = self.plant.F
        u = np.fft.irfft(np.einsum("icf,jcf->jif", self.R, np.fft.rfft(v, F)), F)[..., : v.shape[2]]
        power, U = np.sum(v * u, axis=(1, 2)), np.fft.rfft(u, F)
        weight = np.r_[1.0, np.full(F // 2 - 1, 2.0), 1.0] / F
        H = np.einsum("f,jif,jiacf,acf->ja", weight, U.conj(), self.inverse, U, optimize=True).real
        free = (price > 0) | (power > target)
        H = np.where(np.outer(free, free), H, 0.0)
        size = 1 / np.sqrt(np.maximum(np.diag(H), 1e-300))
        H = H * np.outer(size, size)

        def step_of(r):
            return (
                size
                * np.linalg.solve(H + (REGULAR * free + ~free) * np.eye(len(H)), np.where(free, size * r, 0.0))
                * free
            )

        step = step_of(power * (np.sqrt(power / target) - 1))
        if not step @ (power - target) > 0:
            step = step_of(0.5 * (power - target))
        price = price + np.clip(step, -price, np.maximum(PRICE_RISES * price, 1e-3 * self.gain))
        return np.where(price < 1e-9 * self.gain, 0.0, price)

    def share(self, v, later):
        """Return the largest shares of their power that the accounts stand.

        They must stand the power of the last block for T/20, that of the window of x for T/4, and `later` times it, for any
        longer time: so what a silence has left is spent evenly.
        """
        T, window, power = self.blocks, self.blocks // WINDOW_LASTS, power_of(v, self.R)
        spent = np.concatenate([np.zeros((1, len(v))), np.cumsum(self.book, axis=0)])
        of_block = np.array([np.mean(filtered(h, self.x_past, self.B) ** 2) for h in v])
        expected = [(power, window), (of_block, T // BLOCK_LASTS)]  # power, for how many blocks
        expected += [(later * power, n) for n in range(window + 1, T - T // BLOCK_LASTS + 1)]
        stood = [
            np.maximum(PLANNED * T - spent[T - n], LEAST_SHARE * n) / n * self.rated_power / np.maximum(P, 1e-300)
            for P, n in expected
        ]
        return np.min(stood, axis=0)


def power_of(v, R):
    """Return the powers of filters (J, I, L) for the spectra of the lags of x."""
    F = 2 * (R.shape[2] - 1)
    u = np.fft.irfft(np.einsum("icf,jcf->jif", R, np.fft.rfft(v, F)), F)[..., : v.shape[2]]
    return np.sum(v * u, axis=(1, 2))
