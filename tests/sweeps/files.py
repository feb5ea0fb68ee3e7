"""A sweep file of tests."""

from pathlib import Path

TEXT = """
run = "smoke"
seeds = [0, 1]
split_seed = "seed"

[settings.override]
[settings.strong]
adversary.p_max = 0.6

[methods.dpt]
method = "dpt"
[methods.icag-k2]
method = "icag"
adversary.count = 1
only = { settings = ["override"] }
[methods.exact]
method = "exact"

[evaluations.online]
[evaluations.unseen]
p = [0.4]
seeds = 1
only = { settings = ["override"], methods = ["dpt"] }
"""


def written(folder: Path, old: str = "", new: str = "", text: str = TEXT) -> Path:
    """The sweep file ``folder/tiny.toml``, with ``old`` replaced by ``new``."""
    assert old in text
    path = folder / "tiny.toml"
    path.write_text(text.replace(old, new) if old else text + new)
    return path
