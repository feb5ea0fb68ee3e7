"""The paper's claims, one by one: effects in pairs with intervals over training seeds, and a verdict for each."""
