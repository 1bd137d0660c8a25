"""The explicit Runge-Kutta methods that `solve` knows, by name, each an immutable tableau."""

from collections.abc import Iterable
from types import MappingProxyType

from ..errors import EngineError, unknown
from .dop853 import DOP853
from .tableau import Dense, Tableau, frozen, hermite, stages
from .verner98 import VERNER98

__all__ = [
    "BOSH3",
    "DOP853",
    "DOPRI5",
    "EULER",
    "HEUN",
    "RK4",
    "RK38",
    "TABLEAUS",
    "VERNER98",
    "Dense",
    "Tableau",
    "tableau_of",
]

EULER = Tableau(
    name="euler",
    A=stages([[]], 1),
    b=frozen([1.0]),
    c=frozen([0.0]),
    order=1,
    dense=hermite(frozen([1.0]), fsal=False, order=1),
    source="L. Euler, Institutiones calculi integralis (1768)",
)

_HEUN_b = frozen([1 / 2, 1 / 2])
HEUN = Tableau(
    name="heun",
    A=stages([[], [1.0]], 2),
    b=_HEUN_b,
    c=frozen([0.0, 1.0]),
    order=2,
    b_error=frozen([-1 / 2, 1 / 2]),
    error_order=1,
    error_exponent=2,
    dense=hermite(_HEUN_b, fsal=False, order=2),
    source="K. Heun, Z. Math. Phys. 45 (1900); the embedded method is Euler's",
)

_RK4_b = frozen([1 / 6, 1 / 3, 1 / 3, 1 / 6])
RK4 = Tableau(
    name="rk4",
    A=stages([[], [1 / 2], [0.0, 1 / 2], [0.0, 0.0, 1.0]], 4),
    b=_RK4_b,
    c=frozen([0.0, 1 / 2, 1 / 2, 1.0]),
    order=4,
    dense=hermite(_RK4_b, fsal=False, order=4),
    source="W. Kutta, Z. Math. Phys. 46 (1901)",
)

_RK38_b = frozen([1 / 8, 3 / 8, 3 / 8, 1 / 8])
RK38 = Tableau(
    name="rk38",
    A=stages([[], [1 / 3], [-1 / 3, 1.0], [1.0, -1.0, 1.0]], 4),
    b=_RK38_b,
    c=frozen([0.0, 1 / 3, 2 / 3, 1.0]),
    order=4,
    dense=hermite(_RK38_b, fsal=False, order=4),
    source="W. Kutta, Z. Math. Phys. 46 (1901), the 3/8 rule (what torchdiffeq calls rk4)",
)

_BOSH3_b = frozen([2 / 9, 1 / 3, 4 / 9, 0.0])
BOSH3 = Tableau(
    name="bosh3",
    A=stages([[], [1 / 2], [0.0, 3 / 4], [2 / 9, 1 / 3, 4 / 9]], 4),
    b=_BOSH3_b,
    c=frozen([0.0, 1 / 2, 3 / 4, 1.0]),
    order=3,
    b_error=frozen([2 / 9 - 7 / 24, 1 / 3 - 1 / 4, 4 / 9 - 1 / 3, -1 / 8]),
    error_order=2,
    error_exponent=3,
    fsal=True,
    dense=hermite(_BOSH3_b, fsal=True, order=3),
    source="P. Bogacki, L. F. Shampine, Appl. Math. Lett. 2 (1989) 321",
)

_DOPRI5_A = stages(
    [
        [],
        [1 / 5],
        [3 / 40, 9 / 40],
        [44 / 45, -56 / 15, 32 / 9],
        [19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729],
        [9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656],
        [35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84],
    ],
    7,
)
DOPRI5 = Tableau(
    name="dopri5",
    A=_DOPRI5_A,
    b=_DOPRI5_A[-1],
    c=frozen([0.0, 1 / 5, 3 / 10, 4 / 5, 8 / 9, 1.0, 1.0]),
    order=5,
    b_error=frozen([71 / 57600, 0.0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40]),
    error_order=4,
    error_exponent=5,
    fsal=True,
    dense=Dense(
        order=4,
        A=stages([], 7).reshape(0, 7),
        c=frozen([]),
        # L. F. Shampine, Math. Comp. 46 (1986) 135, in powers of 2 theta - 1.
        P=frozen(
            [
                [
                    6025192743 / 30085553152,
                    -9433321811 / 30085553152,
                    31166010719 / 90256659456,
                    -12715105075 / 90256659456,
                ],
                [0.0, 0.0, 0.0, 0.0],
                [
                    51252292925 / 65400821598,
                    -7181658425 / 65400821598,
                    -12187360475 / 21800273866,
                    21871869925 / 65400821598,
                ],
                [
                    -2691868925 / 45128329728,
                    46762503425 / 45128329728,
                    17382080425 / 45128329728,
                    -10690763975 / 15042776576,
                ],
                [
                    187940372067 / 1594534317056,
                    -959000193279 / 1594534317056,
                    -444960312471 / 1594534317056,
                    701980252875 / 1594534317056,
                ],
                [
                    -1776094331 / 19743644256,
                    5654310167 / 19743644256,
                    3068832943 / 19743644256,
                    -1453857185 / 6581214752,
                ],
                [11237099 / 235043384, -69997945 / 235043384, -11237099 / 235043384, 69997945 / 235043384],
            ]
        ),
    ),
    source="J. R. Dormand, P. J. Prince, J. Comput. Appl. Math. 6 (1980) 19",
)

TABLEAUS = MappingProxyType(
    {method.name: method for method in (EULER, HEUN, BOSH3, RK4, RK38, DOPRI5, DOP853, VERNER98)}
)


def tableau_of(method: str | Tableau, *, where: str, others: Iterable[str] = ()) -> Tableau:
    """The method of that name; `where` is who asks, `others` what it takes beside `TABLEAUS`.

    Raises:
        EngineError: there is none; the message lists what there is.
    """
    if isinstance(method, Tableau):
        return method
    found = TABLEAUS.get(method) if isinstance(method, str) else None
    if found is None:
        raise EngineError(unknown("method", str(method), [*TABLEAUS, *others], where=where))
    return found
