"""Inverse kinematics of UR's arms from their DH parameters (Hawkins 2013, "Analytic inverse kinematics for
the Universal Robots UR-5/UR-10 arms"; Andersen 2018), apart from any product of exponentials."""

import numpy as np

from . import ik_planar

D1, A2, A3, D4, D5, D6 = 0.089159, -0.425, -0.39225, 0.10915, 0.09465, 0.0823


def _link(theta, a, d, alpha):
    c, s, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
    return np.array(
        [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1.0]]
    )


def angles(T):
    """All joint angles (k, 6) in (-pi, pi] that give the flange the pose T (4, 4); k is at most 8."""
    out = []
    wrist = T @ [0, 0, -D6, 1]
    far = np.hypot(*wrist[:2])
    if far < D4:
        return np.zeros((0, 6))
    for sign in (1, -1):
        one = np.arctan2(wrist[1], wrist[0]) + sign * np.arccos(D4 / far) + np.pi / 2
        s1, c1 = np.sin(one), np.cos(one)
        cosine = (T[0, 3] * s1 - T[1, 3] * c1 - D4) / D6
        if abs(cosine) > 1:
            continue
        for five in (np.arccos(cosine), -np.arccos(cosine)):
            back = np.linalg.inv(T)
            s5 = np.sin(five)
            six = np.arctan2(
                (-back[1, 0] * s1 + back[1, 1] * c1) / s5, (back[0, 0] * s1 - back[0, 1] * c1) / s5
            )
            first, last = _link(one, 0, D1, np.pi / 2), _link(five, 0, D5, -np.pi / 2) @ _link(six, 0, D6, 0)
            M = np.linalg.inv(first) @ T @ np.linalg.inv(last)  # joints 2, 3, 4: planar
            if not abs(A2) - abs(A3) < np.hypot(*M[:2, 3]) < abs(A2) + abs(A3):
                continue
            total = np.arctan2(M[1, 0], M[0, 0])
            for two, three in ik_planar.two_links((abs(A2), abs(A3)), -M[:2, 3]):
                out.append([one, two, three, total - two - three, five, six])
    return ik_planar.wrap(np.array(out).reshape(-1, 6))
