"""The mark of tests that draw."""

import pytest
from pantograph.sim.errors import FilmError
from pantograph.sim.film.context import Context


def _missing() -> str:
    """What OpenGL says when it cannot draw here; nothing when it can."""
    try:
        Context().close()
    except FilmError as error:
        return str(error).splitlines()[0]
    return ""


needs_gl = pytest.mark.skipif(bool(_missing()), reason=f"no OpenGL library: {_missing()}")
