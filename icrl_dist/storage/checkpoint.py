"""Checkpoints: arrays by name and a manifest, in one file per weights version, without pickle."""

from __future__ import annotations

import errno
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from icrl_dist.config.toml import ConfigError
from icrl_dist.storage.files import StoreError, atomic_write, require_file
from icrl_dist.stream.validation import VERSION

FORMAT = 1
"""Number of the file format of checkpoints and agents.  It changes when older readers would misread a file.

The entry ``format`` of the manifest is another number: that of the data to which the weights were fitted.
"""


@dataclass(frozen=True)
class Checkpoint:
    """Arrays by name and a manifest of JSON values."""

    arrays: Mapping[str, np.ndarray]
    manifest: Mapping[str, Any]

    def part(self, prefix: str) -> dict[str, np.ndarray]:
        """The arrays whose name begins with ``prefix/``, by the rest of the name."""
        return {k.removeprefix(prefix + "/"): v for k, v in self.arrays.items() if k.startswith(prefix + "/")}


def require_format(manifest: Mapping[str, Any], source: str) -> None:
    """Raises ConfigError, beginning with ``source``, for a checkpoint that was fitted to data of another format.

    Digests of equal data differ between formats, so training cannot continue from it; its agent can be deployed.
    """
    found = manifest.get("format", 1)  # 0.1.0 stored none
    if found != VERSION:
        raise ConfigError(
            f"{source}: trained on data of format {found!r}, this version of icrl-dist continues only runs of format {VERSION}"
            ": start a new run with another --out; `icrl-dist evaluate` and `export` still read the old one"
        )


def version_file(folder: Path, version: int) -> Path:
    """The checkpoint file of T^version in a run folder."""
    return folder / "checkpoints" / f"version-{version:04d}.npz"


def partial_file(folder: Path) -> Path:
    """The checkpoint file of a fit that is not finished, in a run folder."""
    return folder / "checkpoints" / "partial.npz"


def newest_version(folder: Path) -> int:
    """The newest version that has a checkpoint in a run folder; -1 if there is none."""
    names = (folder / "checkpoints").glob("version-[0-9][0-9][0-9][0-9].npz")
    return max((int(name.stem.removeprefix("version-")) for name in names), default=-1)


def save_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint of format ``FORMAT``; at every moment ``path`` holds the old one or the new one, whole."""
    manifest = np.frombuffer(json.dumps(checkpoint.manifest).encode(), dtype=np.uint8)
    arrays: dict[str, Any] = {f"a/{name}": value for name, value in checkpoint.arrays.items()}
    atomic_write(path, lambda file: np.savez(file, file_format=np.array(FORMAT), manifest=manifest, **arrays))


class DamagedCheckpoint(StoreError):  # noqa: N818
    """A checkpoint that is missing, or whose bytes changed after they were written; the fit can make it again."""


class _OtherFormat(Exception):  # noqa: N818
    """A checkpoint of another file format, whose number is the message."""


class _NotOurs(Exception):  # noqa: N818
    """The file is no checkpoint; the message is the reason."""


def _archive(opened: BinaryIO) -> Any:
    """The arrays in a file, whose first bytes are those of a zip archive."""
    if opened.read(4) != b"PK\x03\x04":
        raise _NotOurs("it is no archive of arrays")
    opened.seek(0)
    return np.load(opened, allow_pickle=False)


_RENAMED = {"stretch": "window", "produces": "next_version"}
"""Former names of manifest entries, and the present ones."""
_FORMER_PREFIX = re.compile("^optimiser/")


def load_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint, also of an older version, without executing anything in it.

    Raises StoreError if it is of another format or cannot be read, DamagedCheckpoint if it is missing or not a checkpoint.
    """
    try:
        require_file(path)
        with path.open("rb") as opened, _archive(opened) as file:
            size, unpacked = path.stat().st_size, sum(member.file_size for member in file.zip.infolist())
            if unpacked > size:
                raise _NotOurs(f"{size} bytes that would unpack to {unpacked}")
            if "manifest" not in file.files:
                raise _NotOurs("it has no manifest")
            found = file["file_format"].item() if "file_format" in file.files else FORMAT  # 0.1.0 stored none
            if found != FORMAT:
                raise _OtherFormat(found)
            manifest = json.loads(file["manifest"].tobytes())
            arrays = {name.removeprefix("a/"): file[name] for name in file.files if name.startswith("a/")}
            if not isinstance(manifest, dict) or not all(isinstance(array, np.ndarray) for array in arrays.values()):
                raise _NotOurs("its manifest is no table")
            manifest = {_RENAMED.get(name, name): value for name, value in manifest.items()}
            arrays = {_FORMER_PREFIX.sub("optimizer/", name): array for name, array in arrays.items()}
    except FileNotFoundError:
        raise DamagedCheckpoint(f"{path}: no such checkpoint") from None
    except IsADirectoryError:
        raise StoreError(f"{path}: is a folder; name a run folder or a checkpoint file") from None
    except (PermissionError, NotADirectoryError) as error:
        raise StoreError(f"{path}: the checkpoint cannot be read ({error.strerror}): make it readable") from None
    except _OtherFormat as error:
        raise StoreError(
            f"{path}: checkpoint of file format {error}, this version of icrl-dist reads format {FORMAT}: "
            "use the version that wrote it, or train again with this one"
        ) from None
    except StoreError:
        raise
    except OSError as error:
        if error.errno != errno.EIO:  # a disk that lost the bytes
            raise StoreError(f"{path}: cannot be read ({error.strerror or error}): make it readable") from None
        raise DamagedCheckpoint(f"{path}: cannot be read ({error.strerror})") from None
    except Exception as error:
        # Messages of numpy and zipfile stay out: one advises to allow pickle, which could execute code of the file.
        reason = str(error) if isinstance(error, _NotOurs) else "its content is damaged, or another program wrote it"
        raise DamagedCheckpoint(f"{path}: not a checkpoint of this system ({reason})") from None
    return Checkpoint(arrays, manifest)
