import errno
import os
import stat
from pathlib import Path

import pytest

from clra.errors import InputError, OutputError
from clra.io import atomic
from clra.io.atomic import atomic_path, ensure_writable


def test_file_appears_whole_with_usual_permissions(tmp_path: Path) -> None:
    target = tmp_path / "out.h5"
    with atomic_path(target) as temporary:
        temporary.write_text("new")
        assert not target.exists()
        assert temporary.parent == tmp_path
    assert target.read_text() == "new"
    assert os.listdir(tmp_path) == ["out.h5"]
    other = tmp_path / "other"
    other.touch()
    assert stat.S_IMODE(target.stat().st_mode) == stat.S_IMODE(other.stat().st_mode)


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError, MemoryError])
def test_whatever_is_raised_leaves_the_old_file(tmp_path: Path, error: type[BaseException]) -> None:
    target = tmp_path / "out.h5"
    target.write_text("old")
    with pytest.raises(error), atomic_path(target) as temporary:
        temporary.write_text("half")
        raise error
    assert target.read_text() == "old"
    assert os.listdir(tmp_path) == ["out.h5"]


def test_full_disk_is_one_line_that_says_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "out.h5"

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(atomic, "_flush", full)
    with pytest.raises(OutputError, match=r"cannot write .*out\.h5: No space left.*free some"):
        with atomic_path(target) as temporary:
            temporary.write_text("all of it")
    assert not os.listdir(tmp_path)


def test_too_little_room_is_refused_before_writing(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"No space left on device \(.* GB free of 1e\+09 GB"):
        with atomic_path(tmp_path / "out.h5", size=10**18):
            pytest.fail("must not get here")
    assert not os.listdir(tmp_path)


def test_missing_folder_and_odd_targets(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="No such file or directory; make the folder first"):
        with atomic_path(tmp_path / "none" / "out.h5"):
            pytest.fail("must not get here")
    with pytest.raises(OutputError, match="it is a folder"), atomic_path(tmp_path):
        pytest.fail("must not get here")
    with pytest.raises(OutputError, match="no regular file"), atomic_path(os.devnull):
        pytest.fail("must not get here")


@pytest.mark.skipif(os.name == "nt" or os.geteuid() == 0, reason="root may write anywhere")
def test_forbidden_folder(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(OutputError, match="Permission denied; write to a folder"):
        ensure_writable(tmp_path / "out.h5")
    tmp_path.chmod(0o700)


def test_ensure_writable_leaves_nothing(tmp_path: Path) -> None:
    ensure_writable(tmp_path / "out.h5")
    assert not os.listdir(tmp_path)
    with pytest.raises(OutputError, match="make the folder first"):
        ensure_writable(tmp_path / "none" / "out.h5")


def test_a_link_is_followed(tmp_path: Path) -> None:
    real = tmp_path / "real"
    real.mkdir()
    link = tmp_path / "out.h5"
    link.symlink_to(real / "out.h5")
    with atomic_path(link) as temporary:
        temporary.write_text("new")
    assert link.is_symlink()
    assert (real / "out.h5").read_text() == "new"


def test_full_disk_inside_hdf5_is_recognised(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="No space left on device; free"):
        with atomic_path(tmp_path / "out.h5"):
            raise RuntimeError("Can't decrement id (file write failed: errno = 28, error ...)")
    with pytest.raises(RuntimeError, match="of another kind"), atomic_path(tmp_path / "out.h5"):
        raise RuntimeError("of another kind")


def test_messages_are_one_line() -> None:
    error = InputError.at("a.nxs", "entry/data", "a\nb", "  c")
    assert str(error) == "a.nxs: entry/data: found a b, expected c"
    assert isinstance(error, ValueError)
    assert "\n" not in str(OutputError("a\nb"))
