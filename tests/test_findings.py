"""Findings are warnings that point at the line that called clra, and values."""

import logging
import warnings

import numpy as np
import pytest

import clra
from clra.errors import ClraWarning
from clra.findings import Finding, collected, collected_so_far, warn


def line_of(word: str) -> int:
    """Number of this file's line that ends in a comment of that word."""
    with open(__file__, encoding="utf-8") as file:
        return next(n for n, line in enumerate(file, 1) if line.endswith(f"# {word}\n"))


def dark(views: int = 24) -> clra.Scan:
    """Half a turn whose radiographs are dark in a tenth of the pixels, others in each."""
    geometry = clra.circular(
        views, source_to_axis=5, source_to_detector=50, pixel_size=1.0, shape=(24, 24),
        arc=np.pi,
    )  # fmt: skip
    random = np.random.default_rng(0)
    pixels = random.uniform(0.3, 1.0, (views, 24, 24)).astype(np.float32)
    pixels[random.random(pixels.shape) < 0.1] = 0
    return clra.Scan(pixels, geometry, "transmission")


@pytest.mark.slow
def test_warnings_point_at_the_line_that_called() -> None:
    scan = dark()
    with pytest.warns(ClraWarning) as told:
        clra.align(scan, schedule="1FR")  # align
        clra.reconstruct(scan)  # reconstruct
    lines = {warning.lineno for warning in told}
    assert {warning.filename for warning in told} == {__file__}
    assert lines == {line_of("align"), line_of("reconstruct")}


@pytest.mark.slow
def test_a_result_carries_what_was_warned_of() -> None:
    with pytest.warns(ClraWarning) as told:
        result = clra.align(dark(), schedule="1FR")
    assert {str(warning.message) for warning in told} <= set(map(str, result.warnings))
    assert "dark-pixels" in {finding.code for finding in result.warnings}


def test_findings_are_collected_once_and_in_order() -> None:
    with warnings.catch_warnings(), collected() as outer:
        warnings.simplefilter("ignore")
        warn("a", "first")
        with collected() as inner:
            warn("b", "second", "do this")
            warn("b", "second", "do this")
            assert collected_so_far() == tuple(inner)
            assert collected_so_far(outermost=True) == tuple(outer)
    assert [finding.code for finding in outer] == ["a", "b"]
    assert [str(finding) for finding in inner] == ["second: do this"]
    assert collected_so_far() == ()


def test_mere_information_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, logger="clra"), collected() as found:
        Finding("device", "an idle device is there", severity="info").warn()
    assert [record.message for record in caplog.records] == ["an idle device is there"]
    assert caplog.records[0].name.startswith("clra") and len(found) == 1
