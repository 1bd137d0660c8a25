"""Ten motions that integrators find hard, each with a value known from a closed form or to 25 digits.

Chaotic, nearly separatrix, stiff, fast beside slow, tumbling, spinning, driven: solve the kind, not the case.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import mujoco
import numpy as np
from numpy.typing import NDArray

from .work_precision import Case, Motion

Array = NDArray[np.float64]

_POINT = "1e-14 1e-14 1e-14"
"""Inertia [kg*m^2] of what stands for a point mass: MuJoCo wants some."""


@dataclass(frozen=True, eq=False)
class HardCase:
    """A motion whose end is known.

    Attributes:
        name: of the case.
        why: what makes it hard.
        body: MJCF of the worldbody's contents; gravity is 9.81 along -z unless `weightless`.
        q, v: initial state.
        duration: [s].
        observe: what is known at the end: "qpos", "qvel", or "com", the place of the first body's mass.
        expected: its value.
        scale: what an error is measured by, one or for each component; small oscillations by their amplitude.
        source: of the value.
    """

    name: str
    why: str
    body: str
    q: tuple[float, ...]
    v: tuple[float, ...]
    duration: float
    observe: Literal["qpos", "qvel", "com"]
    expected: tuple[float, ...]
    source: str
    scale: float | tuple[float, ...] = 1.0
    weightless: bool = False

    def case(self) -> Case:
        """The motion, ready to be integrated."""
        gravity = "0 0 0" if self.weightless else "0 0 -9.81"
        xml = f'<mujoco><option gravity="{gravity}"/><worldbody>{self.body}</worldbody></mujoco>'
        model = mujoco.MjModel.from_xml_string(xml)
        return Case(
            self.name,
            model,
            np.array(self.q),
            np.array(self.v),
            self.duration,
            scale=float(np.min(self.scale)),
        )

    def error(self, motion: Motion, model: mujoco.MjModel) -> float:
        """Largest difference to the expected value over `scale`; NaN where the end was not reached."""
        return self._apart(self._observed(motion, model), np.array(self.expected))

    def apart(self, motion: Motion, other: Motion, model: mujoco.MjModel) -> float:
        """As `error`, between two motions."""
        return self._apart(self._observed(motion, model), self._observed(other, model))

    def _apart(self, value: Array, other: Array) -> float:
        return float(np.max(np.abs(value - other) / np.array(self.scale)))

    def _observed(self, motion: Motion, model: mujoco.MjModel) -> Array:
        """What is known at the end; NaN where the end was not reached."""
        if not motion.finite:
            return np.full(len(self.expected), np.nan)
        if self.observe == "com":
            data = mujoco.MjData(model)
            data.qpos[:] = motion.q[-1]
            mujoco.mj_kinematics(model, data)
            return np.array(data.xipos[1])
        value: Array = motion.q[-1] if self.observe == "qpos" else motion.v[-1]
        return value


def _mass(mass: float, *, x: float = 0.0, z: float = -1.0, inertia: str = _POINT) -> str:
    return f'<inertial pos="{x} 0 {z}" mass="{mass}" diaginertia="{inertia}"/>'


def _chain(masses: tuple[float, ...], length: float) -> str:
    """Point masses on massless links, hinged about y; angles count from the link before."""
    body = ""
    for i, mass in reversed(list(enumerate(masses))):
        place = "0 0 0" if i == 0 else f"0 0 {-length}"
        body = f'<body pos="{place}"><joint axis="0 -1 0"/>{_mass(mass, z=-length)}{body}</body>'
    return body


_PENDULUM = _chain((1.0,), 1.0)

HARD_CASES = (
    HardCase(
        name="pendulum from 179 deg",
        why="it lingers at the top, where an error grows by exp(3.1 t)",
        body=_PENDULUM,
        q=(float(np.deg2rad(179)),),
        v=(0.0,),
        duration=9.78224604692211,  # 5/4 of the period
        observe="qpos",
        expected=(0.0,),
        source="period 4 sqrt(l/g) K(sin^2(179 deg / 2)) = 7.82579683753768270 s",
    ),
    HardCase(
        name="pendulum for 100 s",
        why="errors of phase add up over 42 swings (IFToMM A01)",
        body=_PENDULUM,
        q=(float(np.pi / 2),),
        v=(0.0,),
        duration=100.0,
        observe="qpos",
        expected=(0.18252514849577356,),
        source="theta = 2 asin(k sn(K - w t)), k^2 = 1/2",
    ),
    HardCase(
        name="double pendulum for 10 s",
        why="large swings that magnify errors",
        body=_chain((1.0, 1.0), 1.0),
        q=(float(2 * np.pi / 3), float(-np.pi / 6)),
        v=(0.0, 0.0),
        duration=10.0,
        observe="qpos",
        expected=(2.08106218774202913, 1.55596628109551428 - 2.08106218774202913),
        source="25-digit arithmetic",
    ),
    HardCase(
        name="tumbling body",
        why="started beside its unstable axis",
        body='<body><joint type="ball"/>'
        + _mass(1.0, z=0.0, inertia="0.80833333 0.68333333 0.14166667")
        + "</body>",
        q=(1.0, 0.0, 0.0, 0.0),
        v=(0.1, 5.0, 0.1),
        duration=10.0,
        observe="qvel",
        expected=(2.75583887620128821, -3.73596515670833006, -3.16180722449863095),
        source="Jacobi's elliptic functions",
        weightless=True,
    ),
    HardCase(
        name="heavy top",
        why="150 rad/s of spin under a slow precession that passes the pole",
        body='<body><joint type="ball"/>'
        '<inertial pos="0 1 0" mass="15" diaginertia="0.234375 0.46875 0.234375"/></body>',
        q=(1.0, 0.0, 0.0, 0.0),
        v=(0.0, 150.0, -4.61538),
        duration=2.0,
        observe="com",
        expected=(-0.15041682274564176, -0.72416559163689565, -0.67302226956044410),
        source="O. Bruels, A. Cardona, M. Arnold 2012; elliptic integrals of the third kind",
    ),
    HardCase(
        name="spherical pendulum",
        why="a quaternion with no preferred axis: nutation and precession of a swing in space",
        body='<body><joint type="ball"/>' + _mass(1 / 0.9, z=-0.9, inertia="0.1 0.1 0.1") + "</body>",
        q=(float(np.cos(np.pi / 6)), 0.0, float(-np.sin(np.pi / 6)), 0.0),
        v=(1.5 * float(np.sqrt(3)), 0.0, 0.0),
        duration=5.0,
        observe="com",
        expected=(0.477700468412039, 0.4102286617921106, -0.6430510924671325),
        source="elliptic integrals of the third kind",
    ),
    HardCase(
        name="stiff servo",
        why="kp = 1e6 N/m, kd = 2000 N s/m: explicit steps above 2.8 ms diverge",
        body='<body><joint type="slide" axis="1 0 0" stiffness="1e6" damping="2000"/>'
        + _mass(1.0, z=0.0)
        + "</body>",
        q=(1.0,),
        v=(0.0,),
        duration=0.01,
        observe="qpos",
        expected=(11 * float(np.exp(-10)),),
        source="(1 + 1000 t) exp(-1000 t)",
        weightless=True,
    ),
    HardCase(
        name="heavy tip",
        why="a mass ratio of 1e4: 443 rad/s beside 2.2 rad/s, neither damped",
        body=_chain((1.0, 1e4), 1.0),
        q=(2e-8, -2e-8),
        v=(0.0, 0.0),
        duration=3.0,
        observe="qpos",
        expected=(-6.4432086884856848e-10, 2.0000009842499693e-8),
        source="modes of 2.21475114152112656 and 442.961301783102867 rad/s",
        scale=2e-8,
    ),
    HardCase(
        name="hanging chain",
        why="ten masses in their lowest mode for ten half periods, beside modes 11 times as fast",
        body=_chain((1.0,) * 10, 0.1),
        q=(
            -6.683872958348272e-9,
            -6.4031987852951889e-10,
            -6.7424660442425361e-10,
            -7.0944095861333093e-10,
            -7.4593976792512947e-10,
            -7.8378073693669251e-10,
            -8.2300246573560494e-10,
            -8.6364446799439922e-10,
            -9.0574718936236219e-10,
            -9.4935202617967759e-10,
        ),
        v=(0.0,) * 10,
        duration=8.544783229350861,
        observe="qpos",
        expected=(
            -6.683872958348272e-9,
            -6.4031987852951889e-10,
            -6.7424660442425361e-10,
            -7.0944095861333093e-10,
            -7.4593976792512947e-10,
            -7.8378073693669251e-10,
            -8.2300246573560494e-10,
            -8.6364446799439922e-10,
            -9.0574718936236219e-10,
            -9.4935202617967759e-10,
        ),
        source="zeros of the Laguerre polynomial L_10: 3.67662065761784941 rad/s",
        scale=1e-8,
    ),
    HardCase(
        name="Kapitza's pendulum",
        why="upright on a pivot that shakes at 100 rad/s, a little above the 88.6 rad/s that keep it up",
        # The pivot is a mass of 1e12 kg, with that of the pendulum, on a spring: nothing can disturb it.
        body='<body gravcomp="1"><joint type="slide" axis="0 0 1" stiffness="1e16"/>'
        '<inertial pos="0 0 0" mass="999999999999" diaginertia="1 1 1"/>'
        '<body><joint axis="0 1 0"/>' + _mass(1.0, z=1.0) + "</body></body>",
        q=(0.05, 1e-8),
        v=(0.0, 0.0),
        duration=2.0,
        observe="qpos",
        expected=(0.05 * float(np.cos(200.0)), -0.96560388223195938e-8),
        source="Mathieu's equation in 25 digits",
        scale=(0.05, 1e-8),
    ),
)
"""The suite; `tests/test_hard_cases.py` derives every value anew."""
