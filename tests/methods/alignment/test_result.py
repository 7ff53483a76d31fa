from dataclasses import replace

import numpy as np
import pytest

from clra.errors import InputError
from clra.methods.alignment.result import AlignmentResult
from clra.model.motion import Motion


def known(views: int = 5, rejected: tuple[int, ...] = (1, 3)) -> AlignmentResult:
    motion = Motion(shift_u=np.arange(views), shift_v=-2.0 * np.arange(views))
    return AlignmentResult.from_motion(motion, ~np.isin(np.arange(views), rejected))


def test_rejected_views_are_flagged() -> None:
    assert known().flagged == (1, 3)
    assert known().confidence.tolist() == [1, 0, 1, 0, 1]
    assert not known().scale_estimated and known().median_sigma is None


def test_equality_compares_numbers_and_takes_what_is_not_estimated_as_equal() -> None:
    assert known() == known() and np.isnan(known().sigma).all()
    assert known() != known(rejected=()) and known() != known(6)
    assert known() != replace(known(), schedule="1QR")
    assert known() != replace(known(), volume=np.zeros((1, 1, 1), np.float32))
    assert known() != "a result"


def test_repr_is_one_short_line() -> None:
    told = repr(replace(known(720), method="ra", schedule="1QR-1HR"))
    assert told == (
        "AlignmentResult(720 views, 2 rejected, median |shift| 359.50, 719.00 pixel, ra 1QR-1HR)"
    )


def test_columns_have_a_value_for_each_view() -> None:
    with pytest.raises(InputError, match=r"confidence: found shape \(3,\), expected \(5,\)"):
        replace(known(), confidence=np.ones(3))
    with pytest.raises(InputError, match=r"sigma: found shape \(4, 3\), expected \(5, 3\)"):
        replace(known(), sigma=np.ones((4, 3)))
