"""The library of the compiled decoder: missing, cut, of other C files, of another processor."""

from __future__ import annotations

import importlib.util
import platform
import re
import shutil
from collections.abc import Callable, Iterator
from importlib.machinery import ModuleSpec
from pathlib import Path

import pytest

from icrl_dist.config.run import ConfigError
from icrl_dist.diagnostics import doctor
from icrl_dist.models import compiled, kernel
from icrl_dist.models.compiled import kinds, library
from icrl_dist.models.dpt import DeployedTransformer
from icrl_dist.rollout.deployment import deployed
from tests.models.networks import B, build

NAME = "icrl_dist.models._decoder_kernel"
ELF_MACHINE = slice(18, 20)
"""The bytes of a library's head that name its processor."""


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Where this installation's decoder is during the test, a copy, beside copies of its C files."""
    spec = importlib.util.find_spec(NAME)
    if spec is None or spec.origin is None or not kinds():
        pytest.skip("the decoder was not compiled, or not for this processor")
    place = tmp_path / Path(spec.origin).name
    for file in (Path(spec.origin), *(Path(compiled.__file__).with_name(name) for name in ("decoder_kernel.c", "lanes.h"))):
        shutil.copy(file, tmp_path)
    find = importlib.util.find_spec
    changed = lambda name: find(name) if name != NAME else ModuleSpec(name, None, origin=str(place)) if place.exists() else None  # noqa: E731
    with monkeypatch.context() as patches:
        patches.setattr(importlib.util, "find_spec", changed)
        patches.setattr(compiled, "__file__", str(tmp_path / "compiled.py"))
        library.cache_clear()
        kinds.cache_clear()
        yield place
    library.cache_clear()
    kinds.cache_clear()


def edited(place: Path, change: Callable[[bytes], bytes]) -> None:
    place.write_bytes(change(place.read_bytes()))


def another_machine(content: bytes) -> bytes:
    """The library as one of a processor that is not this one (ELF machine 2: SPARC)."""
    whole = bytearray(content)
    whole[ELF_MACHINE] = b"\x02\x00"
    return bytes(whole)


FAULTS: dict[str, tuple[Callable[[Path], None], str]] = {
    "missing": (lambda place: place.unlink(), "not compiled"),
    "empty": (lambda place: edited(place, lambda content: b""), "is incomplete"),
    "half of it": (lambda place: edited(place, lambda content: content[: len(content) // 2]), "is incomplete"),
    "other C file": (lambda place: edited(place.with_name("decoder_kernel.c"), lambda c: c + b"\n"), "was built from other C"),
    "other header": (lambda place: edited(place.with_name("lanes.h"), lambda c: c + b"\n"), "was built from other C"),
    "no C file": (lambda place: place.with_name("lanes.h").unlink(), "cannot be loaded"),
    "other processor": (lambda place: edited(place, another_machine), "cannot be loaded"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_library_that_cannot_be_used_is_reported_and_torch_decides(place: Path, fault: str) -> None:
    make, why = FAULTS[fault]
    make(place)
    refused(why, "run `make kernel`")


def test_a_processor_without_the_instructions_is_reported_and_torch_decides(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(platform, "machine", lambda: "riscv64")
    refused(r"this processor \(riscv64\) has neither AVX2 with FMA nor NEON", "let torch decide")


def refused(why: str, remedy: str) -> None:
    assert kinds() == ()
    assert isinstance(deployed(build(), B, "auto"), DeployedTransformer)
    assert isinstance(deployed(build(), B, "kernel"), DeployedTransformer)
    check = doctor._compiled("decoder", "torch decides")
    assert check.ok is None and re.search(why, check.value) and remedy in check.remedy
    for function, error in ((kernel.require_kernel, ConfigError), (kernel.Kernel, RuntimeError)):
        with pytest.raises(error, match=f"kernel.*{why}.*{re.escape(remedy)}") as raised:
            function()
        assert "\n" not in str(raised.value)


def test_the_library_in_its_place_is_used(place: Path) -> None:
    assert kinds() and not isinstance(deployed(build(), B, "auto"), DeployedTransformer)
    assert doctor._compiled("decoder", "torch decides").ok is True
