"""Pictures of a MuJoCo model without a window.

pyrender gives the context (EGL, OSMesa) and the vertex, instance and index buffers of a surface; drawing is
our own, since pyrender's general shader and per-node bookkeeping cost several times as much per frame.
"""

from collections.abc import Sequence
from types import TracebackType
from typing import Self

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import FilmError
from . import shaders
from .cameras import Camera, motion_corners
from .context import Context
from .drawing import Batch, batches
from .gl import Picture, Program, ShadowMap, upload_texture
from .lights import Light, LitNow, default_lights, model_lights
from .shadows import inverse, perspective, shadow_view
from .surfaces import Surface

Floats = NDArray[np.floating]

BACKGROUND = ((0.80, 0.86, 0.92), (0.40, 0.56, 0.76), (0.62, 0.67, 0.73))  # at, above, below the horizon
_AMBIENT = (np.array([0.20, 0.215, 0.24]), np.array([0.11, 0.105, 0.10]))  # linear, from above and below
_SHADOW_SIZE = 1024
_FULL = 1.15  # light that a model file's lamps give together
_MOST_SHADOWS = 12  # texture units that every OpenGL 3.3 has, less those of the materials


class Renderer:
    """Draws one model; keeps the geometry on the graphics side between pictures.

    - `lights`: those of the film; by default the model file's own, or `default_lights` when it has none.
    - `shadows`: False draws none at all.
    - `background`: one display RGB, or three: at the horizon, above and below it.

    `not_drawn` lists what the model file asks for and the pictures do not show. Several renderers may be
    alive at once; each belongs to the thread and process that made it (start workers by spawn, not fork).
    Use as a context manager, or call `close`. Raises FilmError without an OpenGL library or for a bad size.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        *,
        width: int = 640,
        height: int = 480,
        lights: Sequence[Light] | None = None,
        shadows: bool = True,
        background: ArrayLike = BACKGROUND,
    ) -> None:
        if not (1 <= width <= 8192 and 1 <= height <= 8192):
            raise FilmError(f"a picture is 1 to 8192 pixels wide and high, not {width}x{height}")
        tints = np.asarray(background, dtype=float)
        if tints.shape not in ((3,), (3, 3)):
            raise FilmError(f"background is one RGB colour or three, not an array of shape {tints.shape}")
        self.model, self.width, self.height = model, int(width), int(height)
        self._data = mujoco.MjData(model)
        self._tints = np.broadcast_to(tints, (3, 3))
        corners = motion_corners(model, model.qpos0[None])[0]
        low, high = corners.min(axis=0), corners.max(axis=0)
        self._extent = max(float(np.linalg.norm(high - low)), float(model.stat.extent), 1e-3)
        self._middle = (low + high) / 2
        self._haze = (6 * self._extent, 25 * self._extent)
        self._batches, self.not_drawn = batches(model, plane_radius=1.5 * self._haze[1])
        self._solid = np.concatenate([[]] + [b.geoms for b in self._batches if not b.ground]).astype(int)
        casters = [b for b in self._batches if not b.ground and b.material.rgba[3] >= 0.5]
        self._casters = np.concatenate([[]] + [b.geoms for b in casters]).astype(int)
        own = bool(np.any(model.light_active)) if model.nlight else False
        self._lights = default_lights(self._middle, self._extent) if lights is None and not own else lights
        self._shadows = shadows and len(self._casters) > 0
        self._context = Context()
        self._context.make_current()
        self._upload(casters)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Free the context and all that lives in it; other renderers are not touched."""
        self._context.close()

    def render(self, q: ArrayLike, t: float = 0.0, *, camera: Camera) -> NDArray[np.uint8]:
        """The picture (height, width, 3) of configuration `q` (nq,); time `t` (s) keys camera and lights."""
        X_WC, fovy = self._pose(q, t, camera)
        lights = self._lights_at(t, X_WC)
        X_WG = self._send_poses(X_WC, 2 * np.tan(fovy / 2) / self.height)
        maps = self._draw_shadow_maps(lights, X_WG)
        self._picture.begin(depth=False)
        self._draw_forward(X_WC, fovy, lights, maps)
        return self._picture.colors()

    def depth(self, q: ArrayLike, t: float = 0.0, *, camera: Camera) -> NDArray[np.float32]:
        """Distance in metres along the line of sight's axis (height, width), infinite where nothing is."""
        X_WC, fovy = self._pose(q, t, camera)
        self._send_poses(X_WC, 0.0)
        self._picture.begin(depth=True)
        self._draw_depth([s for s, _ in self._surfaces], self._view_projection(X_WC, fovy))
        near, far = self._range
        buffer = self._picture.depths().astype(np.float64)
        with np.errstate(divide="ignore"):
            metres = near * far / (far - buffer * (far - near))
        metres[buffer >= 1.0] = np.inf
        return metres.astype(np.float32)

    def _pose(self, q: ArrayLike, t: float, camera: Camera) -> tuple[Floats, float]:
        """Kinematics at q, then the camera's pose; makes the context current."""
        configuration = np.asarray(q, dtype=float)
        if configuration.shape != (self.model.nq,):
            raise FilmError(f"q must have shape ({self.model.nq},), not {configuration.shape}")
        self._data.qpos[:] = configuration
        mujoco.mj_kinematics(self.model, self._data)
        mujoco.mj_comPos(self.model, self._data)  # some lights and cameras of model files track it
        mujoco.mj_camlight(self.model, self._data)
        self._context.make_current()
        return camera.pose(t, self._data)

    def _view_projection(self, X_WC: Floats, fovy: float) -> Floats:
        """Clip planes enclose every solid geom and the visible floor."""
        reach = 0.0
        if len(self._solid):
            away = np.linalg.norm(self._data.geom_xpos[self._solid] - X_WC[:3, 3], axis=1)
            reach = float((away + self.model.geom_rbound[self._solid]).max())
        far = 1.1 * max(reach, 1.5 * self._haze[1])
        self._range = (min(0.005 * self._extent, far / 100), far)
        return perspective(fovy, self.width / self.height, *self._range) @ inverse(X_WC)

    def _lights_at(self, t: float, X_WC: Floats) -> list[LitNow]:
        if self._lights is not None:
            return [light.at(t) for light in self._lights]
        lights = model_lights(self.model, self._data)
        if self.model.vis.headlight.active:
            glow = 0.4 * np.asarray(self.model.vis.headlight.diffuse, dtype=float) ** 2
            lights.append(
                LitNow("directional", X_WC[:3, 3], -X_WC[:3, 2], glow, False, 0.0, 1.0, (1.0, 0.0, 0.0))
            )
        return lights

    def _exposure_of(self, lights: Sequence[LitNow], place: Floats) -> float:
        """The factor by which a model file's lights together give full brightness at `place`.

        MuJoCo adds display colours, so that files for it differ widely in how bright they are. Lights of the
        scene are taken as they are.
        """
        if self._lights is not None:
            return 1.0
        total = sum(float(light.radiance.max()) * light.power_at(place) for light in lights)
        return float(np.clip(_FULL / total, 0.4, 4.0)) if total > 0 else 1.0

    def _upload(self, casters: list[Batch]) -> None:
        """Send surfaces and textures, and compile the programs for this film's lights."""
        from OpenGL import GL

        self._picture = Picture(self.width, self.height)
        self._textures = {
            b.material.texture: upload_texture(self.model, b.material.texture)
            for b in self._batches
            if b.material.texture >= 0 and b.material.checker is None
        }
        mujoco.mj_kinematics(self.model, self._data)
        mujoco.mj_comPos(self.model, self._data)
        mujoco.mj_camlight(self.model, self._data)
        lights = self._lights_at(0.0, np.eye(4))
        self._exposure = self._exposure_of(lights, self._middle)
        self._layout = self._shadow_layout(lights)
        self._maps = [ShadowMap(_SHADOW_SIZE) for _, index in self._layout if index >= 0]
        programs: dict[tuple[str, bool], Program] = {}
        self._surfaces: list[tuple[Surface, Program]] = []
        for batch in self._batches:
            key = (self._texture_kind(batch), batch.ground)
            if key not in programs:
                programs[key] = Program(
                    shaders.forward_vertex(len(self._maps)),
                    shaders.forward_fragment(self._layout, texture=key[0], ground=batch.ground),
                )
            surface = Surface(batch, self.model, pixel=self._extent / self.height)
            self._surfaces.append((surface, programs[key]))
        self._surfaces.sort(key=lambda s: s[0].batch.ground)  # what lies behind last: fewer hidden pixels
        self._programs = list(programs.values())
        self._casting = [s for s, _ in self._surfaces if any(s.batch is b for b in casters)]
        self._depth_program = Program(shaders.DEPTH_VERTEX, shaders.DEPTH_FRAGMENT)
        self._sky_program = Program(shaders.SKY_VERTEX, shaders.SKY_FRAGMENT)
        self._empty = GL.glGenVertexArrays(1)

    def _shadow_layout(self, lights: Sequence[LitNow]) -> list[tuple[str, int]]:
        layout, used = [], 0
        for light in lights:
            casts = self._shadows and light.shadow
            layout.append((light.kind, used if casts else -1))
            used += casts
        if used > _MOST_SHADOWS:
            raise FilmError(
                f"{used} lights cast shadows; at most {_MOST_SHADOWS} can: set shadow=False on the rest"
            )
        return layout

    def _texture_kind(self, batch: Batch) -> str:
        if batch.material.checker is not None:
            return "checker"
        return self._textures[batch.material.texture][0] if batch.material.texture >= 0 else "none"

    def _send_poses(self, X_WC: Floats, slope: float) -> NDArray[np.float32]:
        """World poses of all geoms (ngeom, 4, 4), also sent to the surfaces with the slope of a pixel."""
        X_WG = np.zeros((self.model.ngeom, 4, 4), dtype=np.float32)
        X_WG[:, :3, :3] = self._data.geom_xmat.reshape(-1, 3, 3)
        X_WG[:, :3, 3] = self._data.geom_xpos
        X_WG[:, 3, 3] = 1
        columns = np.ascontiguousarray(X_WG.transpose(0, 2, 1))
        for surface, _ in self._surfaces:
            surface.place(columns, X_WC[:3, 3], slope)
        return X_WG

    def _draw_shadow_maps(
        self, lights: Sequence[LitNow], X_WG: NDArray[np.float32]
    ) -> list[tuple[Floats, float]]:
        """Fill the shadow maps; for each its matrix to texture coordinates and its texel (m)."""
        from OpenGL import GL

        views = []
        GL.glEnable(GL.GL_DEPTH_TEST)
        GL.glEnable(GL.GL_POLYGON_OFFSET_FILL)
        GL.glPolygonOffset(1.5, 4.0)
        middle = self.model.geom_aabb[self._casters, :3]
        centers = X_WG[self._casters, :3, 3] + np.einsum("gij,gj->gi", X_WG[self._casters, :3, :3], middle)
        radii = np.minimum(
            np.linalg.norm(self.model.geom_aabb[self._casters, 3:], axis=1),
            self.model.geom_rbound[self._casters] + np.linalg.norm(middle, axis=1),
        )
        for light, (_, index) in zip(lights, self._layout, strict=True):
            if index >= 0:
                shadow_map = self._maps[index]
                VP, to_texture, texel = shadow_view(light, centers, radii, size=shadow_map.size)
                shadow_map.begin()
                self._draw_depth(self._casting, VP)
                views.append((to_texture, texel))
        GL.glDisable(GL.GL_POLYGON_OFFSET_FILL)
        return views

    def _draw_depth(self, surfaces: Sequence[Surface], VP: Floats) -> None:
        from OpenGL import GL

        GL.glEnable(GL.GL_DEPTH_TEST)
        GL.glDepthFunc(GL.GL_LESS)
        GL.glDepthMask(True)
        GL.glUseProgram(self._depth_program.id)
        self._depth_program.set("view_projection", VP)
        for surface in surfaces:
            surface.draw()

    def _draw_forward(
        self,
        X_WC: Floats,
        fovy: float,
        lights: Sequence[LitNow],
        maps: list[tuple[Floats, float]],
    ) -> None:
        from OpenGL import GL

        GL.glEnable(GL.GL_DEPTH_TEST)
        GL.glDepthFunc(GL.GL_LEQUAL)
        GL.glDepthMask(True)
        GL.glDisable(GL.GL_BLEND)
        GL.glEnable(GL.GL_MULTISAMPLE)
        for i, shadow_map in enumerate(self._maps):
            GL.glActiveTexture(GL.GL_TEXTURE1 + i)
            GL.glBindTexture(GL.GL_TEXTURE_2D, shadow_map.texture)
        GL.glActiveTexture(GL.GL_TEXTURE0)
        VP = self._view_projection(X_WC, fovy)
        for program in self._programs:
            GL.glUseProgram(program.id)
            program.set("view_projection", VP)
            self._light(program, X_WC[:3, 3], lights, maps)
        for surface, program in self._surfaces:
            if surface.batch.opaque:
                self._draw_surface(surface, program)
        self._draw_sky(X_WC, fovy)
        clear = [s for s in self._surfaces if not s[0].batch.opaque]
        if clear:
            place = self._data.geom_xpos
            clear.sort(key=lambda s: -float(np.linalg.norm(place[s[0].batch.geoms[0]] - X_WC[:3, 3])))
            GL.glEnable(GL.GL_BLEND)
            GL.glBlendFunc(GL.GL_SRC_ALPHA, GL.GL_ONE_MINUS_SRC_ALPHA)
            GL.glDepthMask(False)
            for surface, program in clear:
                self._draw_surface(surface, program)
            GL.glDepthMask(True)

    def _light(
        self,
        program: Program,
        eye: Floats,
        lights: Sequence[LitNow],
        maps: list[tuple[Floats, float]],
    ) -> None:
        """Write what holds for the whole picture to a forward program."""
        program.set("eye", eye)
        program.set("ambient_above", _AMBIENT[0])
        program.set("ambient_below", _AMBIENT[1])
        program.set("haze", self._haze)
        self._tint(program)
        if lights:
            program.set("light_position", [light.position for light in lights])
            program.set("light_direction", [light.direction for light in lights])
            program.set("light_radiance", [self._exposure * light.radiance for light in lights])
            program.set("light_fade", [light.attenuation for light in lights])
            program.set("light_cone", [(light.cos_cutoff, light.exponent) for light in lights])
        program.sampler("image", 0)
        for i, (to_texture, texel) in enumerate(maps):
            program.set(f"shadow_matrix{i}", to_texture)
            program.set(f"texel{i}", texel)
            program.sampler(f"shadow_map{i}", 1 + i)

    def _tint(self, program: Program) -> None:
        for name, color in zip(("horizon", "zenith", "nadir"), self._tints, strict=True):
            program.set(name, color)

    def _draw_surface(self, surface: Surface, program: Program) -> None:
        from OpenGL import GL

        look = surface.batch.material
        GL.glUseProgram(program.id)
        program.set("base", [*(np.array(look.rgba[:3]) ** 2), look.rgba[3]])
        program.set("surface", (look.specular, look.exponent, look.emission))
        program.set("uv_scale", look.uv_scale)
        program.set("cube_scale", look.cube_scale)
        if look.checker is not None:
            for i, color in enumerate(look.checker.colors):
                program.set(f"checker{i}", np.array(color) ** 2)
            program.set("edge", look.checker.edge)
        elif look.texture >= 0:
            kind, name = self._textures[look.texture]
            GL.glBindTexture(GL.GL_TEXTURE_2D if kind == "2d" else GL.GL_TEXTURE_CUBE_MAP, name)
        surface.draw()

    def _draw_sky(self, X_WC: Floats, fovy: float) -> None:
        from OpenGL import GL

        program = self._sky_program
        GL.glUseProgram(program.id)
        slope = np.tan(fovy / 2)
        rays = np.eye(4)
        rays[:3, :3] = X_WC[:3, :3] * [slope * self.width / self.height, slope, -1.0]
        program.set("rays", rays)
        self._tint(program)
        GL.glBindVertexArray(self._empty)
        GL.glDrawArrays(GL.GL_TRIANGLES, 0, 3)
