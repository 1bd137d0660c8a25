"""The smooth engine as functions of torch tensors with gradients (extra `torch`).

    dynamics = differentiable(compile_model(model, parameters=[("body_mass", "bob")]))
    dx = dynamics.rate(x, u, p)
    path = torchdiffeq.odeint(lambda t, x: dynamics.rate(x, u, p), x0, t)
    path[-1].norm().backward()                                   # by x0, u and p

Values and gradients are those of compiled code in double precision on the processor.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..errors import EngineError
from ..integrate.problems import quaternion_rate
from .rigid.tree import BALL, FREE

if TYPE_CHECKING:
    from collections.abc import Sequence

    import torch

    from .layout import Layout
    from .smooth import Smooth

Array = NDArray[np.float64]


def differentiable(smooth: Smooth) -> TorchDynamics:
    """The dynamics of a compiled model for torch.

    Raises EngineError when torch is not installed.
    """
    try:
        import torch  # noqa: F401
    except ImportError as missing:
        raise EngineError(
            f"differentiable dynamics need torch: pip install 'pantograph-sim[torch]' ({missing})"
        ) from missing
    return TorchDynamics(smooth)


class TorchDynamics:
    """dx/dt and accelerations of one model on torch tensors; made by `differentiable`.

    Tensors are float64 on the processor. Each argument is one row, or rows under any leading axes, which
    broadcast as torch's do. Gradients are exact, first ones only (EngineError with create_graph=True).
    """

    def __init__(self, smooth: Smooth):
        self.smooth = smooth
        lay = smooth.layout
        self._sizes = {
            "x": lay.nx,
            "q": lay.nq,
            "v": lay.nv,
            "act": lay.na,
            "u": lay.nu,
            "tau": lay.nv,
            "w": lay.nw,
            "p": len(smooth.parameters),
        }

    def rate(
        self,
        x: torch.Tensor,
        u: torch.Tensor | None = None,
        p: torch.Tensor | None = None,
        *,
        w: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """dx/dt of the state x = (q, v, act), shape (..., nx), by controls u (..., nu) and parameters p.

        Quaternions are four plain numbers here, q' = 1/2 q (0, omega), smooth beside the unit sphere too: a
        solver that knows no manifold drifts off it by its error. u is zero and p the model's own values where
        they are not given; w (..., nw), the prescribed motion of keyed joints at this time, is a constant to
        gradients.

        Raises EngineError for other types of numbers, other shapes, missing motion of keyed joints, and
        gradients by w.
        """
        names = ("x", "u", "w", "p")
        rows = self._rows(names, (x, u, w, p))
        result: torch.Tensor = _functions()[0].apply(self.smooth, *rows)
        return result

    def forward(
        self,
        q: torch.Tensor,
        v: torch.Tensor,
        u: torch.Tensor | None = None,
        *,
        act: torch.Tensor | None = None,
        tau: torch.Tensor | None = None,
        p: torch.Tensor | None = None,
        w: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Accelerations, shape (..., nv), as `Smooth.forward`; gradients by all but w.

        Gradients by quaternions lie in the tangent space of the unit sphere: those of the function of
        rotations, whatever their length.

        Raises EngineError as `rate`.
        """
        names = ("q", "v", "act", "u", "tau", "w", "p")
        rows = self._rows(names, (q, v, act, u, tau, w, p))
        result: torch.Tensor = _functions()[1].apply(self.smooth, *rows)
        return result

    def _rows(self, names: Sequence[str], values: Sequence[torch.Tensor | None]) -> list[torch.Tensor]:
        """The arguments with equal leading axes; what is not given stands there as a constant."""
        import torch

        checked: list[torch.Tensor] = []
        for name, value in zip(names, values, strict=True):
            size = self._sizes[name]
            if value is None:
                if name == "w" and size:
                    raise EngineError(
                        "keyed joints need their prescribed motion: pass w=(q, v, a) of the keyed joints"
                    )
                own = self.smooth.parameter_values if name == "p" else np.zeros(size)
                value = torch.from_numpy(own.copy())
            checked.append(_checked(name, value, size))
        try:
            lead = np.broadcast_shapes(*(value.shape[:-1] for value in checked))
        except ValueError:
            shapes = ", ".join(f"{n} {tuple(x.shape)}" for n, x in zip(names, checked, strict=True))
            raise EngineError(f"leading axes do not broadcast: {shapes}") from None
        return [value.expand(*lead, value.shape[-1]) for value in checked]


def _checked(name: str, value: Any, size: int) -> torch.Tensor:
    """A tensor that compiled code can read."""
    import torch

    if not isinstance(value, torch.Tensor):
        raise EngineError(f"{name} is a {type(value).__name__}; it must be a torch tensor of float64")
    if value.dtype != torch.float64:
        raise EngineError(f"{name} has type {value.dtype}; it must be torch.float64: {name}.double()")
    if value.device.type != "cpu":
        raise EngineError(f"{name} is on {value.device}; compiled dynamics run on the CPU: {name}.cpu()")
    if value.ndim == 0 or value.shape[-1] != size:
        raise EngineError(f"{name} has shape {tuple(value.shape)}; expected (..., {size})")
    if name == "w" and value.requires_grad:
        raise EngineError("there are no gradients by prescribed motion w: pass w.detach()")
    return value


