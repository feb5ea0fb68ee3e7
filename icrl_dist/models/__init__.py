"""Networks: the GPT-2 trunk and the models on it."""
