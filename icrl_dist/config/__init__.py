"""The settings of a run: dataclasses, TOML, validation and the packaged run files."""
