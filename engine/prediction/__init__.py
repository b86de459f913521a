"""What an estimator is expected to do in a lens that nobody has simulated, from runs of lenses that somebody has."""
