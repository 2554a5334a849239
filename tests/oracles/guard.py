"""The guard against uncertain secondary paths: E[(w'x'')^2], x'' = W * x', is minimised beside E[(d - w'x')^2].

W is a filter that is large where the paths are uncertain.
"""

from __future__ import annotations

import numpy as np


def guarded_step(w, x_guarded, mu):
    """Return w after an LMS step towards w'x'' = 0; mu is the step size of all loudspeakers, or of each, (J, 1, 1)."""
    # u_k(n) = sum_ji w_ji'(n) x''_kji(n)
    # w_ji <- w_ji - mu sum_k u_k(n) x''_kji(n)
    u = np.einsum("jil,kjil->k", w, x_guarded)
    return w - mu * np.einsum("k,kjil->jil", u, x_guarded)


def guarded_correction(correct, w, P, x_guarded, q):
    """Return w and P after a Kalman filter has observed w'x''_k = 0 at each microphone, with measurement noise q_k."""
    for k, x in enumerate(x_guarded):
        # 0 = x''_k'(n) w(n) + e_o,k(n): eq. 5-8 with d = 0
        w, P = correct(w, P, x.ravel(), 0.0, q[k])
    return w, P
