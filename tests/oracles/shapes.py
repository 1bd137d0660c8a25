"""Little files of known geometry."""

import struct

import numpy as np


def tetrahedron() -> bytes:
    """Binary STL of a tetrahedron with unit legs."""
    p = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype="<f4")
    faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
    triangles = b"".join(bytes(12) + p[list(face)].tobytes() + bytes(2) for face in faces)
    return bytes(80) + struct.pack("<I", len(faces)) + triangles
