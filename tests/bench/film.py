"""CPU time of a frame, ours beside stock pyrender and mujoco.Renderer, and memory over a thousand frames.

The same model, pose, camera and picture size for all; variants take turns, so that what else the machine
does falls on all alike. CPU time counts all threads of the process; "lean" is mujoco.Renderer without
multisampling, shadows and reflections.
"""

import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

os.environ["MUJOCO_GL"] = os.environ["PYOPENGL_PLATFORM"] = "egl"  # one GL for all, in this process only

import mujoco
import numpy as np
from figures import Figure, main, ratio, told
from pantograph.sim.film import Camera, Renderer
from pantograph.sim.film.drawing import drawn_geoms
from pantograph.sim.film.shapes import geom_shape
from rich.console import Console
from rich.table import Table

SIZE = (640, 480)
ROUNDS = 12
FRAMES = 1000
FLAT = 5.0  # MB that memory may grow by over FRAMES frames
DATA = Path(os.environ.get("PANTOGRAPH_DATA", "../shared/data")) / "robots"

_KEPT: list[object] = []

Draw = Callable[[np.ndarray], object]


def models() -> dict[str, mujoco.MjModel]:
    """Twenty-seven geoms and two lights, and the real robots where they are present."""
    rng = np.random.default_rng(1)
    kinds = ("sphere", "capsule", "box")
    geoms = "".join(
        f'<body pos="{x} {y} {0.3 + 0.3 * z}"><freejoint/><geom type="{kinds[z]}" size=".12 .1 .08" '
        f'rgba="{" ".join(f"{c:.2f}" for c in rng.uniform(0.2, 0.9, 3))} 1"/></body>'
        for x in (-0.5, 0, 0.5)
        for y in (-0.5, 0, 0.5)
        for z in range(3)
    )
    lights = "".join(f'<light type="directional" pos="{x} 0 3" dir="{-x} .2 -2"/>' for x in (-1, 1))
    synthetic = f"<mujoco><worldbody>{lights}<geom type='plane' size='4 4 .1'/>{geoms}</worldbody></mujoco>"
    found = {"27 geoms": mujoco.MjModel.from_xml_string(synthetic)}
    for name in ("humanoid/humanoid.xml", "trossen_wx250s/scene.xml"):
        if (DATA / name).is_file():
            found[name.split("/")[0]] = mujoco.MjModel.from_xml_path(str(DATA / name))
        else:
            print(f"{name}: not under {DATA}, left out (set PANTOGRAPH_DATA)", file=sys.stderr)
    return found


def ours(stack: ExitStack, model: mujoco.MjModel, camera: Camera, *, shadows: bool) -> Draw:
    renderer = stack.enter_context(Renderer(model, width=SIZE[0], height=SIZE[1], shadows=shadows))
    return lambda q: renderer.render(q, camera=camera)


def theirs(stack: ExitStack, model: mujoco.MjModel, camera: Camera, *, lean: bool) -> Draw:
    """mujoco.Renderer through a free camera at our camera's place, with the geom groups that we draw."""
    samples = model.vis.quality.offsamples
    model.vis.quality.offsamples = 0 if lean else samples
    renderer = stack.enter_context(mujoco.Renderer(model, SIZE[1], SIZE[0]))
    model.vis.quality.offsamples = samples
    data = mujoco.MjData(model)
    view = mujoco.MjvCamera()
    model.vis.global_.fovy = np.degrees(camera.pose(0.0, data)[1])
    away = np.asarray(camera.position) - np.asarray(camera.target)
    view.lookat[:] = np.asarray(camera.target)
    view.distance = float(np.linalg.norm(away))
    view.azimuth = float(np.degrees(np.arctan2(-away[1], -away[0])))
    view.elevation = float(np.degrees(np.arcsin(-away[2] / view.distance)))

    def draw(q: np.ndarray) -> object:
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)
        renderer.update_scene(data, view)
        if lean:
            renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
            renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        return renderer.render()

    return draw


