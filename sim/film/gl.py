"""The few OpenGL objects of the film: programs, picture buffers, shadow maps, textures."""

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from .drawing import texture_pixels

Floats = NDArray[np.floating]


class Program:
    """A linked shader program; `set` writes a uniform by name and ignores names that were optimised away."""

    def __init__(self, vertex: str, fragment: str) -> None:
        from OpenGL import GL
        from OpenGL.GL import shaders

        # Core profiles validate against a bound vertex array, which the caller provides at draw time only.
        self.id = GL.glCreateProgram()
        for text, kind in ((vertex, GL.GL_VERTEX_SHADER), (fragment, GL.GL_FRAGMENT_SHADER)):
            shader = shaders.compileShader(text, kind)
            GL.glAttachShader(self.id, shader)
            GL.glDeleteShader(shader)
        GL.glLinkProgram(self.id)
        if not GL.glGetProgramiv(self.id, GL.GL_LINK_STATUS):
            raise RuntimeError(f"shader program does not link: {GL.glGetProgramInfoLog(self.id)!r}")
        self._places: dict[str, int] = {}
        self._vectors = {1: GL.glUniform1fv, 2: GL.glUniform2fv, 3: GL.glUniform3fv, 4: GL.glUniform4fv}

    def set(self, name: str, value: Any) -> None:
        """Write a float, a vector, an array of vectors (k, 2..3) or a matrix (4, 4) to the bound program."""
        from OpenGL import GL

        place = self._place(name)
        if place < 0:
            return
        array = np.ascontiguousarray(value, dtype=np.float32)
        if array.shape == (4, 4):
            GL.glUniformMatrix4fv(place, 1, True, array)
        else:
            width = array.shape[-1] if array.ndim else 1
            self._vectors[width](place, array.size // width, array)

    def sampler(self, name: str, unit: int) -> None:
        """Point a sampler of the bound program at a texture unit."""
        from OpenGL import GL

        if (place := self._place(name)) >= 0:
            GL.glUniform1i(place, unit)

    def _place(self, name: str) -> int:
        if name not in self._places:
            from OpenGL import GL

            self._places[name] = int(GL.glGetUniformLocation(self.id, name))
        return self._places[name]


class Picture:
    """Buffers of one picture size: colour with 4 samples a pixel, its resolved copy, and exact depth.

    Depth is drawn apart, with one sample: that of a multisampled buffer lies off the pixel's centre.
    """

    def __init__(self, width: int, height: int) -> None:
        from OpenGL import GL

        self.width, self.height = width, height
        samples = min(4, int(GL.glGetIntegerv(GL.GL_MAX_SAMPLES)))
        self._many = self._framebuffer(GL.GL_RGBA8, GL.GL_DEPTH_COMPONENT24, samples)
        self._single = self._framebuffer(GL.GL_RGBA8, None, 0)
        self._depth = self._framebuffer(None, GL.GL_DEPTH_COMPONENT32F, 0)

    def _framebuffer(self, color: Any, depth: Any, samples: int) -> int:
        from OpenGL import GL

        buffer = GL.glGenFramebuffers(1)
        GL.glBindFramebuffer(GL.GL_FRAMEBUFFER, buffer)
        for kind, place in ((color, GL.GL_COLOR_ATTACHMENT0), (depth, GL.GL_DEPTH_ATTACHMENT)):
            if kind is not None:
                storage = GL.glGenRenderbuffers(1)
                GL.glBindRenderbuffer(GL.GL_RENDERBUFFER, storage)
                GL.glRenderbufferStorageMultisample(
                    GL.GL_RENDERBUFFER, samples, kind, self.width, self.height
                )
                GL.glFramebufferRenderbuffer(GL.GL_FRAMEBUFFER, place, GL.GL_RENDERBUFFER, storage)
        if color is None:
            GL.glDrawBuffer(GL.GL_NONE)
            GL.glReadBuffer(GL.GL_NONE)
        return int(buffer)

    def begin(self, *, depth: bool) -> None:
        """Direct drawing to the colour or the depth picture, and clear its depth."""
        from OpenGL import GL

        GL.glBindFramebuffer(GL.GL_FRAMEBUFFER, self._depth if depth else self._many)
        GL.glViewport(0, 0, self.width, self.height)
        GL.glClear(GL.GL_DEPTH_BUFFER_BIT)

    def colors(self) -> NDArray[np.uint8]:
        """The drawn picture (h, w, 3), top row first."""
        from OpenGL import GL

        w, h = self.width, self.height
        GL.glBindFramebuffer(GL.GL_READ_FRAMEBUFFER, self._many)
        GL.glBindFramebuffer(GL.GL_DRAW_FRAMEBUFFER, self._single)
        GL.glBlitFramebuffer(0, 0, w, h, 0, 0, w, h, GL.GL_COLOR_BUFFER_BIT, GL.GL_NEAREST)
        GL.glBindFramebuffer(GL.GL_READ_FRAMEBUFFER, self._single)
        pixels = np.empty((h, w, 4), dtype=np.uint8)
        GL.glPixelStorei(GL.GL_PACK_ALIGNMENT, 1)
        GL.glReadPixels(0, 0, w, h, GL.GL_RGBA, GL.GL_UNSIGNED_BYTE, pixels)
        return np.ascontiguousarray(pixels[::-1, :, :3])

    def depths(self) -> NDArray[np.float32]:
        """The drawn depth buffer (h, w) in 0..1, top row first."""
        from OpenGL import GL

        GL.glBindFramebuffer(GL.GL_READ_FRAMEBUFFER, self._depth)
        values = np.empty((self.height, self.width), dtype=np.float32)
        GL.glReadPixels(0, 0, self.width, self.height, GL.GL_DEPTH_COMPONENT, GL.GL_FLOAT, values)
        return values[::-1]


class ShadowMap:
    """A square depth texture read with hardware comparison, and the framebuffer that fills it."""

    def __init__(self, size: int) -> None:
        from OpenGL import GL

        self.size = size
        self.texture = int(GL.glGenTextures(1))
        GL.glBindTexture(GL.GL_TEXTURE_2D, self.texture)
        GL.glTexImage2D(
            GL.GL_TEXTURE_2D,
            0,
            GL.GL_DEPTH_COMPONENT24,
            size,
            size,
            0,
            GL.GL_DEPTH_COMPONENT,
            GL.GL_UNSIGNED_INT,
            None,
        )
        for name, value in (
            (GL.GL_TEXTURE_MIN_FILTER, GL.GL_LINEAR),
            (GL.GL_TEXTURE_MAG_FILTER, GL.GL_LINEAR),
            (GL.GL_TEXTURE_WRAP_S, GL.GL_CLAMP_TO_EDGE),
            (GL.GL_TEXTURE_WRAP_T, GL.GL_CLAMP_TO_EDGE),
            (GL.GL_TEXTURE_COMPARE_MODE, GL.GL_COMPARE_REF_TO_TEXTURE),
            (GL.GL_TEXTURE_COMPARE_FUNC, GL.GL_LEQUAL),
        ):
            GL.glTexParameteri(GL.GL_TEXTURE_2D, name, value)
        self._buffer = int(GL.glGenFramebuffers(1))
        GL.glBindFramebuffer(GL.GL_FRAMEBUFFER, self._buffer)
        GL.glFramebufferTexture2D(
            GL.GL_FRAMEBUFFER, GL.GL_DEPTH_ATTACHMENT, GL.GL_TEXTURE_2D, self.texture, 0
        )
        GL.glDrawBuffer(GL.GL_NONE)
        GL.glReadBuffer(GL.GL_NONE)

    def begin(self) -> None:
        """Direct drawing to the map, cleared."""
        from OpenGL import GL

        GL.glBindFramebuffer(GL.GL_FRAMEBUFFER, self._buffer)
        GL.glViewport(0, 0, self.size, self.size)
        GL.glClear(GL.GL_DEPTH_BUFFER_BIT)


def upload_texture(model: mujoco.MjModel, texture: int) -> tuple[str, int]:
    """Send a texture of the model to the current context with mipmaps; ("2d" or "cube", its id)."""
    from OpenGL import GL

    pixels = texture_pixels(model, texture)
    height, width, channels = pixels.shape
    kind = "2d" if model.tex_type[texture] == mujoco.mjtTexture.mjTEXTURE_2D else "cube"
    target = GL.GL_TEXTURE_2D if kind == "2d" else GL.GL_TEXTURE_CUBE_MAP
    layout = {1: GL.GL_RED, 2: GL.GL_RG, 3: GL.GL_RGB, 4: GL.GL_RGBA}[channels]
    name = int(GL.glGenTextures(1))
    GL.glBindTexture(target, name)
    GL.glPixelStorei(GL.GL_UNPACK_ALIGNMENT, 1)
    faces = [GL.GL_TEXTURE_2D] if kind == "2d" else [GL.GL_TEXTURE_CUBE_MAP_POSITIVE_X + i for i in range(6)]
    side = height // len(faces)
    for i, face in enumerate(faces):
        part = np.ascontiguousarray(pixels[i * side : (i + 1) * side])
        GL.glTexImage2D(face, 0, GL.GL_RGBA8, width, side, 0, layout, GL.GL_UNSIGNED_BYTE, part)
    if channels == 1:
        grey = np.array([GL.GL_RED, GL.GL_RED, GL.GL_RED, GL.GL_ONE], dtype=np.int32)
        GL.glTexParameteriv(target, GL.GL_TEXTURE_SWIZZLE_RGBA, grey)
    GL.glGenerateMipmap(target)
    GL.glTexParameteri(target, GL.GL_TEXTURE_MIN_FILTER, GL.GL_LINEAR_MIPMAP_LINEAR)
    GL.glTexParameteri(target, GL.GL_TEXTURE_MAG_FILTER, GL.GL_LINEAR)
    wrap = GL.GL_REPEAT if kind == "2d" else GL.GL_CLAMP_TO_EDGE
    for axis in (GL.GL_TEXTURE_WRAP_S, GL.GL_TEXTURE_WRAP_T):
        GL.glTexParameteri(target, axis, wrap)
    return kind, name
