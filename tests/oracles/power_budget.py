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
from typing import ClassVar

import numpy as np
from oracles.signals import Controller
from scipy.linalg import LinAlgError, cho_factor, cho_solve, cholesky, solve_toeplitz, solve_triangular, toeplitz

UNKNOWN = 4.0  # after an alarm: root mean square of the error of a secondary path, over the path
KEPT = 4.0  # after an alarm: what is known of the primary paths counts as so many samples for each tap
FORGOTTEN = 1 / 16  # ... if they have changed
JUDGED, WRONG = (9, 16), 4  # blocks after an alarm, and how many of them show that the primary paths have changed
DRAWS = 8  # of the posterior, that stand for its covariance
SURPRISE, MISFIT, USUAL = (
    4.0,
    0.03,
    5.0,
)  # alarm: times the noise and the doubt; least share of the disturbance; times the usual misfit
ACCOUNT = 4.0  # the price falls to (1 - 4/16)^16 = 0.01 of itself if nothing of the account is spent
WORTHWHILE = 0.5  # a rating of power must save at least this share of the measurement noise
MOST = 1.04  # of the account, that is never exceeded: what goes beyond it is clipped
WINDOW = 8  # the filter is solved for the references of an exponential window of the averaging time over this
TWICE = 2.0  # what lasted t may go on for twice as long
SHORTEST = 20  # ... and for a twentieth of the averaging time
SCALES = (100, 40, 4)  # t: windows of the averaging time over these; besides, the last block and the window above
QUIET = 31  # blocks from the first fit after an alarm to the next alarm, at least
KNOWN = 0.05  # no alarm before as much of the memory was heard
WORK = 2.0**26  # operations of a factorisation in a block


def lagged(u, e, n):
    """Return sum_t e(t) u(t - l), l < n, over the block e; u ends with the block."""
    return np.correlate(u[len(u) - len(e) - n + 1 :], e, "valid")[::-1]


