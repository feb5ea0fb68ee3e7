"""Packaged run files: ``icrl-dist train NAME`` reads ``NAME.toml`` here."""
