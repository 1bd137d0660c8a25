"""Linear motions in closed form: hanging chain, driven upright pendulum, stiff servo; and a bouncing ball."""

import mpmath as mp
import numpy as np
from scipy.special import mathieu_a


def hanging_chain_modes(n: int, *, g: float = 9.81, length: float = 1.0) -> np.ndarray:
    """Angular frequencies [rad/s] of n equal point masses at equal distances on a massless string, ascending.

    The squares are g n / length times the zeros of the Laguerre polynomial L_n (D. Bernoulli, 1738).
    """
    with mp.workdps(40):
        zeros = mp.polyroots(
            mp.taylor(lambda x: mp.laguerre(n, 0, x), 0, n)[::-1], maxsteps=500, extraprec=400
        )
        return np.array(sorted(float(mp.sqrt(mp.mpf(g) * n / length * mp.re(z))) for z in zeros))


def kapitza_threshold(amplitude: float, *, g: float = 9.81, length: float = 1.0) -> float:
    """Angular frequency [rad/s] above which a pendulum stays upright on a pivot that moves as a cos(W t).

    phi'' = (g/l - a W^2 / l cos W t) phi is Mathieu's equation with a_M = -4 g / (l W^2) and q = 2 a / l; it
    becomes stable where a_M crosses the characteristic value a_0(q).
    """
    return float(np.sqrt(-4 * g / (length * mathieu_a(0, 2 * amplitude / length))))


def servo(t: np.ndarray, *, kp: float, kd: float, mass: float = 1.0, x0: float = 1.0) -> np.ndarray:
    """Position and velocity of mass * x'' = -kp x - kd x' released at x0, shape (len(t), 2)."""
    with mp.workdps(40):
        disc = mp.mpf(kd) ** 2 - 4 * mp.mpf(mass) * kp
        rows = []
        for time in np.atleast_1d(t):
            s = mp.mpf(float(time))
            if disc == 0:
                r = mp.mpf(kd) / (2 * mass)
                x, v = x0 * (1 + r * s) * mp.exp(-r * s), -x0 * r * r * s * mp.exp(-r * s)
            else:
                root = mp.sqrt(mp.mpc(disc))
                p, q = (-kd + root) / (2 * mass), (-kd - root) / (2 * mass)
                x = mp.re(x0 * (p * mp.exp(q * s) - q * mp.exp(p * s)) / (p - q))
                v = mp.re(x0 * p * q * (mp.exp(q * s) - mp.exp(p * s)) / (p - q))
            rows.append((float(x), float(v)))
        return np.array(rows)


def bounce_times(count: int, *, height: float, restitution: float, g: float = 9.81) -> np.ndarray:
    """Times of the first `count` bounces of a ball dropped from `height` [m]."""
    first = np.sqrt(2 * height / g)
    flights = 2 * first * restitution ** np.arange(1, count)
    return first + np.concatenate([[0.0], np.cumsum(flights)])


def rest_time(*, height: float, restitution: float, g: float = 9.81) -> float:
    """Time at which such a ball comes to rest after infinitely many bounces."""
    return float(np.sqrt(2 * height / g) * (1 + restitution) / (1 - restitution))