def _flat(value: torch.Tensor) -> Array:
    """Rows (n, size) of a tensor of any leading axes."""
    array: Array = value.detach().numpy()
    count = int(np.prod(array.shape[:-1]))
    return array.reshape(count, array.shape[-1])


def _tangent_to_plain(layout: Layout, q: Array, bar: Array) -> Array:
    """Gradients by q from those in its tangent space, `bar` (n, nv): their least rows that act alike.

    A rotation by d in the body's frame moves a unit quaternion by 1/2 q (0, d), an isometry but for the 1/2;
    a quaternion of length s is moved s times as far.
    """
    out = np.empty_like(q)
    for kind, at, dof in layout.blocks:
        if kind == FREE:
            out[:, at : at + 3] = bar[:, dof : dof + 3]
            at, dof = at + 3, dof + 3
        if kind in (FREE, BALL):
            quat = q[:, at : at + 4]
            squared = np.sum(quat * quat, axis=1, keepdims=True)
            out[:, at : at + 4] = 4.0 * quaternion_rate(quat, bar[:, dof : dof + 3]) / squared
        else:
            out[:, at] = bar[:, dof]
    return out


@cache
def _functions() -> tuple[Any, Any]:
    """The autograd functions of dx/dt and of the accelerations; torch is imported here."""
    import torch

    class Rate(torch.autograd.Function):
        @staticmethod
        def forward(ctx: Any, smooth: Smooth, *rows: torch.Tensor) -> torch.Tensor:
            ctx.smooth = smooth
            ctx.save_for_backward(*rows)
            dx = smooth.evaluate("rate", **_split(smooth, rows))["dx"]
            return torch.from_numpy(dx.reshape(rows[0].shape))

        @staticmethod
        def backward(ctx: Any, bar: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
            _refuse_second(torch.is_grad_enabled())
            smooth, rows = ctx.smooth, ctx.saved_tensors
            wide = _wide(smooth, _flat(bar))
            out = smooth.evaluate("rate_vjp", bar=wide, **_split(smooth, rows))
            x, u, _, p = rows
            return (
                None,
                torch.from_numpy(out["x"].reshape(x.shape)),
                torch.from_numpy(out["u"].reshape(u.shape)),
                None,
                torch.from_numpy(out["p"].reshape(p.shape)),
            )

    class Forward(torch.autograd.Function):
        names = ("q", "v", "act", "u", "tau", "w", "p")

        @staticmethod
        def forward(ctx: Any, smooth: Smooth, *rows: torch.Tensor) -> torch.Tensor:
            ctx.smooth = smooth
            ctx.save_for_backward(*rows)
            inputs = {name: _flat(row) for name, row in zip(Forward.names, rows, strict=True)}
            a = smooth.evaluate("forward", **inputs)["a"]
            return torch.from_numpy(a.reshape(rows[1].shape))

        @staticmethod
        def backward(ctx: Any, bar: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
            _refuse_second(torch.is_grad_enabled())
            smooth, rows = ctx.smooth, ctx.saved_tensors
            inputs = {name: _flat(row) for name, row in zip(Forward.names, rows, strict=True)}
            out = smooth.evaluate("vjp", bar=_wide(smooth, _flat(bar)), **inputs)
            out["q"] = _tangent_to_plain(smooth.layout, inputs["q"], out["q"])
            found = [
                None if name == "w" else torch.from_numpy(out[name].reshape(row.shape))
                for name, row in zip(Forward.names, rows, strict=True)
            ]
            return (None, *found)

    return Rate, Forward


def _refuse_second(wanted: bool) -> None:
    """Compiled gradients are constants to torch: gradients of them would silently miss terms."""
    if wanted:
        raise EngineError(
            "compiled dynamics have first derivatives only: leave out create_graph=True, or take differences "
            "of gradients"
        )


def _split(smooth: Smooth, rows: Sequence[torch.Tensor]) -> dict[str, Array]:
    """Inputs of compiled functions from (x, u, w, p)."""
    lay = smooth.layout
    x, u, w, p = (_flat(row) for row in rows)
    q, v, act = np.split(x, [lay.nq, lay.nq + lay.nv], axis=1)
    return {"q": q, "v": v, "act": act, "u": u, "w": w, "p": p}


def _wide(smooth: Smooth, bar: Array) -> Array:
    """Weights of the outputs as wide as compiled code reads them."""
    spare = max(smooth.layout.nx, smooth.layout.nv) - bar.shape[1]
    return np.concatenate([bar, np.zeros((len(bar), spare))], axis=1)
