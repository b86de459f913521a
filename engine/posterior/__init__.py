"""The posterior of lens and regularisation: :mod:`.target`, its :mod:`.optimum`, and the :mod:`.chain`."""
