"""A disk of a chosen size: a tmpfs mounted as a run folder, which can be enlarged."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
from pathlib import Path
from types import TracebackType
from typing import Self

PAGE = 4096
"""The unit in which a tmpfs allocates, bytes."""


class NoDisk(RuntimeError):  # noqa: N818
    """This node does not allow a mount."""


def allocated(folder: Path) -> int:
    """Bytes that the files of a folder occupy on a tmpfs."""
    return sum(-(-file.stat().st_size // PAGE) * PAGE for file in folder.rglob("*") if file.is_file())


class Disk:
    """A tmpfs of ``size`` bytes mounted at ``folder``; at the end its files are copied to ``folder``.

    Root mounts it for all processes.  Other users mount it in a namespace: programs must be
    started there with ``prefix``, and its files are visible at ``view``.
    """

    def __init__(self, folder: Path, size: int) -> None:
        """Raises NoDisk if neither mount is allowed."""
        self.folder, self.view, self.prefix = folder, folder, list[str]()
        self._holder: subprocess.Popen[str] | None = None
        folder.mkdir(parents=True, exist_ok=True)
        mount = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
        try:
            made = subprocess.run(mount, capture_output=True, text=True, check=False)
            if made.returncode:
                self._hold(mount, made.stderr.strip())
        except FileNotFoundError as error:
            raise NoDisk(f"{error.filename} is missing") from None

    def _hold(self, mount: list[str], refusal: str) -> None:
        """Mount it in a namespace, which exists as long as the process that this starts in it."""
        script = '"$@" && echo mounted && exec cat'
        self._holder = subprocess.Popen(
            ["unshare", "-rm", "sh", "-c", script, "sh", *mount],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert self._holder.stdout is not None and self._holder.stderr is not None
        if self._holder.stdout.readline().strip() != "mounted":
            output = self._holder.stderr.read().strip()
            self._release()
            raise NoDisk(f"mount: {refusal}; unshare: {output}")
        pid = str(self._holder.pid)
        self.prefix = ["nsenter", "-t", pid, "-U", "-m", "--preserve-credentials", "--", "env", "-C", str(Path.cwd())]
        self.view = Path("/proc", pid, "root", *self.folder.absolute().parts[1:])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        kept = self.folder.with_name(f"{self.folder.name}-{os.getpid()}")
        shutil.copytree(self.view, kept)
        if self._holder is None:
            subprocess.run(["umount", str(self.folder)], check=True)
        self._release()
        self.folder.rmdir()
        kept.rename(self.folder)

    def _release(self) -> None:
        if self._holder is None:
            return
        for pipe in (self._holder.stdin, self._holder.stdout, self._holder.stderr):
            with contextlib.suppress(OSError):
                if pipe is not None:
                    pipe.close()
        self._holder.wait()

    def grow(self, size: int) -> None:
        """Enlarge it to ``size`` bytes."""
        subprocess.run(
            [*self.prefix, "mount", "--options-mode", "ignore", "-o", f"remount,size={size}", str(self.folder)], check=True
        )
