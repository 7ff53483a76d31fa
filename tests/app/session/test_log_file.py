"""The log of a command."""

import logging
import re
import warnings

import pytest

from clra.app.session.log_file import logged, stages_logged
from clra.errors import OutputError
from clra.progress import Progress


def test_stages_warnings_and_the_end_are_logged(tmp_path):
    path, seen = tmp_path / "log.txt", []
    with warnings.catch_warnings(), logged(path, "clra align x"):
        warnings.simplefilter("always")
        report = stages_logged(seen.append)
        for done in range(3):
            report(Progress("working", done, 3))
        logging.getLogger("clra.deep").info("deep inside")
        warnings.warn("look out", stacklevel=1)
    lines = path.read_text().splitlines()
    assert all(re.match(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3} (INFO|WARNING) ", x) for x in lines)
    texts = [line[32:].strip() for line in lines]
    assert texts[0].startswith("clra align x (Python 3")
    assert texts[1:] == ["working (3)", "deep inside", "look out", "done"]
    assert len(seen) == 3
    assert path.name not in str(logging.getLogger("clra").handlers)


def test_a_failure_is_logged_and_a_log_goes_on(tmp_path):
    path = tmp_path / "log.txt"
    for _ in range(2):
        with pytest.raises(KeyError), logged(path, "clra info x"):
            raise KeyError("lost")
    assert path.read_text().count("ERROR   KeyError: 'lost'") == 2


def test_a_log_that_cannot_be_written_is_told(tmp_path):
    with pytest.raises(OutputError, match="cannot write"), logged(tmp_path, "clra"):
        pass


def test_without_a_log_nothing_changes():
    def report(progress):
        raise AssertionError

    with logged(None, "clra"):
        assert stages_logged(report) is report
