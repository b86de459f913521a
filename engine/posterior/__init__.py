"""The posterior of lens and regularisation: target (:mod:`.target`), optimum (:mod:`.optimum`), chain (:mod:`.chain`)."""
