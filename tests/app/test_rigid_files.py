"""Rigid motion through the command line: a table of it starts an alignment, MOTION.h5 too."""

import numpy as np
import pytest

from clra.io.alignment_file import read_alignment, write_alignment
from clra.methods.alignment.result import AlignmentResult
from clra.model.rigid.rigid_motion import RigidMotion


@pytest.fixture
def motion(scan):
    size = [0.05, 0.05, 0.05, 0.01, 0.01, 0.01]
    table = size * np.random.default_rng(8).normal(size=(scan.views, 6))
    return RigidMotion.of(scan.geometry, table)


@pytest.mark.parametrize("name", ["m.h5", "m.csv"])
def test_alignments_start_from_it(clra, scan_file, motion, tmp_path, name):
    first, last = tmp_path / "m.h5", tmp_path / "last.h5"
    write_alignment(first, AlignmentResult.from_motion(motion))
    if name == "m.csv":
        told = clra("export-motion", first, "--to", "csv", "-o", tmp_path / name)
        assert told[0] == 0
    options = ("--start", tmp_path / name, "--schedule", "1HR", "--estimate", "shift", "-q")
    assert clra("align", scan_file, "-o", last, *options)[0] == 0
    found = read_alignment(last).motion
    assert isinstance(found, RigidMotion)
    assert np.allclose(found.rotation, motion.rotation, atol=1e-6)
    assert not np.allclose(found.translation, motion.translation, atol=1e-3)


def test_programs_without_rotations_are_refused_in_one_line(clra, scan_file, motion, tmp_path):
    first = tmp_path / "m.h5"
    write_alignment(first, AlignmentResult.from_motion(motion))
    options = ("--to", "nabu", "--scan", scan_file, "-o", tmp_path / "m.txt")
    status, _, errors = clra("export-motion", first, *options)
    assert status == 2 and "rotations of the sample" in errors and errors.count("\n") == 1
    assert not (tmp_path / "m.txt").exists()
