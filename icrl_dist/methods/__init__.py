"""The in-context methods: what each collects and what each learns from."""