def gram(u, v, B, n, m):
    """Return sum_t u(t - i) v(t - j), i < n, j < m, over the last B samples t."""
    G = np.empty((n, m))
    G[0], G[:, 0] = lagged(v, u[-B:], m), lagged(u, v[-B:], n)
    (a, b), (c, d) = (
        (u[::-1], v[::-1]),
        (u[-B - 1 :: -1], v[-B - 1 :: -1]),
    )  # newest first: at the end, before the block
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
        n = self.n = self.at[-1]
        self.primary = slice(0, I * N)
        # The data: G = sum z z', r = sum e z, sum e^2, and how many samples, all fading by `forget` a block.
        self.G, self.r, self.ee, self.count = np.zeros((n, n)), np.zeros((K, n)), np.zeros(K), 0.0
        self.size = np.mean(np.sum(s**2, axis=2))  # of a secondary path
        self.spread = spread
        self.prior_p = None  # precision of a tap of p
        self.theta, self.q = np.zeros((K, n)), np.zeros(K)
        self.theta[:, I * N :] = 0.0 if self.exact else s.reshape(K, -1)
        self.draws = np.zeros((DRAWS, n))  # of theta less its mean, for the mean noise; none yet
        self.random = 1
        self.delay = int(n**3 / 3 / WORK)  # blocks that a factorisation takes
        self.collected = self.delay // 2 + 1  # blocks of data for the first fit after an alarm
        self.first_fit = self.collected + self.delay  # blocks from an alarm to its end
        self.pending, self.fitted, self.fits = None, 0.0, 0
        self.age = self.idle = 0  # blocks since the loudspeakers sound or an alarm; since the last fit began
        self.alarms = 0
        self.sounds = self.doubtful = False  # doubtful: no fit since the alarm
        self.misfit, self.seen = 0.0, 0.0  # mean of (res / d^2)^2, and its weight
        self.limit, self.before, self.wrong = (
            0.0,
            0.0,
            0,
        )  # of the last alarm: what was exceeded, noise; blocks since that do

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

    def learn(self, x, y, e, known):
        """Take a block of errors e, (K, B); return whether the posterior no longer explains them."""
        if self.exact:  # s^ is right: what it plays is no news
            e = e + np.array([sum(filtered(h, u, self.B) for h, u in zip(s, y, strict=True)) for s in self.s_hat])
        explained = [self.explain(theta, x, y) for theta in self.theta]
        d, z = (np.array(each) for each in zip(*explained, strict=True))
        unexplained, d2 = np.mean((e - d + z) ** 2), np.mean(d**2)
        q, loud = np.mean(self.q), bool(np.any(y[:, -self.B - self.s.shape[2] + 1 :]))
        self.age += 1
        self.idle += 1
        if loud and not self.sounds:
            self.sounds, self.age = True, 1
        alarm = self.is_alarm(unexplained, d2, q, x, y) if known and loud else False
        if alarm:
            self.alarms += 1
            self.begin_anew(FORGOTTEN if self.exact else KEPT)
        elif self.is_wrong(unexplained):
            self.begin_anew(FORGOTTEN)
            self.q[:], self.limit = self.before, 0.0  # once for an alarm
        elif known and self.fits and d2 > 0 and not self.doubtful:
            self.misfit = self.forget**2 * self.misfit + min(unexplained / d2, 1.0) ** 2
            self.seen = self.forget**2 * self.seen + 1.0
        if not alarm:  # the block of a change is of two plants
            self.add(x, y, e)
        due = self.pending is None and (not self.doubtful or self.age >= self.collected)
        news = self.count - self.fitted > self.count / 8 or (self.sounds and self.age <= 16)
        if due and (news or (unexplained > 2 * q and self.idle >= 8)):
            self.begin_fit()
        if self.pending is not None:
            self.pending[0] -= 1
            if self.pending[0] < 0:
                self.end_fit()
        return alarm

    def is_alarm(self, unexplained, d2, q, x, y):
        """Return whether the error is beyond its noise, the usual misfit of the model, and what is not known."""
        if self.age <= (QUIET + self.first_fit if self.alarms else 1) or self.doubtful or not self.seen:
            return False
        usual = max(MISFIT, USUAL * math.sqrt(self.misfit / self.seen))
        limit = SURPRISE * q + usual * d2
        if unexplained <= limit:
            return False
        draws = [] if self.exact else self.draws
        doubt = sum(np.mean(np.subtract(*self.explain(draw, x, y)) ** 2) for draw in draws) / DRAWS
        if unexplained <= limit + SURPRISE * doubt:
            return False
        self.limit, self.before, self.wrong = limit, q, 0
        return True

    def is_wrong(self, unexplained):
        """Return whether other secondary paths do not explain the errors after an alarm: the primary ones have changed."""
        fitted_for = self.age - self.first_fit
        if self.exact or not self.limit or not JUDGED[0] <= fitted_for <= JUDGED[1]:
            return False
        self.wrong += unexplained > self.limit
        return fitted_for == JUDGED[1] and self.wrong >= WRONG

    def begin_anew(self, kept):
        """The secondary paths have changed: they return to their prior; of the primary paths, some samples a tap are kept."""
        p, n = self.primary, self.primary.stop
        self.r[:, p] -= self.theta[:, n:] @ self.G[n:, p]  # as if s had been known until now
        self.r[:, n:] = self.G[n:] = self.G[:, n:] = 0.0
        kept = min(kept * self.n / self.count, 1.0)
        self.G, self.r, self.count = kept * self.G, kept * self.r, kept * self.count
        theta = self.theta[:, p]
        self.ee = self.count * self.q + 2 * np.sum(theta * self.r[:, p], axis=1)
        self.ee -= np.sum(theta @ self.G[p, p] * theta, axis=1)
        self.pending, self.fitted, self.age, self.idle, self.doubtful = None, 0.0, 0, 0, True
        if not self.exact:
            self.spread, self.s, self.draws[:] = UNKNOWN, self.s_hat.copy(), 0.0
            self.theta[:, n:] = self.s.reshape(len(theta), -1)

    def add(self, x, y, e):
        """Add the block to the data."""
        f, B = self.forget, self.B
        self.G, self.r, self.fitted = f * self.G, f * self.r, f * self.fitted
        self.ee, self.count = f * self.ee + np.sum(e**2, axis=1), f * self.count + B
        z = [*x, *(() if self.exact else -y)]
        for i, (u, a, n) in enumerate(zip(z, self.at[:-1], self.widths, strict=True)):
            for k in range(len(e)):
                self.r[k, a : a + n] += lagged(u, e[k], n)
            for v, b, m in list(zip(z, self.at[:-1], self.widths, strict=True))[i:]:
                new = gram(u, v, B, n, m)
                self.G[a : a + n, b : b + m] += new
                if b > a:
                    self.G[b : b + m, a : a + n] += new.T

    def begin_fit(self):
        """Set aside the data of now for a factorisation."""
        n = self.primary.stop
        if self.prior_p is None:
            x2 = np.mean(np.diag(self.G)[:n])
            if not (x2 > 0 and np.all(self.ee > 0)):
                return
            # |p|^2 is expected to be E[d^2] / E[x^2]
            self.prior_p, self.q = n * x2 / np.mean(self.ee), 1e-3 * self.ee / self.count
        self.pending = [self.delay, self.G.copy(), self.r.copy(), self.ee.copy(), self.count]
        self.fitted, self.idle = self.count, 0

    def end_fit(self):
        """Solve for the posterior of the data set aside."""
        _, G, r, ee, count = self.pending
        self.pending = None
        n, q, K = self.primary.stop, np.mean(self.q), len(r)
        precision = np.full(self.n, self.prior_p)
        precision[n:] = self.s.shape[2] / (self.spread**2 * self.size) if not self.exact else 0.0
        C = cholesky(G + q * np.diag(precision), lower=True, check_finite=False)
        mean = np.zeros((K, self.n))
        mean[:, n:] = 0.0 if self.exact else self.s_hat.reshape(K, -1)
        theta = self.theta = cho_solve((C, True), (r + q * precision * mean).T, check_finite=False).T
        residual = ee - 2 * np.sum(theta * r, axis=1) + np.sum(theta @ G * theta, axis=1)
        # The noise, with the earlier estimate counting as n samples: a short record leaves little noise by chance.
        self.q = np.maximum((residual + self.n * self.q) / (max(count - n / 2, 0.0) + self.n), 1e-6 * ee / count)
        # Draws: theta has the covariance q (G + q prior)^-1 = q C'^-1 C^-1.
        signs = np.reshape([self.sign() for _ in range(DRAWS * self.n)], (DRAWS, self.n))
        self.draws = math.sqrt(q) * solve_triangular(C, signs.T, lower=True, trans=1, check_finite=False).T
        if not self.exact:
            self.s = theta[:, n:].reshape(self.s.shape)
        self.fits, self.doubtful = self.fits + 1, False

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
        samples = [(1.0, self.p[k], self.s[k]) for k in range(K)]
        if not self.exact:
            share = K / DRAWS  # draws are of the mean noise
            samples += [(share, *self.parts(draw)) for draw in self.draws]
        for weight, p, s in samples:
            for j in range(J):
                for a in range(J):
                    ss[j, a] += weight * np.correlate(s[j], s[a], "full")
                for i in range(I):
                    ps[i, j] += weight * np.correlate(p[i], s[j], "full")
        if not self.exact and self.doubtful:  # not yet verified: anything may be wrong, even the polarity
            ss[range(J), range(J), M - 1] += K * UNKNOWN**2 * self.size
        return ss, ps


