"""A windowless OpenGL context: through EGL, else OSMesa, else an error that says what to install."""

import ctypes
import importlib
import os
import sys
from contextlib import suppress
from typing import Any

from ..errors import FilmError

INSTALL = (
    "films need an OpenGL library that draws without a window. Install one of:\n"
    "  apt-get install libegl1 libgl1-mesa-dri libgl1   (EGL: faster; also uses a GPU where there is one)\n"
    "  apt-get install libosmesa6                       (OSMesa: software only)"
)
_EGL_PLATFORM_DEVICE_EXT = 0x313F


class Context:
    """One OpenGL core context of pyrender's EGL or OSMesa platform, usable from the thread that made it.

    Errors: `FilmError` when neither library works, with what to install. A set PYOPENGL_PLATFORM is obeyed;
    the environment is left as it was.
    """

    def __init__(self) -> None:
        self.kind = _load()
        self._platform = _egl_platform() if self.kind == "egl" else _osmesa_platform()

    def make_current(self) -> None:
        """Direct the OpenGL calls that follow to this context (several may be alive)."""
        self._platform.make_current()

    def close(self) -> None:
        """Destroy this context alone; closing again does nothing."""
        if self._platform is not None:
            self._platform.delete_context()
            self._platform = None


def _load() -> str:
    """Import PyOpenGL and pyrender for the platform to use; its name."""
    asked = os.environ.get("PYOPENGL_PLATFORM")
    if asked and asked not in ("egl", "osmesa"):
        raise FilmError(
            f"PYOPENGL_PLATFORM is {asked!r}, which needs a window; unset it, or set it to 'egl' or 'osmesa'"
        )
    loaded = sys.modules.get("OpenGL.platform")
    if loaded is not None:  # its choice of library is made once per process
        kind = "osmesa" if "OSMesa" in type(loaded.PLATFORM).__name__ else "egl"
    else:
        kind = asked or ("egl" if _egl_answers() else "osmesa")
    # PyOpenGL reads the variable at its import only; afterwards it goes back to what it was.
    os.environ["PYOPENGL_PLATFORM"] = kind
    # pyrender imports pyglet for its window, which looks for X libraries unless told that there is no screen.
    import pyglet

    pyglet.options["headless"] = True
    try:
        importlib.import_module(f"pyrender.platforms.{kind}")
    except Exception as error:  # a missing library shows as ImportError, AttributeError or GLError
        for name in [n for n in sys.modules if n.split(".")[0] == "pyrender"]:
            del sys.modules[name]
        raise FilmError(f"OpenGL could not be loaded through {kind} ({error});\n{INSTALL}") from error
    finally:
        if asked is None:
            os.environ.pop("PYOPENGL_PLATFORM", None)
    return kind


def _egl_answers() -> bool:
    """Whether an EGL library is there and starts a display, found out without importing PyOpenGL."""
    try:
        egl = ctypes.CDLL("libEGL.so.1")
    except OSError:
        return False
    egl.eglGetProcAddress.restype = ctypes.c_void_p
    egl.eglGetDisplay.restype = ctypes.c_void_p

    def extension(name: bytes, restype: Any, *argtypes: Any) -> Any:
        address = egl.eglGetProcAddress(name)
        return ctypes.CFUNCTYPE(restype, *argtypes)(address) if address else None

    query = extension(
        b"eglQueryDevicesEXT",
        ctypes.c_uint,
        ctypes.c_int,
        ctypes.POINTER(ctypes.c_void_p),
        ctypes.POINTER(ctypes.c_int),
    )
    display_of = extension(
        b"eglGetPlatformDisplayEXT", ctypes.c_void_p, ctypes.c_uint, ctypes.c_void_p, ctypes.c_void_p
    )
    if query is None or display_of is None:
        displays = [egl.eglGetDisplay(None)]
    else:
        devices, count = (ctypes.c_void_p * 16)(), ctypes.c_int(0)
        if not query(16, devices, ctypes.byref(count)):
            return False
        displays = [display_of(_EGL_PLATFORM_DEVICE_EXT, devices[i], None) for i in range(count.value)]
    initialize = egl.eglInitialize
    initialize.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p]
    return any(display and initialize(display, None, None) for display in displays)


def _egl_platform() -> Any:
    """A context on the first EGL device that gives one; a listed GPU may be out of reach."""
    from OpenGL import EGL
    from pyrender.platforms import egl

    class SharedDisplay(egl.EGLPlatform):  # type: ignore[misc]
        """pyrender's platform, less its eglTerminate: all renderers of the process share the display.

        Its destructor calls `delete_context` as well, at any time: what is current stays current.
        """

        def delete_context(self) -> None:
            shared: Any = self
            display, context = shared._egl_display, shared._egl_context
            shared._egl_display = shared._egl_context = None
            if display is None or context is None:
                return
            current = EGL.eglGetCurrentContext()
            with suppress(
                EGL.EGLError
            ):  # another library may have ended the display, and the context with it
                if ctypes.cast(current, ctypes.c_void_p).value == ctypes.cast(context, ctypes.c_void_p).value:
                    EGL.eglMakeCurrent(display, EGL.EGL_NO_SURFACE, EGL.EGL_NO_SURFACE, EGL.EGL_NO_CONTEXT)
                EGL.eglDestroyContext(display, context)

    devices = egl.query_devices() if egl._eglQueryDevicesEXT is not None else [egl.EGLDevice(None)]
    failures = []
    for device in devices:
        platform = SharedDisplay(1, 1, device=device)
        try:
            platform.init_context()
        except Exception as error:
            failures.append(f"{device}: {error or type(error).__name__}")
        else:
            return platform
    raise FilmError(f"EGL gives no OpenGL context ({'; '.join(failures) or 'no device'});\n{INSTALL}")


def _osmesa_platform() -> Any:
    """A software context, with the small buffer of its own that OSMesa asks for."""
    from pyrender.platforms.osmesa import OSMesaPlatform

    platform = OSMesaPlatform(64, 64)
    try:
        platform.init_context()
        platform.make_current()
    except Exception as error:
        with suppress(Exception):
            platform.delete_context()
        raise FilmError(f"OSMesa gives no OpenGL context ({error});\n{INSTALL}") from error
    return platform
