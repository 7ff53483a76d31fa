"""Doubts about a result, raised where they should be and nowhere else."""

import numpy as np
import pytest

from clra.app.plausible import doubt_of_shifts
from clra.methods.assessment.agreement import Agreement
from clra.model.motion import Motion


@pytest.mark.parametrize(
    ("shift_u", "shift_v", "doubted"), [(2.0, 1.0, False), (0.2, 0.1, True), (0.0, 1.0, False)]
)
def test_shifts_smaller_than_their_uncertainty_are_doubted(shift_u, shift_v, doubted):
    quality = Agreement(1, 0.6, 0.6, half_u=0.5, half_v=0.2, sharpness=1.0)
    signs = np.array([1, -1, 1, -1, 1])
    told = doubt_of_shifts(quality, Motion(shift_u=shift_u * signs, shift_v=shift_v * signs))
    assert bool(told) == doubted
    assert not doubted or "by 0.50, 0.20 pixel" in told