def stock(model: mujoco.MjModel, camera: Camera, *, shadows: bool) -> Draw:
    """pyrender's OffscreenRenderer with our triangles, its materials, two lights and its own shaders."""
    import pyrender
    from pyrender import RenderFlags

    scene = pyrender.Scene(ambient_light=(0.2, 0.2, 0.2))
    nodes = {}
    for geom in drawn_geoms(model):
        shape = geom_shape(model, geom, plane_radius=20.0, segments=24)
        if shape is None:
            continue
        index = int(model.geom_matid[geom])
        rgba = model.mat_rgba[index] if index >= 0 else model.geom_rgba[geom]
        look = pyrender.MetallicRoughnessMaterial(
            baseColorFactor=rgba, metallicFactor=0.1, roughnessFactor=0.7
        )
        surface = pyrender.Primitive(
            positions=shape.positions, normals=shape.normals, indices=shape.indices, material=look
        )
        nodes[geom] = scene.add(pyrender.Mesh([surface]))
    data = mujoco.MjData(model)
    X_WC, fovy = camera.pose(0.0, data)
    scene.add(pyrender.PerspectiveCamera(yfov=fovy, aspectRatio=SIZE[0] / SIZE[1]), pose=X_WC)
    for x in (-0.4, 0.4):
        scene.add(
            pyrender.DirectionalLight(intensity=3.0), pose=Camera(position=(x, -0.2, 1)).pose(0.0, data)[0]
        )
    renderer = pyrender.OffscreenRenderer(*SIZE)
    _KEPT.append(renderer)  # its delete(), also called when it is collected, ends the display for everybody
    flags = RenderFlags.SHADOWS_DIRECTIONAL if shadows else RenderFlags.NONE

    def draw(q: np.ndarray) -> object:
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        pose = np.eye(4)
        for geom, node in nodes.items():
            pose[:3, :3], pose[:3, 3] = data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom]
            scene.set_pose(node, pose.copy())
        return renderer.render(scene, flags=flags)

    return draw


def cpu_times(variants: dict[str, Draw], q: np.ndarray) -> dict[str, np.ndarray]:
    """CPU milliseconds of a frame of each variant, (ROUNDS,), drawn in turn."""
    times: dict[str, list[float]] = {name: [] for name in variants}
    for number in range(ROUNDS + 2):
        for name, draw in variants.items():
            start = time.process_time()
            draw(q)
            if number >= 2:
                times[name].append(1e3 * (time.process_time() - start))
    return {name: np.array(values) for name, values in times.items()}


def resident() -> float:
    """Resident memory of this process in MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def memory_growth(model: mujoco.MjModel, q: np.ndarray, camera: Camera) -> float:
    """MB gained over FRAMES frames after 100 to warm up, with moving poses and a moving camera."""
    orbit = Camera(kind="orbit", target=camera.target, radius=3.0, period=7.0)
    v = np.random.default_rng(2).normal(size=model.nv)
    with Renderer(model, width=SIZE[0] // 2, height=SIZE[1] // 2) as renderer:
        held = []
        for k in range(100 + FRAMES):
            q_k = q.copy()
            mujoco.mj_integratePos(model, q_k, v, 0.3 * np.sin(0.1 * k))
            renderer.render(q_k, 0.03 * k, camera=orbit)
            held.append(resident())
    return float(np.median(held[-50:]) - np.median(held[50:100]))


def frames(console: Console) -> Iterator[Figure]:
    """CPU time of a frame of every variant, and ratios to ours."""
    table = Table(
        title=f"CPU-ms a frame (1000 over it: frames a second and core) at {SIZE[0]}x{SIZE[1]}: "
        f"median (10 to 90 %), {ROUNDS} rounds in turn"
    )
    columns = (
        "ours, shadows",
        "ours, none",
        "pyrender, shadows",
        "pyrender, none",
        "mujoco default",
        "mujoco lean",
    )
    for column in ("model", *columns):
        table.add_column(column, justify="left" if column == "model" else "right")
    for title, model in models().items():
        q = model.key_qpos[0].copy() if model.nkey else model.qpos0.copy()
        camera = Camera.auto(model, q[None])
        with ExitStack() as stack:
            variants = {
                columns[0]: ours(stack, model, camera, shadows=True),
                columns[1]: ours(stack, model, camera, shadows=False),
                columns[2]: stock(model, camera, shadows=True),
                columns[3]: stock(model, camera, shadows=False),
                columns[4]: theirs(stack, model, camera, lean=False),
                columns[5]: theirs(stack, model, camera, lean=True),
            }
            times = cpu_times(variants, q)
        cells = []
        for name in columns:
            low, middle, high = np.percentile(times[name], [10, 50, 90])
            cells.append(f"{middle:.0f} ({low:.0f}-{high:.0f})")
            yield told(f"{title}: {name}", middle, "CPU-ms")
        table.add_row(title, *cells)
        for slow, fast in ((columns[2], columns[0]), (columns[3], columns[1]), (columns[4], columns[0])):
            value, spread = ratio(times, slow, fast)
            yield Figure(f"{title}: {slow} / {fast}", value, "x", "> 1", value > 1, spread)
        value, spread = ratio(times, columns[5], columns[1])
        yield told(f"{title}: {columns[5]} / {columns[1]}", value, "x", spread)
    console.print(table)
    console.print(
        "Ours and stock pyrender draw with 4 samples a pixel, as mujoco's default does; lean has one."
    )


def memory(console: Console) -> Iterator[Figure]:
    model = next(iter(models().values()))
    growth = memory_growth(model, model.qpos0, Camera.auto(model, model.qpos0[None]))
    yield Figure(f"memory growth over {FRAMES} frames", growth, "MB", f"< {FLAT:g}", growth < FLAT)


if __name__ == "__main__":
    # stock pyrender's destructors fail, and print, when the interpreter winds down
    os._exit(main("film", {"frames": frames, "memory": memory}))
