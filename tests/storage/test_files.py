"""Files that cannot be written: one line with the file, the cause and a remedy that fits the cause."""

import errno
import os

import pytest

from icrl_dist.storage.files import StoreError, atomic_write, explained
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
