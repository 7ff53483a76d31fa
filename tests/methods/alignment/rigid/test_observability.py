"""What a scan cannot tell of a rigid motion is held."""

import numpy as np
import pytest

from clra.findings import collected
from clra.methods.alignment.rigid.observability import held
from clra.model.rigid.rigid_motion import RigidMotion
from clra.model.trajectory import circular

VIEWS = 400
ALL = (0, 1, 2, 3, 4, 5)


def motions(spread, error):
    """Return motions that vary by `spread`, and the same with errors."""
    geometry = circular(
        VIEWS, source_to_axis=40.0, source_to_detector=100.0, pixel_size=0.2, shape=(31, 45)
    )
    random = np.random.default_rng(5)
    true = spread * random.normal(size=(VIEWS, 6))
    found = true + error * random.normal(size=(VIEWS, 6))
    return RigidMotion.of(geometry, true), RigidMotion.of(geometry, found)


def test_what_is_seen_stays_and_errors_alone_go():
    error = np.full(6, 0.01)
    true, found = motions(np.array([0.0, 0.0, 0.0, 0.2, 0.0, 0.01]), error)
    with collected() as findings:
        kept = held(found, np.tile(error, (VIEWS, 1)), np.ones(VIEWS, np.bool_), ALL)
    assert np.array_equal(kept.translation[:, :2], found.translation[:, :2])
    left = np.sqrt(np.mean((kept.table - true.table) ** 2, axis=0))
    before = np.sqrt(np.mean((found.table - true.table) ** 2, axis=0))
    assert (left[[2, 4]] < 0.25 * before[[2, 4]]).all()
    assert left[3] == pytest.approx(before[3], rel=0.02)
    # As much spread as error: half of it is kept, which halves the mean square.
    assert left[5] == pytest.approx(before[5] / np.sqrt(2), rel=0.1)
    told = " ".join(f.message for f in findings if f.code == "not-observed")
    assert "translation along the beam" in told and "rotation about v" in told
    assert "rotation about u" not in told and all(f.severity == "info" for f in findings)


def test_parameters_that_were_not_estimated_are_left_alone():
    _, found = motions(np.zeros(6), np.full(6, 0.01))
    sigma = np.full((VIEWS, 6), np.nan)
    sigma[:, [0, 1, 5]] = 0.01
    with collected() as findings:
        kept = held(found, sigma, np.ones(VIEWS, np.bool_), (0, 1, 5))
    assert np.array_equal(kept.table[:, :5], found.table[:, :5])
    assert np.abs(kept.table[:, 5] - found.table[:, 5]).max() > 0.01
    assert len(findings) == 1
