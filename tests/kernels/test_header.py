"""What a C host is given: pasted sources, and a header that agrees with what compilers see."""

import re
import subprocess
import sys

import pytest

import clra
from clra.kernels.__main__ import HEADER, main, write
from clra.kernels.header import header, signatures
from clra.ops.runtime import build

FILES = clra.kernels.names()


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    # -P: the installed package, not the checkout that the tests may be run in
    command = [sys.executable, "-P", "-W", "error", "-m", "clra.kernels", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("defines", [{}, {"LANES": 8}])
@pytest.mark.parametrize("file", FILES)
def test_names_and_arguments_are_those_of_the_built_kernels(context, file, defines):
    built = {
        kernel.function_name: kernel.num_args
        for kernel in build.builds(context).program(file, defines).all_kernels()
    }
    found = {one.name: len(one.arguments) for one in signatures(file)}
    assert found == built


def test_every_buffer_is_followed_by_its_offset():
    for file in FILES:
        for kernel in signatures(file):
            for this, following in zip(kernel.arguments, kernel.arguments[1:], strict=False):
                if this.type.startswith("global"):
                    assert following.type == "const ulong", (file, kernel.name, this.name)
                    assert following.name == f"{this.name}_offset"


# A size that a comment spells out, or the plain rule for kernels of a work-item a view.
GEOMETRY = re.compile(r"global\s+sizes?\b|one work-item a view", re.IGNORECASE)
KERNEL = re.compile(r"((?:^//[^\n]*\n)*)^kernel\b[^\n]*\bvoid (\w+)\(", re.MULTILINE)


@pytest.mark.parametrize("file", FILES)
def test_comments_tell_the_launch_geometry_of_each_kernel(file):
    text = (clra.kernels.path() / file).read_text(encoding="utf-8")
    head = re.match(r"(?://[^\n]*\n)+", text)
    assert head, "no head comment"
    kernels = KERNEL.findall(text)
    assert [name for _, name in kernels] == [one.name for one in signatures(file)]
    for comment, name in kernels:
        told = re.sub(r"\n//", "", head.group(0) + comment)
        assert GEOMETRY.search(told), name


def test_the_shape_of_every_array_is_told():
    for file in FILES:
        for kernel in signatures(file):
            for argument in kernel.arguments:
                if argument.type.startswith("global"):
                    assert argument.meaning, (file, kernel.name, argument.name)


def test_header_defines_each_name_once():
    text = header()
    defined = re.findall(r"^#define (\w+)|^    (\w+),?", text, re.MULTILINE)
    names = [a or b for a, b in defined]
    assert len(names) == len(set(names))
    assert "    CLRA_FORWARD_RAYS_VOXEL_SIZE, /* const float: [mm] */" in text
    assert '#define CLRA_TRANSPOSE_FILE "transpose.cl"' in text


def test_two_arguments_on_a_line_are_an_error(monkeypatch):
    text = "kernel void f(\n    global float *x, const ulong x_offset)\n{\n"
    monkeypatch.setattr(clra.kernels, "source", lambda name: text)
    with pytest.raises(ValueError, match=r"f\.cl: found .* const ulong.*, expected one argument"):
        signatures("f.cl")


def test_the_command_writes_sources_and_header(tmp_path):
    out = tmp_path / "a new" / "folder"
    done = run(out)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert sorted(file.name for file in out.iterdir()) == sorted([*FILES, HEADER])
    for name in FILES:
        assert (out / name).read_text(encoding="utf-8") == clra.kernels.source(name)


def test_what_was_there_is_replaced_whole(tmp_path):
    (tmp_path / HEADER).write_text("old")
    write(tmp_path)
    assert (tmp_path / HEADER).read_text(encoding="utf-8") == header()
    assert not list(tmp_path.glob(".*"))


@pytest.mark.parametrize("arguments", [(), ("a", "b"), ("--lanes", "8")])
def test_usage_errors_exit_with_2(arguments):
    done = run(*arguments)
    assert done.returncode == 2
    assert "usage: python -m clra.kernels" in done.stderr


def test_a_file_in_the_folders_place_is_a_usage_error(tmp_path, capsys):
    place = tmp_path / "file"
    place.touch()
    with pytest.raises(SystemExit, match="2"):
        main([str(place)])
    assert "expected a folder" in capsys.readouterr().err


def test_a_folder_that_cannot_be_made_exits_with_1(tmp_path, capsys):
    (tmp_path / "file").touch()
    assert main([str(tmp_path / "file" / "folder")]) == 1
    message = capsys.readouterr().err
    assert message.startswith("python -m clra.kernels: ")
    assert message.count("\n") == 1
