"""The package as a whole: its public names, its floors, its import, its kernels."""

import ast
import importlib.metadata
import pkgutil
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pyopencl as cl
import pytest

import clra

PUBLIC = (
    "ConeBeamGeometry circular helix double_helix space_filling VolumeGrid Motion Scan read_scan "
    "align reconstruct correct devices kernels ForwardProjector BackProjector "
    "AlignmentStep as_linear_operator"
).split()


@pytest.mark.parametrize("name", PUBLIC)
def test_public_name_is_there_and_documented(name):
    assert getattr(clra, name).__doc__
    assert name in dir(clra)


def test_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'aline'"):
        _ = clra.aline


def test_import_loads_no_opencl_and_prints_nothing():
    code = (
        "import sys, clra; "
        "heavy = {'pyopencl', 'scipy', 'h5py', 'matplotlib', 'numpy'} & set(sys.modules); "
        "sys.exit(f'loaded {heavy}' if heavy else 0)"
    )
    done = subprocess.run(
        [sys.executable, "-P", "-c", code], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_import_reads_no_environment():
    code = """
import os, sys
read = []
def noted(environment, key, ask=os._Environ.__getitem__):
    read.append(key)
    return ask(environment, key)
os._Environ.__getitem__ = noted
import clra
sys.exit(f"read {read}" if read else 0)
"""
    done = subprocess.run(
        [sys.executable, "-P", "-c", code], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


FLOORS = ("kernels", "model", "ops", "methods", "io", "app")


def imports(path: Path) -> Iterator[list[str]]:
    """Parts of the names that a module imports, ["clra", "ops", "steps", "Step"] and the like."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom):
            for alias in node.names:
                yield f"{node.module}.{alias.name}".split(".")
        elif isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name.split(".")


def test_modules_import_from_their_own_floor_and_below():
    package = Path(clra.__file__).parent
    up = set()
    for number, floor in enumerate(FLOORS):
        for path in (package / floor).rglob("*.py"):
            for name in imports(path):
                if name[0] == "clra" and name[1:2] and name[1] in FLOORS[number + 1 :]:
                    module = ".".join(path.relative_to(package.parent).with_suffix("").parts)
                    up.add((module, ".".join(name[:3])))
    assert not up


def test_no_module_holds_a_device_a_context_or_a_queue(context):
    """After all that the tests have run so far."""
    held = (cl.Device, cl.Context, cl.CommandQueue, cl.Program, cl.Kernel)
    names = [
        module.name
        for module in pkgutil.walk_packages(clra.__path__, "clra.")
        if not module.name.endswith("__main__")
    ]
    assert len(names) > 50
    for name in names:
        for key, value in vars(importlib.import_module(name)).items():
            assert not isinstance(value, held), f"{name}.{key}"


def test_version_is_semantic():
    assert re.fullmatch(r"\d+\.\d+\.\d+", importlib.metadata.version("clra"))


def test_every_kernel_is_one_text_without_includes():
    assert len(clra.kernels.names()) > 5
    for name in clra.kernels.names():
        text = clra.kernels.source(name)
        assert re.search(r"^kernel\b.*\bvoid ", text, re.MULTILINE)
        assert "#include" not in text


def test_unknown_kernel_says_what_there_is():
    with pytest.raises(ValueError, match=r"no kernel file 'x\.cl'; there are .*backproject\.cl"):
        clra.kernels.source("x.cl")


def test_every_kernel_builds_without_definitions(context):
    from clra.ops.runtime import build

    for name in clra.kernels.names():
        assert build.builds(context).program(name).all_kernels()
