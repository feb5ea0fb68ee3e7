"""Start the learner and the workers of one run and watch them."""
