"""Rigid bodies that rotate: free of torque, and the symmetric top under gravity, in closed form.

Source: Landau & Lifshitz, Mechanics, par. 37 and 35, with u = cos(theta) of the top.
"""

import mpmath as mp
import numpy as np


class FreeBody:
    """Torque-free rotation about the centre of mass, principal moments `inertia` > 0, all different.

    Rates are in the body's principal axes, `omega` at t = 0; the attitude starts as the identity.
    """

    def __init__(self, inertia: np.ndarray, omega: np.ndarray) -> None:
        with mp.workdps(30):
            moments, rates = [mp.mpf(float(x)) for x in inertia], [mp.mpf(float(x)) for x in omega]
            self.L2 = sum((i * w) ** 2 for i, w in zip(moments, rates, strict=True))
            self.E2 = sum(i * w * w for i, w in zip(moments, rates, strict=True))
            # Axis c keeps its sign: the largest moment's or the smallest's, by the side of the separatrix.
            order = sorted(range(3), key=lambda j: moments[j])
            if self.E2 * moments[order[1]] > self.L2:
                order.reverse()
            self.axes = order
            a, b, c = (moments[j] for j in order)
            self.I = (a, b, c)
            self.amplitude = (
                mp.sqrt((self.E2 * c - self.L2) / (a * (c - a))),
                mp.sqrt((self.E2 * c - self.L2) / (b * (c - b))),
                mp.sqrt((self.L2 - self.E2 * a) / (c * (c - a))),
            )
            self.rate = mp.sqrt((c - b) * (self.L2 - self.E2 * a) / (a * b * c))
            self.m = (b - a) * (self.E2 * c - self.L2) / ((c - b) * (self.L2 - self.E2 * a))
            wa, wb, wc = (rates[j] for j in order)
            self.sign_c = mp.sign(wc)
            # wa = A cn, wb = s B sn, wc = sign_c C dn; the sense s follows from a wa' = (b - c) wb wc.
            handed = 1 if (order[1] - order[0]) % 3 == 1 else -1
            self.sense = mp.sign(handed * (c - b)) * self.sign_c
            cn, sn = wa / self.amplitude[0], self.sense * wb / self.amplitude[1]
            self.phase = mp.ellipf(mp.atan2(sn, cn), self.m)
        self.period = float(4 * mp.ellipk(self.m) / self.rate)

    def _omega(self, t: mp.mpf) -> list[mp.mpf]:
        u = self.rate * t + self.phase
        u -= mp.nint(u / (4 * mp.ellipk(self.m))) * 4 * mp.ellipk(self.m)
        sn, cn, dn = (mp.ellipfun(name, u, m=self.m) for name in ("sn", "cn", "dn"))
        values = [mp.mpf(0)] * 3
        signed = (cn, self.sense * sn, self.sign_c * dn)
        for axis, amplitude, shape in zip(self.axes, self.amplitude, signed, strict=True):
            values[axis] = amplitude * shape
        return values

    def omega(self, t: np.ndarray) -> np.ndarray:
        """Angular velocity in the body's axes, shape (len(t), 3)."""
        with mp.workdps(30):
            return np.array([[float(w) for w in self._omega(mp.mpf(float(x)))] for x in np.atleast_1d(t)])

    def attitude(self, t: float) -> np.ndarray:
        """Rotation R(t) from body to world, R(0) = 1.

        The body's axis c nutates about the fixed angular momentum, and turns about it at
        phi' = |L| (a wa^2 + b wb^2) / (a^2 wa^2 + b^2 wb^2).
        """
        with mp.workdps(25):
            angle = mp.quad(self._precession, mp.linspace(0, mp.mpf(t), 2 + int(8 * abs(t) / self.period)))
            start, end = self._frame(mp.mpf(0)), self._frame(mp.mpf(t))
            c, s = mp.cos(angle), mp.sin(angle)
            turn = mp.matrix([[c, -s, 0], [s, c, 0], [0, 0, 1]])
            R = start.T * turn * end
            return np.array([[float(R[i, j]) for j in range(3)] for i in range(3)])

    def _precession(self, t: mp.mpf) -> mp.mpf:
        w = self._omega(t)
        wa, wb = w[self.axes[0]], w[self.axes[1]]
        a, b, _ = self.I
        return mp.sqrt(self.L2) * (a * wa**2 + b * wb**2) / (a * a * wa**2 + b * b * wb**2)

    def _frame(self, t: mp.mpf) -> mp.matrix:
        """Rows, in body axes: the nodes of axis c, a third axis, the direction of the angular momentum."""
        w = self._omega(t)
        by_axis = dict(zip(self.axes, self.I, strict=True))
        z = mp.matrix([by_axis[j] * w[j] for j in range(3)]) / mp.sqrt(self.L2)
        axis_c = mp.matrix([1 if j == self.axes[2] else 0 for j in range(3)])
        x = _cross(axis_c, z)
        x /= mp.norm(x)
        y = _cross(z, x)
        return mp.matrix([list(x), list(y), list(z)])


