"""KF-PB: a posterior of the plant, the control filter of least expected error, and one price of power a loudspeaker.

    y = v * x            asked of the loudspeakers
    e = p * x - s * y    heard by the microphones, and noise

After every block of B samples: the posterior of p and s takes the block (`Plant`), and the filter of each loudspeaker in
turn becomes the one of least expected error at the price of its power (`PowerBudget`). K microphones, J loudspeakers, I
references, L taps of a control filter, M of a secondary path, N = L + M - 1 of a primary path: all that control can
reach. C_ab(l) = E[a(t) b(t - l)].
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from oracles.signals import Controller
from scipy.linalg import LinAlgError, cho_factor, cho_solve, cholesky, solve_toeplitz, solve_triangular, toeplitz

SURPRISE = 6.0  # error over the noise and the doubt that shows another plant
REDRAWN = math.sqrt(2.0)  # rms error over the path, of a path that gave way to an independent one of the same size
PARTS = 8  # of a block, in which a surprise is located
NEWS = 1 / 8  # a fit begins if this share of the samples, or of the energy of x or y, is new
FOREIGN = 16.0  # a noise so far beyond the disturbance that x foretells, which is so far below the usual one, has no part of x
FADES = 0.5  # what a block leaves to the next of a sound that is longer than the paths
DRAWS = 8  # of the posterior, that stand for its covariance
MEMORY_S = 5.0  # time constant of forgetting
WORK = 2.0**26  # operations of a factorisation in a block
GROWTH = 10.0  # a sound does not grow by more from one sample to the next, but a click does
CHEAPER, CHEAPEST = 4.0, 0.7  # what is left of the account makes power cheaper by so many times its share; the least
WORTHWHILE = 0.5  # a rating of power must save at least this share of the measurement noise
MOST = 1.04  # of the account, that is never exceeded: what goes beyond it is clipped
WINDOWS, WINDOW_S = 8, 1.25  # windows of x in the averaging time, and a window's longest time constant
SHORTER = 5  # a window for the level of x than that for its spectrum
# Parts of the averaging time for which the powers of the last window and block may go on.
WINDOW_LASTS, BLOCK_LASTS = 4, 20


def lagged(u, e, n):
    """Return sum_t e(t) u(t - l), l < n, over the block e; u ends with the block."""
    return np.correlate(u[len(u) - len(e) - n + 1 :], e, "valid")[::-1]


def gram(u, v, B, n, m):
    """Return sum_t u(t - i) v(t - j), i < n, j < m, over the last B samples t."""
    G = np.empty((n, m))
    G[0], G[:, 0] = lagged(v, u[-B:], m), lagged(u, v[-B:], n)
    # Newest first: at the end, before the block.
    (a, b), (c, d) = (u[::-1], v[::-1]), (u[-B - 1 :: -1], v[-B - 1 :: -1])
    for i in range(1, n):  # along the diagonals, the window of t moves by one sample
        G[i, 1:] = G[i - 1, :-1] + c[i - 1] * d[: m - 1] - a[i - 1] * b[: m - 1]
    return G


def filtered(h, u, B):
    """Return the last B samples of h * u."""
    return np.convolve(u[len(u) - B - len(h) + 1 :], h, "valid")


class Plant:
    """The Gaussian posterior of theta = [p, s], for all microphones: they hear the same regressors z = [x, -y]."""

    def __init__(self, s, n_references, n_primary, block, spread, forget):
        self.s_hat, self.s, self.B, self.forget, self.exact = s, s.copy(), block, forget, spread == 0
        (K, J, M), I, N = s.shape, n_references, n_primary  # noqa: E741
        self.widths = [N] * I + [M] * (0 if self.exact else J)
        self.at = np.concatenate([[0], np.cumsum(self.widths)])
        self.n = self.at[-1]
        self.primary = slice(0, I * N)
        self.size = np.mean(np.sum(s**2, axis=2))  # of a secondary path
        self.spread = spread
        self.theta, self.q = np.zeros((K, self.n)), np.zeros(K)
        self.theta[:, I * N :] = 0.0 if self.exact else s.reshape(K, -1)
        self.draws = np.zeros((DRAWS, self.n))  # of theta less its mean, for the mean noise; none yet
        self.significant, self.random = 1.0, 1
        self.delay = int(self.n**3 / 3 / WORK)  # blocks that a factorisation takes
        self.waiting = self.silent = False  # waiting: no fit since a surprise
        self.fits = self.surprises = 0
        self.missed = self.expected = self.loud = 0.0
        self.forget_all()

    def forget_all(self):
        """Begin the data: G = sum z z', r = sum e z, sum e^2, and how many samples, all fading by `forget` a block."""
        K, n = self.theta.shape
        self.G, self.r, self.ee, self.count = np.zeros((n, n)), np.zeros((K, n)), np.zeros(K), 0.0
        self.fitted, self.pending = np.zeros(3), None

    @property
    def p(self):
        """Return the primary paths, (K, I, N)."""
        return self.theta[:, self.primary].reshape(len(self.theta), -1, self.widths[0])

    def parts(self, theta):
        """Return the filters of a vector: (I, N) of x, (J, M) of y."""
        split = self.primary.stop
        return theta[:split].reshape(-1, self.widths[0]), theta[split:].reshape(-1, self.s.shape[2])

    def explain(self, theta, x, y):
        """Return p * x and s * y of the block, for theta."""
        p, s = self.parts(theta)
        d = sum(filtered(h, u, self.B) for h, u in zip(p, x, strict=True))
        z = sum((filtered(h, u, self.B) for h, u in zip(s, y, strict=not self.exact)), np.zeros(self.B))
        return d, z

    def explained(self):
        """Return sum d^2 of the data, over all microphones."""
        p = self.theta[:, self.primary]
        return np.sum(p @ self.G[self.primary, self.primary] * p)

    def held(self):
        """Return the samples of the data, and their energies of x and of y."""
        energy = np.diag(self.G)[self.at[:-1]]
        n = self.primary.stop // self.widths[0]
        return np.array([self.count, np.sum(energy[:n]), np.sum(energy[n:])])

    def learn(self, x, y, e):
        """Take a block of errors e, (K, B)."""
        heard = np.mean(e**2)
        if self.exact:  # s^ is right: what it plays is no news
            e = e + np.array([sum(filtered(h, u, self.B) for h, u in zip(s, y, strict=True)) for s in self.s_hat])
        d, z = (np.array(each) for each in zip(*(self.explain(theta, x, y) for theta in self.theta), strict=True))
        missed, d2, new = np.mean((e - d + z) ** 2, axis=0), np.mean(d**2, axis=0), self.B
        loud = np.any(y[:, -self.B - self.s.shape[2] + 1 :])
        if self.fits and not self.waiting and (self.exact or not loud or self.fitted[2] > 0):
            usual = self.explained() / (self.count * len(e))
            self.loud = max(np.mean(d2), FADES * self.loud)
            usual_noise = self.missed / max(self.expected, 1e-300) * self.loud
            limit = self.limit(max(np.mean(self.q), usual_noise), x, y)
            ends = self.B * np.arange(1, PARTS + 1) // PARTS
            of_part, d2_last = [np.mean(part) for part in np.split(missed, ends[:-1])], np.mean(d2[ends[-2] :])
            if np.mean(missed) > limit:
                foreign = of_part[-1] > FOREIGN * d2_last and FOREIGN * d2_last < usual
                if foreign or of_part[-1] <= limit:
                    new = 0  # none of x, or over already: it tells nothing of the plant
                else:  # the plant is another one: begin again, with what was heard after the change
                    new = self.B - ends[np.argmax(np.array(of_part) > limit)]
                    self.forget_all()
                    self.spread, self.waiting, self.surprises = REDRAWN, True, self.surprises + 1
                    self.silent = heard >= np.mean(d2)  # the control does no good: listen to p alone
            if new:
                self.missed = self.forget * self.missed + min(np.mean(missed), np.mean(d2))
                self.expected = self.forget * self.expected + np.mean(d2)
        self.add(x, y, e, new)
        due = self.waiting or np.any(self.held() * (1 - NEWS) > self.fitted)
        if self.pending is None and new == self.B and due:
            self.begin_fit()
        if self.pending is not None:
            self.pending[0] -= 1
            if self.pending[0] < 0:
                self.end_fit()

    def limit(self, noise, x, y):
        """Return the largest mean square that the noise and the doubt explain; the noise grows with the disturbance."""
        draws = [] if self.exact else self.draws
        doubt = sum(np.mean(np.subtract(*self.explain(draw, x, y)) ** 2) for draw in draws) / DRAWS
        return SURPRISE * (noise + doubt)

    def add(self, x, y, e, new):
        """Add the last `new` samples of the block to the data."""
        f = self.forget
        self.G, self.r, self.fitted = f * self.G, f * self.r, f * self.fitted
        self.ee, self.count = f * self.ee, f * self.count
        if new == 0:
            return
        e = e[:, -new:]
        self.ee, self.count = self.ee + np.sum(e**2, axis=1), self.count + new
        z = list(zip([*x, *(() if self.exact else -y)], self.at[:-1], self.widths, strict=True))
        for i, (u, a, n) in enumerate(z):
            for k in range(len(e)):
                self.r[k, a : a + n] += lagged(u, e[k], n)
            for v, b, m in z[i:]:
                more = gram(u, v, new, n, m)
                self.G[a : a + n, b : b + m] += more
                if b > a:
                    self.G[b : b + m, a : a + n] += more.T

    def begin_fit(self):
        """Set aside the data of now for a factorisation."""
        n = self.primary.stop
        x2 = np.mean(np.diag(self.G)[:n])
        if not (x2 > 0 and np.all(self.ee > 0)):
            return
        if not np.any(self.q):
            self.q = 1e-3 * self.ee / self.count
        # |p|^2 is expected to be E[d^2 + e^2] / E[x^2] of the data of now
        prior = n * x2 * len(self.ee) / (np.sum(self.ee) + self.explained())
        self.pending = [self.delay, self.G.copy(), self.r.copy(), self.ee.copy(), self.count, prior]
        self.fitted = self.held()

    def end_fit(self):
        """Solve for the posterior of the data set aside."""
        _, G, r, ee, count, prior = self.pending
        self.pending = None
        p, n, q, K = self.primary, self.primary.stop, np.mean(self.q), len(r)
        precision = np.full(self.n, prior)
        precision[n:] = self.s.shape[2] / (self.spread**2 * self.size) if not self.exact else 0.0
        C = cholesky(G + q * np.diag(precision), lower=True, check_finite=False)
        mean = np.zeros((K, self.n))
        mean[:, n:] = 0.0 if self.exact else self.s_hat.reshape(K, -1)
        theta = self.theta = cho_solve((C, True), (r + q * precision * mean).T, check_finite=False).T
        residual = ee - 2 * np.sum(theta * r, axis=1) + np.sum(theta @ G * theta, axis=1)
        # The noise, with the earlier estimate counting as n samples: a short record leaves little noise by chance.
        self.q = np.maximum((residual + self.n * self.q) / (max(count - n / 2, 0.0) + self.n), 1e-6 * ee / count)
        # By chance alone, n taps explain n q. James and Stein: what is not significant is not played.
        self.significant = max(0.0, 1.0 - 2 * n * np.sum(self.q) / max(self.explained(), 1e-300))
        theta[:, p] *= self.significant
        # Draws: theta has the covariance q (G + q prior)^-1 = q C'^-1 C^-1.
        signs = np.reshape([self.sign() for _ in range(DRAWS * self.n)], (DRAWS, self.n))
        self.draws = math.sqrt(q) * solve_triangular(C, signs.T, lower=True, trans=1, check_finite=False).T
        if not self.exact:
            self.s = theta[:, n:].reshape(self.s.shape)
        self.fits, self.waiting, self.silent = self.fits + 1, False, False

    def sign(self):
        """Return a random sign."""
        self.random = (self.random * 1664525 + 1013904223) % 2**32
        return 1.0 if self.random >> 31 else -1.0

    def correlations(self):
        """Return E[s_j ~ s_j'](u), (J, J, 2M - 1), and E[p_i ~ s_j](u), (I, J, N + M - 1), summed over microphones.

        a ~ b is sum_m a(m + u) b(m) for u = 1 - M on; E is over the posterior.
        """
        (K, J, M), (I, N) = self.s.shape, (self.p.shape[1], self.p.shape[2])  # noqa: E741
        ss, ps = np.zeros((J, J, 2 * M - 1)), np.zeros((I, J, N + M - 1))
        samples = [(1.0, 1.0, self.p[k], self.s[k]) for k in range(K)]
        if not self.exact:
            share = K / DRAWS  # draws are of the mean noise
            samples += [(share, share * self.significant, *self.parts(draw)) for draw in self.draws]
        for weight, of_p, p, s in samples:
            for j in range(J):
                for a in range(J):
                    ss[j, a] += weight * np.correlate(s[j], s[a], "full")
                for i in range(I):
                    ps[i, j] += of_p * np.correlate(p[i], s[j], "full")
        return ss, ps


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
        self.B, self.N, self.lags = B, N, L + N
        self.g = math.exp(-1 / (min(self.averaging_s / WINDOWS, WINDOW_S) * self.fs))  # of the window of x, a sample
        self.plant = Plant(self.s_hat, I, N, B, self.spread, math.exp(-B / (MEMORY_S * self.fs)))
        self.blocks = max(round(self.averaging_s * self.fs / B), BLOCK_LASTS)  # over which the power is averaged
        history = self.lags + B
        self.x_past, self.y_past = np.zeros((I, history)), np.zeros((J, history))
        self.new = []  # samples of this block: x, y, e, asked^2, or None while silent
        self.peak = np.zeros(I)  # largest magnitude of x of late
        self.heard = 0  # samples that the delay lines hold, as they were
        self.R = np.zeros((I, I, self.lags))  # windowed sums of x_i(t) x_i'(t - l)
        self.short = np.zeros((I, I, L))
        self.weights = np.zeros(2)
        self.book = np.ones(
            (self.blocks, J)
        )  # power of each block over the rating, newest first; spent before the start
        self.set_room()
        self.price, self.steady_price = np.zeros(J), np.zeros(J)

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
        self.x_past = np.concatenate([self.x_past[:, B:], x], axis=1)
        self.y_past = np.concatenate([self.y_past[:, B:], y], axis=1)
        self.take_references()
        if asked is not None:
            self.book = np.concatenate([[asked / self.rated_power], self.book[:-1]])
        self.set_room()
        if e is not None and self.heard >= self.N:
            self.plant.learn(self.x_past, self.y_past, e)
        self.heard += B
        if self.plant.silent:
            self.w[:] = 0.0
        elif self.plant.fits and not self.plant.waiting:
            self.solve()

    def set_room(self):
        """Set what each loudspeaker may spend in the next block, whatever its filter asks for."""
        left = np.maximum(MOST * self.blocks - np.sum(self.book, axis=0), 0.0)
        self.room, self.sum = left * self.B * self.rated_power, np.zeros(len(left))

    def take_references(self):
        """Add the block to the windows of the references; x is zero before the first, so they are positive definite."""
        for c, (R, g) in enumerate([(self.R, self.g), (self.short, self.g**SHORTER)]):
            window = g ** np.arange(self.B - 1, -1, -1.0)
            R *= g**self.B
            for i, u in enumerate(self.x_past):
                for a, v in enumerate(self.x_past):
                    R[i, a] += lagged(v, window * u[-self.B :], R.shape[2])
            self.weights[c] = g**self.B * self.weights[c] + np.sum(window)

    def solve(self):
        """Give each loudspeaker in turn the filter of least expected error at its price, given the others'."""
        (J, I, L), M, N = self.w.shape, self.s_hat.shape[2], self.N  # noqa: E741
        R = self.R / self.weights[0] * self.g ** (np.arange(self.lags) / 2)
        R = np.concatenate([np.swapaxes(R, 0, 1)[..., :0:-1], R], axis=2)  # C_xx(l), l from 1 - lags on
        ss, ps = self.plant.correlations()
        middle = self.lags - 1
        # C of x'_ji and x'_j'i' at |l| < L: sum over u of E[s_j ~ s_j'](u) C_xx(l - u), where s_j delays the first signal
        A = np.empty((J, I, J, I, 2 * L - 1))
        b = np.zeros((J, I, L))
        for j in range(J):
            for i in range(I):
                for a in range(J):
                    for c in range(I):
                        # E[x'_ji(t) x'_ac(t - l)] = sum_u (s_j ~ s_a)(u) C_ic(l - u)
                        A[j, i, a, c] = np.convolve(R[i, c, middle - L - M + 2 : middle + L + M - 1], ss[j, a], "valid")
                for c in range(I):
                    # E[d(t) x'_ji(t - l)] = sum_u (p_c ~ s_j)(u) C_ci(l - u), l from 0 on
                    b[j, i] += np.convolve(R[c, i, middle - N + 1 : middle + L + M - 1], ps[c, j], "valid")
        left = 1.0 - np.mean(self.book, axis=0)  # of the account
        for j in range(J):
            rest = b[j] - sum(product(A[j, :, a], self.w[a]) for a in range(J) if a != j)
            self.spend(j, A[j, :, j], rest, R, left[j])

    def spend(self, j, A, b, R, left):
        """Set the price of loudspeaker j, and its filter at that price."""
        L, rho = self.w.shape[2], self.rated_power[j]
        middle = self.lags - 1
        system = System(A, R[:, :, middle - L + 1 : middle + L], b)
        # 1 The price at which the filter spends the rating, for the spectrum of the window of x and the level of the
        # shorter one, which the last filter tells.
        usual, now = np.sum(self.w[j] * product(system.R, self.w[j])), self.power_of_now(self.w[j])
        level = now / usual if usual > 0 and now > 0 else 1.0
        self.steady_price[j], _, _ = system.price_of(rho / level, self.steady_price[j])
        # 2 What the account holds makes power cheaper, but none that saves little of the noise.
        price = max(
            self.steady_price[j] * max(1.0 - CHEAPER * max(left, 0.0), CHEAPEST),
            WORTHWHILE * np.sum(self.plant.q) / (rho * len(self.rated_power)),
        )
        v, power = system.at(price)
        # 3 The account must stand it, and for longer if a silence has left more than the price follows.
        saved = CHEAPER * left > 1.0 - CHEAPEST
        share = self.share(j, v, power, min(level, 1.0) * power if saved else None) if power > 0 else 1.0
        if share < 1.0:
            price, v, _ = system.price_of(share * power, price)
        self.price[j], self.w[j] = price, v

    def power_of_now(self, v):
        """Return the mean power of a filter v, (I, L), over the short window."""
        I, L = v.shape  # noqa: E741
        C = self.short / self.weights[1] * self.g ** (SHORTER / 2 * np.arange(L))
        # E[y^2] = sum_l (v_i ~ v_a)(l) C_ia(l), with both signs of l in the two orders of i and a
        h = [[np.correlate(v[a], v[i], "full")[L - 1 :] for a in range(I)] for i in range(I)]  # sum_m v_a(m + l) v_i(m)
        return sum(2 * h[i][a] @ C[i, a] - h[i][a][0] * C[i, a, 0] for i in range(I) for a in range(I))

    def share(self, j, v, power, now):
        """Return the largest share of its power that the account of loudspeaker j stands, for a filter v, (I, L).

        It must stand the power of the last block for T/20, that of the window of x for T/4, and that of now, if given, for
        any time from there to 3T/4: so what a silence has left is spent evenly.
        """
        T, rho, window = self.blocks, self.rated_power[j], self.blocks // WINDOW_LASTS
        spent = np.concatenate([[0.0], np.cumsum(self.book[:, j])])
        y = sum(filtered(h, u, self.B) for h, u in zip(v, self.x_past, strict=True))
        expected = [(power, window), (np.mean(y**2), T // BLOCK_LASTS)]  # power, for how many blocks
        if now is not None:
            expected += [(now, n) for n in range(window + 1, T - window + 1)]
        return min(max(T - spent[T - n], 0.02 * n) / n * rho / max(power, 1e-300) for power, n in expected)


def product(A, v):
    """Return sum_c A_ic v_c, (I, L), for Toeplitz blocks A_ic[l, m] = A[i, c, L - 1 + m - l]."""
    return np.array([sum(np.correlate(lags, h, "valid")[::-1] for lags, h in zip(row, v, strict=True)) for row in A])


class System:
    """(A + price R) v = b with Toeplitz blocks, and the power v' R v."""

    def __init__(self, A, R, b):
        L = b.shape[1]
        self.A, self.R, self.b = A.copy(), R, b
        self.A[range(len(b)), range(len(b)), L - 1] *= 1 + 1e-7
        self.scale = A[0, 0, L - 1] / R[0, 0, L - 1]

    def solved(self, price, *right):
        """Return the solutions for right sides, (I, L); LinAlgError if the matrix is not positive definite."""
        lags = self.A + price * self.R
        I, L = self.b.shape  # noqa: E741
        if I == 1:
            v = solve_toeplitz(lags[0, 0, L - 1 :], np.transpose([u[0] for u in right]), check_finite=False)
            return [u[np.newaxis] for u in v.T]
        whole = np.block([[toeplitz(lags[i, c, L - 1 :: -1], lags[i, c, L - 1 :]) for c in range(I)] for i in range(I)])
        v = cho_solve(cho_factor(whole, lower=True), np.transpose([u.ravel() for u in right]))
        return [u.reshape(I, L) for u in v.T]

    def at(self, price):
        """Return v and its power; zeros if there is no solution."""
        try:
            (v,) = self.solved(price, self.b)
        except LinAlgError:
            return np.zeros_like(self.b), 0.0
        return v, float(np.sum(v * product(self.R, v)))

    def price_of(self, power, start):
        """Return the least price >= 0 at which v takes at most `power`, v, and the power that it takes.

        power^-1/2 is a concave function of the price, nearly a line, so Newton's steps approach from below.
        """
        price = start if start < 1e6 * self.scale else 0.0
        for _ in range(20):
            try:
                (v,) = self.solved(price, self.b)
                u = product(self.R, v)
                (w,) = self.solved(price, u)
            except LinAlgError:
                price = max(2 * price, 1e-6 * self.scale)
                continue
            taken, slope = np.sum(v * u), np.sum(u * w)
            if abs(taken - power) <= 0.005 * power or (price == 0.0 and taken <= power) or not slope > 0:
                break
            # power^-1/2 has the slope taken^-3/2 u' A^-1 u
            price = max(price + taken * (math.sqrt(taken / power) - 1.0) / slope, 0.0)
        return price, v, float(taken)
