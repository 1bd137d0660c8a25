"""Batches on the graphics side: their buffers at several levels of detail, and the drawing of them."""

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from .drawing import Batch
from .shapes import Shape, levels

Floats = NDArray[np.floating]

_UNSEEN = 0.35  # of a pixel: an error that does not show


class Surface:
    """A batch in the current context; `place` sends the poses of its geoms, `draw` draws them.

    Curved geoms and meshes are kept at several levels of detail; `place` takes the coarsest whose error
    does not show. `pixel`: metres that a pixel spans in a picture as high as the model is large.
    """

    def __init__(self, batch: Batch, model: mujoco.MjModel, *, pixel: float) -> None:
        geom, count = int(batch.geoms[0]), len(batch.geoms)
        self.batch = batch
        self._reach = float(model.geom_rbound[geom])
        self._cull = not batch.ground and int(model.geom_type[geom]) != mujoco.mjtGeom.mjGEOM_HFIELD
        self._levels = [(0.0, _uploaded(batch.shape, count))]
        self._levels += [
            (error, _uploaded(shape, count)) for error, shape in levels(model, geom, batch.shape, pixel=pixel)
        ]
        self._now = self._levels[0][1]

    def place(self, X_WG: NDArray[np.float32], eye: Floats, pixel_slope: float) -> None:
        """Send poses (ngeom, 4, 4), columns first; `pixel_slope`: metres per pixel, per metre of distance.

        With a slope of 0 the exact form is drawn.
        """
        from OpenGL import GL

        poses = X_WG[self.batch.geoms]
        if len(self._levels) > 1:
            nearest = np.linalg.norm(poses[:, 3, :3] - eye, axis=1).min() - self._reach
            allowed = _UNSEEN * pixel_slope * max(float(nearest), 0.0)
            self._now = next(level for error, level in reversed(self._levels) if error <= allowed)
        # pyrender reads `Primitive.poses` once, at the upload; its second buffer is the one in use.
        GL.glBindBuffer(GL.GL_ARRAY_BUFFER, self._now._buffers[1])
        GL.glBufferSubData(GL.GL_ARRAY_BUFFER, 0, poses.nbytes, np.ascontiguousarray(poses))

    def draw(self) -> None:
        """Draw with the bound program."""
        from OpenGL import GL

        (GL.glEnable if self._cull else GL.glDisable)(GL.GL_CULL_FACE)
        GL.glBindVertexArray(self._now._vertex_array_id)
        count = self._now.indices.size
        GL.glDrawElementsInstanced(GL.GL_TRIANGLES, count, GL.GL_UNSIGNED_INT, None, len(self.batch.geoms))


def _uploaded(shape: Shape, count: int) -> Any:
    from pyrender import Primitive

    uploaded = Primitive(
        positions=shape.positions,
        normals=shape.normals,
        texcoord_0=np.zeros((len(shape.positions), 2)) if shape.uv is None else shape.uv,
        indices=shape.indices,
        poses=np.tile(np.eye(4), (count, 1, 1)),
    )
    uploaded._add_to_context()
    return uploaded
