"""Radiographs in place of those that a helix lacks; images are linear in the view number."""

import numpy as np
import pytest

import clra
from clra.methods.reconstruction.missing_views import without_gaps

DETECTOR = {
    "source_to_axis": 30.0,
    "source_to_detector": 61.0,
    "pixel_size": 0.5,
    "shape": (5, 4),
}
WHOLE = clra.double_helix(12, angle_step=0.05, z_step=0.05, **DETECTOR)
# Of the second helix nothing can be told from the first.
IMAGES = (np.r_[0.0:12.0, 100.0:112.0, 0][:24, None, None] + np.arange(20).reshape(5, 4)).astype(
    "f4"
)


def test_gaps_are_closed_by_what_lies_between():
    expected = IMAGES.copy()
    expected[11], expected[[12, 13]] = IMAGES[10], IMAGES[14]  # ends of the helices
    valid_views = ~np.isin(np.arange(24), [3, 4, 5, 8, 11, 12, 13, 20])
    missing = np.isin(np.arange(24), [5, 20])
    spoilt = np.where(valid_views[:, None, None], IMAGES, np.float32(50))
    scan = clra.Scan(spoilt[~missing], WHOLE.subset(~missing), name="gappy")
    whole = without_gaps(scan, valid_views[~missing])
    assert whole.geometry.views == 24 and whole.name == "gappy"
    np.testing.assert_allclose(whole.read(0, 24), expected, rtol=1e-6)
    for start, stop in ((3, 6), (4, 5), (11, 14), (0, 12), (20, 24)):
        np.testing.assert_array_equal(whole.read(start, stop), whole.read(0, 24)[start:stop])
    assert np.array_equal(scan.read(0, 22), spoilt[~missing])  # not written to


def test_nothing_to_do_is_nothing_done():
    scan = clra.Scan(IMAGES, WHOLE)
    assert without_gaps(scan) is scan
    assert without_gaps(scan, np.ones(24, np.bool_)) is scan


def test_what_cannot_be_filled():
    scan = clra.Scan(IMAGES, WHOLE)
    with pytest.raises(ValueError, match="valid_views: found none of the views 12 to 23"):
        without_gaps(scan, np.arange(24) < 12)
    circle = clra.circular(24, **DETECTOR)
    with pytest.raises(ValueError, match="expected a helix"):
        without_gaps(clra.Scan(IMAGES, circle))
