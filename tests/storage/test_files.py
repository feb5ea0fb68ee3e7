"""Files that cannot be written: one line with the file, the cause and a remedy that fits the cause."""

import errno
import fcntl
import os

import pytest

from icrl_dist.storage.files import StoreError, atomic_write, explained, held, hold, without_locks
from tests.calls import failing


def test_a_folder_that_cannot_be_created_is_an_error_with_the_file_s_name(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(
        StoreError, match=r"file/x\.npz: could not be written \((Not a directory|File exists)\): make it writable"
    ):
        atomic_write(tmp_path / "file" / "x.npz", lambda file: file.write(b""))


@pytest.mark.parametrize(
    ("number", "remedy"),
    [(errno.ENOSPC, "free space"), (errno.EROFS, "read-only"), (errno.EIO, "disk fails"), (errno.EMFILE, "ulimit -n")],
)
def test_the_remedy_fits_the_cause(tmp_path, monkeypatch, number, remedy):
    path = tmp_path / "x"
    path.write_bytes(b"before")
    monkeypatch.setattr(os, "fsync", failing(OSError(number, os.strerror(number))))
    with pytest.raises(StoreError, match=remedy):
        atomic_write(path, lambda file: file.write(b"after"))
    assert path.read_bytes() == b"before" and list(tmp_path.iterdir()) == [path]
    assert remedy in str(explained(OSError(number, os.strerror(number), str(path))))


def test_a_bug_stays_an_error_with_a_traceback():
    error = OSError(errno.EBADF, "Bad file descriptor")
    assert explained(error) is error


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS])
def test_a_file_system_without_locks_is_used_with_a_warning(tmp_path, monkeypatch, number):
    assert without_locks(tmp_path) == ""
    monkeypatch.setattr(fcntl, "flock", failing(OSError(number, os.strerror(number))))
    with hold(tmp_path):
        assert not held(tmp_path)
    warning = without_locks(tmp_path)
    assert str(tmp_path) in warning and os.strerror(number) in warning and "start none" in warning


def test_a_lock_that_this_user_may_not_read_is_not_seen(tmp_path, monkeypatch):
    hold(tmp_path).close()
    monkeypatch.setattr(type(tmp_path), "open", failing(PermissionError(errno.EACCES, "Permission denied")))
    assert not held(tmp_path)


def test_another_error_of_a_lock_is_no_missing_lock(tmp_path, monkeypatch):
    monkeypatch.setattr(fcntl, "flock", failing(OSError(errno.EIO, "Input/output error")))
    for use in (hold, held):
        with pytest.raises(OSError, match="Input/output error"):
            use(tmp_path)
