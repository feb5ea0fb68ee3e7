"""Every number of a run: dataclasses, TOML, validation and the packaged run files."""
