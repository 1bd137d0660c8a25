"""Planar pendulum in closed form, by Jacobi's elliptic functions (Landau & Lifshitz, Mechanics, par. 11)."""

import mpmath as mp
import numpy as np


def period(amplitude: float, *, g_over_l: float = 9.81) -> float:
    """Period of a swing of given amplitude [rad]: 4 sqrt(l/g) K(sin^2(amplitude / 2))."""
    with mp.workdps(30):
        k = mp.sin(mp.mpf(amplitude) / 2)
        return float(4 * mp.ellipk(k**2) / mp.sqrt(mp.mpf(g_over_l)))


def swing(t: np.ndarray, amplitude: float, *, g_over_l: float = 9.81) -> np.ndarray:
    """Angle from down and its rate, released from rest at `amplitude`; shape (len(t), 2).

    theta = 2 asin(k sn(u | k^2)), theta' = -2 k w cn(u | k^2) with k = sin(amplitude / 2), w = sqrt(g/l) and
    u = K - w t.
    """
    with mp.workdps(30):
        k, w = mp.sin(mp.mpf(amplitude) / 2), mp.sqrt(mp.mpf(g_over_l))
        m = k * k
        quarter = mp.ellipk(m)
        rows = []
        for time in np.atleast_1d(t):
            # Whole periods first: the theta series behind sn and cn loses digits far out.
            u = mp.fmod(quarter - w * mp.mpf(float(time)), 4 * quarter)
            angle = 2 * mp.asin(k * mp.ellipfun("sn", u, m=m))
            rows.append((float(angle), float(-2 * k * w * mp.ellipfun("cn", u, m=m))))
        return np.array(rows)


def rotation(t: np.ndarray, rate: float, *, g_over_l: float = 9.81) -> np.ndarray:
    """Angle from down and its rate for a pendulum that turns over, started at the bottom; shape (len(t), 2).

    With k = 2 w / rate < 1: theta = 2 am(rate t / 2 | k^2), theta' = rate dn(rate t / 2 | k^2).
    """
    with mp.workdps(30):
        m = 4 * mp.mpf(g_over_l) / mp.mpf(rate) ** 2
        assert m < 1, "too slow to turn over"
        quarter = mp.ellipk(m)
        rows = []
        for time in np.atleast_1d(t):
            u = mp.mpf(rate) * mp.mpf(float(time)) / 2
            turns = mp.nint(u / (2 * quarter))
            rest = u - turns * 2 * quarter
            amplitude = mp.asin(mp.ellipfun("sn", rest, m=m)) + turns * mp.pi
            rows.append((float(2 * amplitude), float(rate * mp.ellipfun("dn", rest, m=m))))
        return np.array(rows)
