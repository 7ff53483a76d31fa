"""The report that a GPU's owner sends."""

import json


def test_each_step_is_written_as_soon_as_it_is_done(tool, tmp_path):
    report = tool("gpu_report")
    skipped = [f"--skip={name}" for name in report.STEPS if name != "device"]
    assert report.main(["-o", str(tmp_path), *skipped]) == 0
    facts = json.loads((tmp_path / "report.json").read_text())["device"]
    assert facts["self-test"] == "passed"
    assert "| form of the kernels | cpu |" in (tmp_path / "report.md").read_text()


def test_a_step_that_fails_or_takes_too_long_is_told(tool, tmp_path):
    report = tool("gpu_report")
    found = report.attempt("filtered back-projection", 0, 60.0, tmp_path)
    assert found == {"failed": "ZeroDivisionError: integer division or modulo by zero"}
    assert report.attempt("device", 1, 0.01, tmp_path) == {"failed": "not done within 0 s"}


def test_radiographs_repeat(tool):
    import numpy as np

    block = np.arange(3.0, dtype=np.float32)[:, None, None] * np.ones((1, 2, 2), np.float32)
    many = tool("gpu_report").Repeated(block, 8)
    assert many.shape == (8, 2, 2)
    assert many[2:5][:, 0, 0].tolist() == [2.0, 0.0, 1.0]
