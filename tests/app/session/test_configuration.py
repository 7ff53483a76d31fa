"""Options from a file."""

import json
import tomllib

import pytest
from typer.main import get_command

from clra.app.cli import app
from clra.app.session.configuration import options_for, template
from clra.errors import InputError
from clra.model.grid import default_grid

COMMANDS = get_command(app).commands


def _file(tmp_path, text):
    path = tmp_path / "scan.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_command_has_its_table_and_what_all_have(tmp_path):
    path = _file(
        tmp_path,
        'device = "pocl"\nvoxel-size = 0.5\n[align]\nschedule = "4FR"\ndevice = "gpu"\n'
        "[reconstruct]\nbin = 2\nalign = true\n",
    )
    assert options_for("align", path, COMMANDS) == {"schedule": "4FR", "device": "gpu"}
    told = {"device": "pocl", "voxel_size": "0.5", "bin": "2", "align": True}
    assert options_for("reconstruct", path, COMMANDS) == told
    assert options_for("info", path, COMMANDS) == {"device": "pocl"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[aline]\n", r"\[aline\]: found an unknown command, expected command align\?"),
        ("[align]\nshedule = 1\n", r"\[align\] shedule: found an unknown option, .* schedule\?"),
        ("devise = 1\n", r"devise: found an unknown option, expected option device\?"),
        ("[align]\nresume = true\n", "resume: found an unknown option"),
        ("[align\n", "cannot be read as TOML"),
    ],
)
def test_what_no_command_knows_is_refused(tmp_path, text, message):
    with pytest.raises(InputError, match=message):
        options_for("align", _file(tmp_path, text), COMMANDS)


def test_the_command_line_has_the_last_word(clra, scan, scan_file, tmp_path):
    path = _file(tmp_path, f'scan = "{scan_file}"\n[reconstruct]\nbin = 2\nout = "a.h5"\n')
    out = tmp_path / "volume.h5"
    status, told, error = clra("reconstruct", "--config", path, "-o", out, "--json")
    assert status == 0, error
    expected = default_grid(scan.geometry.binned(2))
    assert json.loads(told)["shape"] == list(expected.shape)
    assert json.loads(told)["voxel_mm"] == pytest.approx(expected.voxel_size)
    assert out.exists() and not (tmp_path / "a.h5").exists()
    status, _, error = clra("reconstruct", "--config", path, "-o", out, "--bin", "0")
    assert status == 2 and "--bin: found 0" in error


def test_the_template_is_a_file_of_all_options(clra, tmp_path):
    path = tmp_path / "scan.toml"
    assert clra("config", path)[0] == 0
    text = path.read_text(encoding="utf-8")
    assert list(tomllib.loads(text)) == ["import", "align", "reconstruct", "report"]
    # With the comments off, every line is still TOML, and every option known.
    lines = [
        line.removeprefix("# ") if " = " in line and line.startswith("# ") else line
        for line in text.splitlines()
    ]
    bare = [line for line in lines if not line.startswith("#")]
    told = tomllib.loads("\n".join(bare))
    assert told["align"]["schedule"] == "auto"
    assert told["reconstruct"]["bin"] == 1
    options_for("align", _file(tmp_path, "\n".join(bare)), COMMANDS)
    assert text.endswith(template({"report": COMMANDS["report"]}).partition("[report]")[2])