def _cross(a: mp.matrix, b: mp.matrix) -> mp.matrix:
    return mp.matrix([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


class Top:
    """Axis of a symmetric top that turns about a fixed point under gravity along -z.

    A spherical pendulum is the top without spin (`spin_momentum` = 0, `inertia` = m l^2, `mgl` = m g l).

    Attributes:
        inertia: moment about a line through the pivot across the axis [kg*m^2].
        spin_momentum: moment about the axis times the spin [N*m*s].
        mgl: weight times the distance of the centre of mass [N*m].
        axis, axis_rate: unit vector from the pivot to the centre of mass and its rate at t = 0, in the world.
    """

    def __init__(
        self, inertia: float, spin_momentum: float, mgl: float, axis: np.ndarray, axis_rate: np.ndarray
    ) -> None:
        with mp.workdps(30):
            n, dn = (mp.matrix([mp.mpf(float(x)) for x in vector]) for vector in (axis, axis_rate))
            # Exactly unit and orthogonal: at a turning point the phase feels the square root of an error.
            n /= mp.norm(n)
            dn -= mp.fdot(n, dn) * n
            self.I, self.S, self.mgl = mp.mpf(inertia), mp.mpf(spin_momentum), mp.mpf(mgl)
            self.L = self.I * _cross(n, dn)[2] + self.S * n[2]
            energy = self.I / 2 * mp.fdot(dn, dn) + self.mgl * n[2]
            J, S, L, w = self.I, self.S, self.L, self.mgl
            # J^2 u'^2 = 2 J (E - w u)(1 - u^2) - (L - S u)^2
            cubic = [2 * J * w, -2 * J * energy - S * S, -2 * J * w + 2 * L * S, 2 * J * energy - L * L]
            self.roots = sorted(mp.re(r) for r in mp.polyroots(cubic, maxsteps=200, extraprec=200))
            low, mid, high = self.roots
            self.m = (mid - low) / (high - low)
            self.rate = mp.sqrt(w * (high - low) / (2 * J))
            sn = mp.sqrt(min(max((n[2] - low) / (mid - low), mp.mpf(0)), mp.mpf(1)))
            rising = 1 if dn[2] >= 0 else -1
            self.phase = rising * mp.ellipf(mp.asin(sn), self.m)
            self.azimuth0 = mp.atan2(n[1], n[0])
            self.nutation_period = float(2 * mp.ellipk(self.m) / self.rate)

    def _height(self, t: mp.mpf) -> mp.mpf:
        low, mid, _ = self.roots
        u = self.rate * t + self.phase
        u -= mp.nint(u / (2 * mp.ellipk(self.m))) * 2 * mp.ellipk(self.m)
        return low + (mid - low) * mp.ellipfun("sn", u, m=self.m) ** 2

    def azimuth(self, t: float) -> float:
        """Azimuth of the axis since t = 0 [rad].

        phi' = (L - S u) / (I (1 - u^2)) = ((L - S) / (1 - u) + (L + S) / (1 + u)) / (2 I), each term an
        elliptic integral of the third kind.
        """
        low, mid, _ = self.roots
        with mp.workdps(30):
            angle = mp.mpf(0)
            for momentum, end, sign in ((self.L - self.S, 1 - low, 1), (self.L + self.S, 1 + low, -1)):
                n = sign * (mid - low) / end
                angle += momentum / end * (self._third_kind(n, mp.mpf(t)) - self._third_kind(n, mp.mpf(0)))
            return float(angle / (2 * self.I * self.rate))

    def _third_kind(self, n: mp.mpf, t: mp.mpf) -> mp.mpf:
        """Integral of 1 / (1 - n sn^2) over the argument u = rate t + phase, from 0."""
        u = self.rate * t + self.phase
        halves = mp.nint(u / (2 * mp.ellipk(self.m)))
        amplitude = mp.asin(mp.ellipfun("sn", u - halves * 2 * mp.ellipk(self.m), m=self.m))
        return mp.ellippi(n, amplitude, self.m) + 2 * halves * mp.ellippi(n, self.m)

    def axis(self, t: float) -> np.ndarray:
        """Unit vector along the axis at time t, in the world."""
        azimuth = float(self.azimuth0) + self.azimuth(t)
        with mp.workdps(30):
            u = self._height(mp.mpf(t))
        across = float(mp.sqrt(1 - u * u))
        return np.array([across * np.cos(azimuth), across * np.sin(azimuth), float(u)])
