"""Where a light looks from when its shadow map is drawn: a view fitted to what can cast a shadow."""

import numpy as np
from numpy.typing import NDArray

from .cameras import look_at
from .lights import LitNow

Floats = NDArray[np.floating]

_WIDEST = float(np.deg2rad(120.0))  # of a perspective map; wider ones waste their texels on the rim
_TO_TEXTURE = np.array([[0.5, 0, 0, 0.5], [0, 0.5, 0, 0.5], [0, 0, 0.5, 0.5], [0, 0, 0, 1]])


def shadow_view(light: LitNow, centers: Floats, radii: Floats, *, size: int) -> tuple[Floats, Floats, float]:
    """View-projection (4, 4), the same to texture coordinates (4, 4), and the width in metres of a texel.

    `centers` (n, 3) and `radii` (n,) bound the casters by spheres. A directional map is square, grows in
    steps of a quarter and moves in whole texels, so that shadows do not shimmer as the casters move.
    """
    low, high = (centers - radii[:, None]).min(axis=0), (centers + radii[:, None]).max(axis=0)
    middle = (low + high) / 2
    if light.kind == "directional":
        X_WL = look_at(middle - light.direction, middle)
        in_light = (centers - middle) @ X_WL[:3, :3]
        reach = float((np.abs(in_light[:, :2]) + radii[:, None]).max())
        half = 1.25 ** np.ceil(np.log(max(reach, 1e-6)) / np.log(1.25))
        texel = 2 * half / size
        anchor = X_WL[:3, :3].T @ middle
        anchor[:2] = np.round(anchor[:2] / texel) * texel
        X_WL[:3, 3] = X_WL[:3, :3] @ anchor
        depth = (centers - X_WL[:3, 3]) @ X_WL[:3, 2]
        near, far = -float((depth + radii).max()), -float((depth - radii).min())
        P = orthographic(half, near, far)
    else:
        aim = light.direction if light.kind == "spot" else middle - light.position
        if not np.any(aim):
            aim = np.array([0.0, 0.0, -1.0])
        X_WL = look_at(light.position, light.position + aim)
        away = -(centers - light.position) @ X_WL[:3, 2]
        distance = float(np.linalg.norm(middle - light.position))
        bound = float((np.linalg.norm(centers - middle, axis=1) + radii).max())
        if light.kind == "spot":
            angle = 2 * float(np.arccos(light.cos_cutoff)) * 1.02
        else:
            angle = 2 * float(np.arcsin(min(bound / max(distance, 1e-9), 1.0))) * 1.02
        angle = min(angle, _WIDEST)
        far = max(float((away + radii).max()), 1e-3)
        near = max(float((away - radii).min()), far * 1e-2)
        P = perspective(angle, 1.0, near, far)
        texel = 2 * np.tan(angle / 2) * max(distance, near) / size
    VP = P @ inverse(X_WL)
    return VP, _TO_TEXTURE @ VP, float(texel)


def perspective(fovy: float, aspect: float, near: float, far: float) -> Floats:
    """OpenGL's perspective matrix; `fovy` full vertical angle (rad), `aspect` width over height."""
    f = 1 / np.tan(fovy / 2)
    P = np.zeros((4, 4))
    P[0, 0], P[1, 1] = f / aspect, f
    P[2, 2], P[2, 3] = (far + near) / (near - far), 2 * far * near / (near - far)
    P[3, 2] = -1
    return P


def orthographic(half: float, near: float, far: float) -> Floats:
    """OpenGL's orthographic matrix of a square of half side `half`."""
    P = np.diag([1 / half, 1 / half, -2 / (far - near), 1.0])
    P[2, 3] = -(far + near) / (far - near)
    return P


def inverse(X_WC: Floats) -> Floats:
    """Inverse of a rigid pose (4, 4)."""
    X_CW = np.eye(4)
    X_CW[:3, :3] = X_WC[:3, :3].T
    X_CW[:3, 3] = -X_WC[:3, :3].T @ X_WC[:3, 3]
    return X_CW
