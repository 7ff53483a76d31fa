import numpy as np
import pytest

from clra.ops.registration.windows import registration_window, tukey


def test_tukey_is_symmetric_and_flat_in_the_middle():
    window = tukey(101, 0.4)
    np.testing.assert_allclose(window, window[::-1])
    assert (window[21:80] == 1).all() and (np.diff(window[:20]) > 0).all()
    assert window[0] < 0.01


def test_border_counts_nothing_and_the_middle_fully():
    window = registration_window((100, 200), 0.1, 1.0)
    assert not window[:5].any() and not window[:, -10:].any()
    assert (window[15:-15, 30:-30] == 1).all()
    assert 0 < window[10, 100] < 1


def test_masked_areas_are_borders_and_masked_pixels_are_small_holes():
    mask = np.ones((100, 120), bool)
    plain = registration_window((100, 120), 0.1, 1.0, mask)
    np.testing.assert_array_equal(plain, registration_window((100, 120), 0.1, 1.0))
    mask[:30] = False
    mask[60, 70] = False
    window = registration_window((100, 120), 0.1, 1.0, mask)
    assert not window[:34].any() and (window[48:56, 40:80] == 1).all()
    assert not window[60, 70] and not window[60, 71] and (window[60, 75:80] == 1).all()


@pytest.mark.parametrize("margin", [0.0, 0.31])
def test_margin_is_checked(margin):
    with pytest.raises(ValueError, match=f"margin: found {margin}"):
        registration_window((30, 30), margin, 1.0)


def test_nothing_left():
    mask = np.zeros((60, 60), bool)
    mask[:4] = True
    with pytest.raises(ValueError, match="no pixel that counts"):
        registration_window((60, 60), 0.12, 1.0, mask)