@dataclass(kw_only=True)
class PowerBudget(Controller):
    """KF-PB; `w` is the control filter."""

    HOLD: ClassVar[float] = 1.0  # 0: the price that is held falls at once

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
        self.g = math.exp(-1 / (self.averaging_s * self.fs))  # of the window of the references, a sample
        self.plant = Plant(self.s_hat, I, N, B, self.spread, self.g ** (B / 2))  # which remembers twice as long
        self.blocks = max(round(self.averaging_s * self.fs / B), SHORTEST)  # over which the power is averaged
        history = self.lags + B
        self.x_past, self.y_past = np.zeros((I, history)), np.zeros((J, history))
        self.new = []  # samples of this block: x, y, e, asked^2, or None while silent
        self.heard = 0  # samples that the delay lines hold
        self.R = np.zeros((I, I, self.lags))  # windowed sums of x_i(t) x_i'(t - l)
        self.short = np.zeros((len(SCALES), I, I, L))
        self.weights = np.zeros(1 + len(SCALES))
        self.book = np.ones(
            (self.blocks, J)
        )  # power of each block over the rating, newest first; spent before the start
        self.set_room()
        self.price, self.steady_price, self.held_price = np.zeros(J), np.zeros(J), np.zeros(J)
        self.alarms = 0

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
            self.alarms += self.plant.learn(
                self.x_past, self.y_past, e, self.heard / B * (1 - self.plant.forget) >= KNOWN
            )
        self.heard += B
        if self.plant.fits:
            self.solve()

    def set_room(self):
        """Set what each loudspeaker may spend in the next block, whatever its filter asks for."""
        left = np.maximum(MOST * self.blocks - np.sum(self.book, axis=0), 0.0)
        self.room, self.sum = left * self.B * self.rated_power, np.zeros(len(left))

    def take_references(self):
        """Add the block to the windows of the references; x is zero before the first, so they are positive definite."""
        B, n = self.B, self.lags
        short = [(c, R, self.w.shape[2]) for c, R in zip(SCALES, self.short, strict=True)]
        for scale, R, lags in [(WINDOW, self.R, n), *short]:
            g = self.g**scale
            window = g ** np.arange(B - 1, -1, -1.0)
            R *= g**B
            for i, u in enumerate(self.x_past):
                for a, v in enumerate(self.x_past):
                    R[i, a] += lagged(v, window * u[-B:], lags)
        for c, scale in enumerate((WINDOW, *SCALES)):
            g = self.g**scale
            self.weights[c] = g**B * self.weights[c] + np.sum(g ** np.arange(B))

    def solve(self):
        """Give each loudspeaker in turn the filter of least expected error at its price, given the others'."""
        (J, I, L), M, N = self.w.shape, self.s_hat.shape[2], self.N  # noqa: E741
        R = self.R / self.weights[0] * self.g ** (WINDOW / 2 * np.arange(self.lags))
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
        # 1 The price at which the filter spends the rating over the window of x. 2 It falls slowly only.
        self.steady_price[j], _, _ = system.price_of(rho, self.steady_price[j])
        self.held_price[j] = max(self.steady_price[j], self.HOLD * self.held_price[j] * self.plant.forget)
        # 3 What the account holds makes power cheaper, but none that saves little of the noise.
        price = max(
            self.held_price[j] * (1.0 - ACCOUNT / 16 * max(left, 0.0)) ** 16,
            WORTHWHILE * np.sum(self.plant.q) / (rho * len(self.rated_power)),
        )
        v, power = system.at(price)
        # 4 The account must stand it if the last t goes on for twice as long, for every t.
        share = self.share(j, v, power) if power > 0 else 1.0
        if share < 1.0:
            price, v, _ = system.price_of(share * power, price)
        self.price[j], self.w[j] = price, v

    def share(self, j, v, power):
        """Return the largest share of its power that the account of loudspeaker j stands, for a filter v, (I, L), and its power."""
        spent = np.concatenate([[0.0], np.cumsum(self.book[:, j])])
        T, L = self.blocks, v.shape[1]
        y = sum(filtered(h, u, self.B) for h, u in zip(v, self.x_past, strict=True))
        expected = [(np.mean(y**2), T // SHORTEST), (power, round(TWICE * T / WINDOW))]  # power, for how many blocks
        taper = self.g ** (np.arange(L) / 2)
        for scale, R, weight in zip(SCALES, self.short, self.weights[1:], strict=True):
            power = 0.0
            for i in range(len(v)):
                for a in range(len(v)):
                    # E[y^2] = sum_l (v_i ~ v_a)(l) C_ia(l), with both signs of l in the two orders of i and a
                    C = taper**scale * R[i, a] / weight
                    h = np.correlate(v[a], v[i], "full")[L - 1 :]  # sum_m v_a(m + l) v_i(m)
                    power += h @ C + h[1:] @ C[1:] if i == a else 2 * (h[1:] @ C[1:]) + h[0] * C[0]
            expected.append((power, max(round(TWICE * T / scale), T // SHORTEST)))
        rho = self.rated_power[j]
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
