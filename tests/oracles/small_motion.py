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


def shaken_upright(
    t: float, *, frequency: float, amplitude: float, g: float = 9.81, length: float = 1.0
) -> float:
    """Linear motion of a pendulum beside upright, released at 1, its pivot at amplitude cos(frequency t).

    phi'' = (g - amplitude frequency^2 cos(frequency t)) / length phi, by Taylor series in 30 digits.
    """
    steps = max(1, round(t * frequency))
    with mp.workdps(30):
        h, w = mp.mpf(t) / steps, mp.mpf(frequency)
        drive = mp.mpf(amplitude) * w * w
        position, speed = mp.mpf(1), mp.mpf(0)
        for n in range(steps):
            stiffness = [
                -drive * w**k * mp.cos(w * n * h + k * mp.pi / 2) / mp.factorial(k) for k in range(31)
            ]
            stiffness[0] += mp.mpf(g)
            y = [position, speed]
            for k in range(29):
                force = mp.fdot(stiffness[: k + 1], y[k::-1]) / length
                y.append(force / ((k + 1) * (k + 2)))
            position = mp.polyval(y[::-1], h)
            speed = mp.polyval([k * y[k] for k in range(30, 0, -1)], h)
        return float(position)


def double_pendulum_modes(tip: float, *, g: float = 9.81) -> tuple[np.ndarray, np.ndarray]:
    """Small oscillations of masses 1 and `tip` on links of length 1: frequencies (2,) and modes in columns.

    In angles from down M = [[1 + tip, tip], [tip, tip]] and K = g diag(1 + tip, tip). Modes have a
    first angle of 1.
    """
    with mp.workdps(40):
        m, total = mp.mpf(tip), 1 + mp.mpf(tip)
        g = mp.mpf(g)
        a, b, c = total * m - m * m, -2 * g * total * m, g * g * total * m
        root = mp.sqrt(b * b - 4 * a * c)
        squares = [(-b - root) / (2 * a), (-b + root) / (2 * a)]
        second = [total * (g - s) / (s * m) for s in squares]
        modes = np.array([[1.0, 1.0], [float(x) for x in second]])
        return np.array([float(mp.sqrt(s)) for s in squares]), modes


def chain_mode(n: int) -> np.ndarray:
    """Displacements in the lowest mode of a hanging chain, top to bottom, 1 at the bottom: L_k(x)."""
    with mp.workdps(40):
        zeros = mp.polyroots(
            mp.taylor(lambda x: mp.laguerre(n, 0, x), 0, n)[::-1], maxsteps=500, extraprec=400
        )
        x = min(mp.re(z) for z in zeros)
        return np.array([float(mp.laguerre(k, 0, x)) for k in range(n)])[::-1]
