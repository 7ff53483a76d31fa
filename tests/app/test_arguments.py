from pathlib import Path

import pytest

from clra.app.arguments import (
    coefficients,
    detector,
    interval,
    limits_of_integers,
    pixel,
    region,
    view_numbers,
    volume_file,
)
from clra.errors import InputError
from clra.io.volumes.integer_limits import Limits


def test_values_are_read():
    assert detector("--detector", "256x192") == (256, 192)
    assert interval("--shift", "-10,8") == (-10.0, 8.0)
    assert pixel("0.139") == 0.139
    assert pixel("0.139,0.14") == (0.139, 0.14)
    volume_file(Path("a/volume.H5"))


@pytest.mark.parametrize(
    ("read", "text"),
    [
        (lambda t: detector("--detector", t), "256"),
        (lambda t: detector("--detector", t), "0x4"),
        (lambda t: interval("--shift", t), "8,-10"),
        (lambda t: interval("--shift", t), "1,2,3"),
        (lambda t: interval("--shift", t), "nan,1"),
        (pixel, "1,2,3"),
        (pixel, "thick"),
        (lambda t: volume_file(Path(t)), "volume.png"),
        (lambda t: region("--roi", t), "0:1,0:1"),
        (lambda t: region("--roi", t), "0:1,0:1,0:e"),
        (lambda t: limits_of_integers("--limits", t), "1"),
        (lambda t: limits_of_integers("--limits", t), "1%,2"),
        (lambda t: volume_file(Path(t)), "volume"),
    ],
)
def test_what_cannot_be_read_is_refused_with_the_text_found(read, text):
    with pytest.raises(ValueError, match="expected") as caught:
        read(text)
    assert text in str(caught.value)


def test_regions_may_leave_ends_open():
    assert region("--roi", "-1:2.5,:,1e-1:") == ((-1.0, 2.5), (None, None), (0.1, None))


def test_limits_are_values_or_percentiles():
    assert limits_of_integers("--limits", "-1,2") == Limits(-1, 2, False)
    assert limits_of_integers("--limits", "0.1%, 99%") == Limits(0.1, 99, True)


def test_lists_of_views():
    assert view_numbers("--exclude", "17, 3,40-42") == (3, 17, 40, 41, 42)
    for text in ("", "3-", "5-3", "-1", "2;3", "a"):
        with pytest.raises(InputError, match=r"--exclude: found .*, expected views such as"):
            view_numbers("--exclude", text)


def test_coefficients():
    assert coefficients("--beam-hardening", "0.02,-1e-3") == (0.02, -0.001)
    for text in ("", "x", "1,nan"):
        with pytest.raises(InputError, match=r"--beam-hardening: found .*, expected numbers"):
            coefficients("--beam-hardening", text)
