"""Compare where textures lie with mujoco.Renderer; run as a program with MUJOCO_GL set.

Prints a line for each geom type and kind of texture: "agrees", or by what share of the pixels it does not.
"""

import tempfile
from pathlib import Path

import mujoco
import numpy as np
from pantograph.sim.film import Camera, Light, Renderer
from PIL import Image

W, H = 160, 120
GEOMS = {"box": ".5 .3 .2", "sphere": ".4", "capsule": ".2 .3", "cylinder": ".3 .2", "ellipsoid": ".5 .3 .2"}
VIEWS = {
    "top": ("0 0 3", "1 0 0 0 1 0"),
    "bottom": ("0 0 -3", "1 0 0 0 -1 0"),
    "front": ("0 -3 0", "1 0 0 0 0 1"),
    "back": ("0 3 0", "-1 0 0 0 0 1"),
    "right": ("3 0 0", "0 1 0 0 0 1"),
    "left": ("-3 0 0", "0 -1 0 0 0 1"),
}


def images(folder: Path) -> None:
    """A 2d image of four colours with a white corner, and a cube of six, each side with its own corners."""
    flat = np.zeros((64, 64, 3), dtype=np.uint8)
    flat[:32, :32, 0] = flat[:32, 32:, 1] = flat[32:, :32, 2] = 255
    flat[32:, 32:] = (255, 255, 0)
    flat[:8, :8] = 255
    Image.fromarray(flat).save(folder / "flat.png")
    sides = [(255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 0), (0, 255, 255), (255, 0, 255)]
    cube = np.concatenate([np.full((64, 64, 3), side, dtype=np.uint8) for side in sides])
    for top in range(0, 6 * 64, 64):
        cube[top : top + 16, :16] = 255
        cube[top : top + 16, 16:32] = 0
    Image.fromarray(cube).save(folder / "cube.png")


def model_of(folder: Path, kind: str, size: str, texture: str, uniform: str) -> mujoco.MjModel:
    """The geom under even light, with a camera on each side."""
    source = {
        "2d": f'<texture name="t" type="2d" file="{folder}/flat.png"/>',
        "cube": f'<texture name="t" type="cube" file="{folder}/cube.png" gridsize="6 1" '
        'gridlayout="RLUDFB"/>',
    }[texture]
    cameras = [
        f'<camera name="{view}" pos="{pos}" xyaxes="{xy}" fovy="25"/>' for view, (pos, xy) in VIEWS.items()
    ]
    return mujoco.MjModel.from_xml_string(
        f"""<mujoco><visual><headlight ambient="1 1 1" diffuse="0 0 0" specular="0 0 0"/></visual>
        <asset>{source}
        <material name="t" texture="t" texrepeat="2 3" texuniform="{uniform}" specular="0"/></asset>
        <worldbody><geom type="{kind}" size="{size}" material="t"/>{"".join(cameras)}</worldbody></mujoco>"""
    )


def strong(picture: np.ndarray) -> np.ndarray:
    """Which channels are bright, relative to the brightest of the pixel: its hue, whatever the light."""
    channels = picture.astype(int)
    return channels > 0.6 * channels.max(axis=2, keepdims=True)


def disagreement(model: mujoco.MjModel, views: list[str]) -> float:
    """Largest share, over the views, of pixels away from edges of colour whose hue differs."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    lamps = [
        Light(f"{s}{axis}", position=s * np.eye(3)[axis], intensity=0.6) for s in (-1, 1) for axis in range(3)
    ]
    worst = 0.0
    with (
        mujoco.Renderer(model, H, W) as their,
        Renderer(model, width=W, height=H, lights=lamps, shadows=False) as our,
    ):
        for view in views:
            their.update_scene(data, view)
            theirs = their.render()
            ours = our.render(model.qpos0, camera=Camera(kind="model", frame=view))
            even = theirs.max(axis=2) > 30
            for axis, step in ((0, -1), (0, 1), (1, -1), (1, 1)):
                even &= np.abs(np.roll(theirs, step, axis).astype(int) - theirs).sum(axis=2) < 30
            assert even.sum() > 20
            wrong = (strong(theirs) != strong(ours)).any(axis=2)
            worst = max(worst, float(wrong[even].mean()))
    return worst


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        images(Path(name))
        cases = [(kind, size, texture) for kind, size in GEOMS.items() for texture in ("2d", "cube")]
        for kind, size, texture in [*cases, ("plane", ".5 .3 .1", "2d")]:
            for uniform in ("false", "true"):
                views = ["top"] if kind == "plane" else list(VIEWS)
                worst = disagreement(model_of(Path(name), kind, size, texture, uniform), views)
                verdict = "agrees" if worst < 0.06 else f"differs in {worst:.0%} of the pixels"
                print(kind, texture, f"texuniform={uniform}:", verdict)


if __name__ == "__main__":
    main()
