"""The in-context methods: the data that each collects, its model, its loss and its deployed policy."""
