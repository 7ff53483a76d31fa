"""Motions out of reach and features that a level loses are said."""

import warnings

import numpy as np
import pytest

import clra
from clra.app.simulate import paper_like, sample
from clra.methods.limits import surviving_contrast, warn_of_far_motion, warn_of_lost_features


def test_noise_is_lost_and_structure_is_not():
    geometry = paper_like("circular", 12, (128, 128))
    noise = np.random.default_rng(0).normal(size=(12, 128, 128)).astype(np.float32)
    assert surviving_contrast(clra.Scan(noise, geometry), 4) == pytest.approx(1 / 16, rel=0.1)
    rock = sample("spheres", geometry).line_integrals(geometry)
    assert surviving_contrast(clra.Scan(rock, geometry), 4) > 0.9


def test_a_scan_of_noise_is_said():
    geometry = paper_like("space-filling", 60, (96, 96))
    noise = np.random.default_rng(0).normal(size=(60, 96, 96)).astype(np.float32)
    with pytest.warns(UserWarning, match=r"hardly agree at QR, .*noise alone would leave 6.2 %"):
        clra.align(clra.Scan(noise, geometry), schedule="2QR")


def test_motions_out_of_reach_are_said_and_a_few_are_not():
    far = np.zeros(100)
    far[:30] = 60.0
    with pytest.warns(UserWarning, match=r"30 of 100 views moved by 51 pixels .* than 64; start"):
        warn_of_far_motion(clra.Motion(shift_u=0 * far, shift_v=-far), 4, "QR")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_far_motion(clra.Motion(shift_u=0 * far, shift_v=0.5 * far), 4, "QR")
        few = np.where(np.arange(100) < 4, 60.0, 0.0)
        warn_of_far_motion(clra.Motion(shift_u=few, shift_v=few), 4, "QR")


def test_what_agrees_is_not_mentioned():
    geometry = paper_like("circular", 12, (32, 32))
    scan = clra.Scan(np.zeros((12, 32, 32), np.float32), geometry)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_lost_features(scan, np.full(12, 0.9), 4, "QR")
    with pytest.warns(UserWarning, match=r"at FR, their median correlation is 0.20$"):
        warn_of_lost_features(scan, np.full(12, 0.2), 1, "FR")
