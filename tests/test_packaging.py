"""What is installed is what is in the folders, and imports go one way."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parent.parent
CONFIG = tomllib.loads((ROOT / "pyproject.toml").read_text())
FOLDERS = ("models", "sim", "controllers", "hardware")


def test_every_folder_with_code_or_data_is_listed_as_a_package():
    on_disk = {
        "pantograph." + ".".join(folder.relative_to(ROOT).parts)
        for top in FOLDERS
        for folder in [ROOT / top, *(ROOT / top).rglob("*/")]
        if any(f.suffix in (".py", ".xml", ".toml") for f in folder.iterdir() if f.is_file())
    }
    assert on_disk == set(CONFIG["tool"]["setuptools"]["packages"])


def test_the_front_door_imports_nothing_heavy():
    heavy = {"torch", "casadi", "llvmlite", "pyrender", "serial", "av", "matplotlib", "OpenGL"}
    code = f"import sys, pantograph.sim; print(*sorted({heavy!r} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.split() == []


def test_machine_code_waits_for_neither_scenes_nor_scipy():
    code = "import sys, pantograph.sim.dynamics; "
    code += "print(*sorted({'pydantic', 'scipy.optimize', 'scipy.interpolate', 'casadi'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.split() == []


def test_names_of_the_front_door_are_found_however_their_modules_were_imported():
    code = """
import importlib, pantograph.sim as sim
for name in ("run", "shoot", "plan", "plots", "recording"):
    importlib.import_module(f"pantograph.sim.{name}")
found = {}
exec("from pantograph.sim import *", found)
assert set(sim.__all__) <= set(found) & set(dir(sim)), set(sim.__all__) - set(found)
assert all(callable(found[name]) and getattr(sim, name) is found[name] for name in sim.__all__)
assert sim.plan.make_plan is sim.make_plan
assert not hasattr(sim, "fun")
"""
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)


def test_versions_that_tests_run_with_satisfy_what_the_package_asks_for():
    from packaging.requirements import Requirement

    pinned = dict(
        line.split("==")
        for line in (ROOT / ".ci" / "constraints.txt").read_text().splitlines()
        if "==" in line
    )
    extras = CONFIG["project"]["optional-dependencies"]["torch"]
    groups = CONFIG["dependency-groups"]["test"]
    for line in [*CONFIG["project"]["dependencies"], *extras, *groups]:
        requirement = Requirement(line)
        versions = {k.lower(): v for k, v in pinned.items()}
        assert requirement.name.lower() in versions, f"{requirement.name} is not pinned"
        assert requirement.specifier.contains(versions[requirement.name.lower()])
